"""The surface of a take of the tiny world, compared with its wall and patch; caching, updates, refusals."""

import json

import numpy as np
import pytest

from torch_backend import contract
from torch_backend.cameras.placement import Similarity
from torch_backend.contract import NO_DEPTH, Cancelled, FreezeParams, JobError, SurfaceParams, TakeFolder
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import FrameMetadata, write_frozen_exr
from torch_backend.freeze.surface.job import make_surface, read_surface, view_of
from torch_backend.freeze.surface.volume import SurfaceConfig, unprojected
from torch_backend.raster import rasterize

T_STAR = 105


@pytest.fixture(scope="module")
def take(trained, quiet):
    """(world, folder of a take)."""
    freeze_shot(trained.shot, FreezeParams(take="solid", t_star=T_STAR, first=102, step=2, detail="off"), quiet())
    return trained, TakeFolder(trained.shot.take("solid"))


def in_solve(folder):
    """(vertices [V, 3] float64 in solve units, triangles [T, 3], people [T], colours [V, 3]) of a take's surface."""
    vertices, triangles = read_surface(folder.surface)
    facts = json.loads(folder.facts.read_text(encoding="utf-8"))
    back = Similarity.of(contract.placement_of(facts)).inverse()
    places = back.points(np.stack([vertices[axis] for axis in "xyz"], -1))
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], -1)
    return places, np.stack([triangles[c] for c in "abc"], -1), triangles["people"] > 0, colors


def test_the_surface_is_the_true_one(take, quiet):
    world, folder = take
    result = make_surface(world.shot, SurfaceParams(take="solid"), quiet())
    assert result["made"] and result["triangles"] > 500
    points, triangles, people, colors = in_solve(folder)
    patch = world.at((T_STAR - 101) / 15)["means"][world.moving].double().numpy()
    low, high = patch.min(0), patch.max(0)
    distances = []
    for viewmat in world.viewmats:
        state = world.at((T_STAR - 101) / 15)
        shown = rasterize(**state, viewmats=viewmat[None], Ks=world.K[None], width=64, height=48, with_depth=True)
        assert shown.depth_median is not None
        truth = shown.depth_median[0].numpy()
        seen = points @ viewmat.double().numpy()[:3, :3].T + viewmat.double().numpy()[:3, 3]
        x, y = (np.floor(60 * seen[:, i] / seen[:, 2] + c).astype(int) for i, c in ((0, 32), (1, 24)))
        within = (x >= 0) & (x < 64) & (y >= 0) & (y < 48)
        depth = truth[np.clip(y, 0, 47), np.clip(x, 0, 63)]
        distances.append(np.where(within, np.abs(seen[:, 2] - depth) / depth, np.inf))
    of_two_plates = np.sort(distances, axis=0)[1]
    assert np.isfinite(of_two_plates).mean() > 0.9
    assert np.median(of_two_plates) < 0.01
    middles = points[triangles].mean(1)
    assert 0.02 < people.mean() < 0.5
    # A short training gives no exact distance of the patch, so only its position in the picture is checked.
    aside = np.linalg.norm((middles - np.clip(middles, low, high))[:, :2], axis=1)
    assert np.median(aside[people]) < 0.1 < np.median(aside[~people])
    assert np.median(middles[people][:, 2]) < np.median(middles[~people][:, 2]) == pytest.approx(4.0, abs=0.1)
    red = colors[np.unique(triangles[people])].astype(float)
    assert red[:, 0].mean() > 2 * red[:, 1:].mean(), "the patch is red"


def test_a_large_frames_floor_stays_where_it_is(tmp_path):
    """Depth falls by 5 % from one fused pixel's rows to the next, so that half a pixel would move the floor."""
    width, height, focal, above = 960, 540, 800.0, 1.5
    rows = np.arange(height) + 0.5 - height / 2
    depth = np.where(rows > 60, above * focal / np.maximum(rows, 1.0), NO_DEPTH)[:, None].repeat(width, 1)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    ones, path = np.ones((height, width), np.float32), tmp_path / "000001.exr"
    rgba = np.ones((height, width, 4), np.float32)
    write_frozen_exr(path, rgba, depth, ones, 0 * ones, FrameMetadata(1, 1.0, np.eye(4, dtype=np.float32), K))
    points = unprojected(view_of(path, SurfaceConfig()))[0]
    assert len(points) > 10_000
    assert abs(points[:, 1].mean() - above) < 0.003 and np.abs(points[:, 1] - above).max() < 0.03


def test_surface_is_cached_and_recomputed_with_the_take(take, quiet):
    world, folder = take
    make_surface(world.shot, SurfaceParams(take="solid"), quiet())
    before = folder.surface.read_bytes()
    assert not make_surface(world.shot, SurfaceParams(take="solid"), quiet())["made"]
    folder.surface.write_bytes(before[:-3])
    assert make_surface(world.shot, SurfaceParams(take="solid"), quiet())["made"]
    assert folder.surface.read_bytes() == before, "the same take has the same surface"
    facts = json.loads(folder.facts.read_text(encoding="utf-8"))
    folder.facts.write_text(json.dumps({**facts, "seconds": 1.25}), encoding="utf-8")
    assert contract.surface_of_take(folder) is None
    assert make_surface(world.shot, SurfaceParams(take="solid"), quiet())["made"]


def test_a_placed_take_has_a_placed_surface(take, quiet):
    world, folder = take
    make_surface(world.shot, SurfaceParams(take="solid"), quiet())
    points, *_ = in_solve(folder)
    facts = json.loads(folder.facts.read_text(encoding="utf-8"))
    placement = contract.Placement([0, 0, 2, 1, 2, 0, 0, 5, 0, 2, 0, -1, 0, 0, 0, 1])
    folder.facts.write_text(json.dumps({**facts, "placement": placement.to_json()}), encoding="utf-8")
    make_surface(world.shot, SurfaceParams(take="solid"), quiet())
    vertices, _ = read_surface(folder.surface)
    np.testing.assert_allclose(vertices["x"], 2 * points[:, 2] + 1, atol=1e-4)
    np.testing.assert_allclose(in_solve(folder)[0], points, atol=1e-4)


def test_uncreatable_paths_give_a_readable_error(take, quiet):
    world, folder = take
    with pytest.raises(JobError, match="no finished take"):
        make_surface(world.shot, SurfaceParams(take="nowhere"), quiet())
    folder.surface.unlink(missing_ok=True)
    with pytest.raises(Cancelled):
        make_surface(world.shot, SurfaceParams(take="solid"), quiet(cancel_at=("making the surface", 0.3)))
    assert not folder.surface.exists()
    facts = json.loads(folder.facts.read_text(encoding="utf-8"))
    folder.facts.write_text(json.dumps({**facts, "t_star_per_frame": {"102": 102.0}}), encoding="utf-8")
    with pytest.raises(JobError, match="keyed"):
        make_surface(world.shot, SurfaceParams(take="solid"), quiet())
    folder.facts.write_text(json.dumps(facts), encoding="utf-8")


def test_foreign_surface_file_is_rejected(take, quiet):
    world, folder = take
    make_surface(world.shot, SurfaceParams(take="solid"), quiet())
    whole = folder.surface.read_bytes()
    for wrong in (b"", b"ply\n", whole + b"x", whole.replace(b"element face ", b"element face 9", 1)):
        folder.surface.write_bytes(wrong)
        assert contract.surface_of_take(folder) is None
        with pytest.raises(ValueError, match="surface of a take|truncated"):
            read_surface(folder.surface)
    folder.surface.write_bytes(whole)
