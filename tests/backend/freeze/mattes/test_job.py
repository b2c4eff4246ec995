"""Mattes of a take of the tiny world, compared with its truth at every pose; caching, updates, removal, refusals."""

import json
import shutil

import numpy as np
import pytest

from tests.backend.conftest import outline
from torch_backend.contract import Cancelled, FreezeParams, JobError, MatteParams, TakeFolder
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.mattes.carry import in_order
from torch_backend.freeze.mattes.files import read_matte
from torch_backend.freeze.mattes.job import make_mattes, stored_lassos

T_STAR, LASSO = 105, 108


def truth(world, pose):
    """[H, W] bool: pixels that the patch covers from a pose at the frozen instant."""
    return world.patch(pose - 101, (T_STAR - 101) / 15) > 0.5


ASK = dict(t_star=T_STAR, first=104, last=112, detail="off", develop="off")


@pytest.fixture(scope="module")
def frozen(trained_copy, quiet):
    """(world, folder of a take without mattes)."""
    freeze_shot(trained_copy.shot, FreezeParams(take="clean", **ASK), quiet())
    return trained_copy, trained_copy.shot.take("clean")


@pytest.fixture
def take(frozen, tmp_path, request):
    """(world, folder of a new take, function that writes a lasso file)."""
    world, clean = frozen
    name = f"m{abs(hash(request.node.name)) % 10**9}"
    shutil.copytree(clean, world.shot.take(name))

    def lassos(*rows):
        path = tmp_path / f"lassos{len(list(tmp_path.iterdir()))}.json"
        path.write_text(json.dumps({"mattes": list(rows)}), encoding="utf-8")
        return MatteParams(take=name, polygons=str(path))

    return world, TakeFolder(world.shot.take(name)), lassos


def patch(world, name="patch", frame=LASSO):
    return {"name": name, "frame": frame, "polygon": outline(truth(world, frame))}


CORNER = {"name": "corner", "frame": 107, "polygon": [[2, 2], [12, 2], [12, 12], [2, 12]]}


def overlaps(world, folder, name="patch"):
    found = {}
    for n in range(104, 113):
        matte, mask = read_matte(folder.matte_frames(name) / f"{n:06d}.exr", (0, 0)) > 0.5, truth(world, n)
        found[n] = (matte & mask).sum() / (matte | mask).sum()
    return found


def test_one_lasso_is_a_matte_at_every_pose(take, quiet):
    world, folder, lassos = take
    result = make_mattes(world.shot, lassos(patch(world)), quiet())
    found = overlaps(world, folder)
    assert np.mean(list(found.values())) > 0.85 and min(found.values()) > 0.75
    assert list(result["mattes"]) == ["patch"] and result["frames"] == 9
    assert sorted(p.name for p in folder.cryptomattes.iterdir()) == [f"{n:06d}.exr" for n in range(104, 113)]
    assert [lasso.name for lasso in stored_lassos(folder, 64, 48)] == ["patch"]


def test_one_matte_is_removed_and_the_second_becomes_pictures(take, quiet):
    world, folder, lassos = take
    params = lassos(patch(world), CORNER)
    make_mattes(world.shot, params, quiet())
    result = make_mattes(world.shot, MatteParams(take=folder.root.name, remove="corner", matte_format="png"), quiet())
    assert list(result["mattes"]) == ["patch"]
    assert [p.name for p in folder.single_mattes.iterdir()] == ["patch"]
    assert {p.suffix for p in folder.matte_frames("patch").iterdir()} == {".png"}
    assert (read_matte(folder.matte_frames("patch") / "000110.png", (0, 0)) > 0.5).any()
    make_mattes(world.shot, MatteParams(take=folder.root.name, remove="patch"), quiet())
    assert not list(folder.single_mattes.iterdir()) and not list(folder.cryptomattes.iterdir())


def test_current_mattes_are_kept_and_stale_ones_recomputed(take, quiet):
    world, folder, lassos = take
    make_mattes(world.shot, lassos(patch(world)), quiet())
    first = folder.matte_frames("patch") / "000106.exr"
    before = first.stat().st_mtime_ns
    result = make_mattes(world.shot, lassos(CORNER), quiet())
    assert result["made"] == ["corner"] and sorted(result["mattes"]) == ["corner", "patch"]
    assert first.stat().st_mtime_ns == before
    assert make_mattes(world.shot, MatteParams(take=folder.root.name), quiet())["made"] == []
    first.write_bytes(b"cut off")
    assert make_mattes(world.shot, MatteParams(take=folder.root.name), quiet())["made"] == ["patch"]
    assert read_matte(first, (0, 0)).any()
    freeze_shot(world.shot, FreezeParams(take=folder.root.name, **{**ASK, "t_star": 106}), quiet())
    result = make_mattes(world.shot, MatteParams(take=folder.root.name), quiet())
    assert sorted(result["made"]) == ["corner", "patch"]


def test_a_cancelled_job_goes_on(take, quiet):
    world, folder, lassos = take
    with pytest.raises(Cancelled):
        make_mattes(world.shot, lassos(patch(world)), quiet(cancel_at=("making mattes", 0.5)))
    assert [lasso.name for lasso in stored_lassos(folder, 64, 48)] == ["patch"]
    assert not json.loads(folder.mattes_record.read_text(encoding="utf-8"))["finished"]
    make_mattes(world.shot, MatteParams(take=folder.root.name), quiet())
    assert json.loads(folder.mattes_record.read_text(encoding="utf-8"))["finished"]
    assert min(overlaps(world, folder).values()) > 0.75


@pytest.mark.parametrize(
    ("row", "word"),
    [
        ({"frame": 300}, "frame 300"),
        ({"polygon": [[900, 900], [950, 900], [950, 950]]}, "outside"),
        ({"name": "CORNER"}, "upper and lower case"),
    ],
)
def test_wrong_lassos_are_sentences(take, quiet, row, word):
    world, _, lassos = take
    with pytest.raises(JobError, match=word):
        make_mattes(world.shot, lassos(CORNER, {**CORNER, **row}), quiet())


def test_missing_take_or_lassos_give_readable_errors(take, quiet):
    world, folder, _ = take
    with pytest.raises(JobError, match="no finished take"):
        make_mattes(world.shot, MatteParams(take="nowhere"), quiet())
    with pytest.raises(JobError, match="no lassos"):
        make_mattes(world.shot, MatteParams(take=folder.root.name), quiet())
    with pytest.raises(JobError, match="no matte"):
        make_mattes(world.shot, MatteParams(take=folder.root.name, remove="nobody"), quiet())


def test_frames_are_taken_outwards_from_the_lassos():
    polygons = {"a": {5: []}, "b": {9: []}}
    order = in_order(polygons, range(1, 12))
    assert set(order[:2]) == {5, 9} and order[-1] == 1
