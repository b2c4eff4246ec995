"""Frozen frames of the tiny world, compared with its truth: pixels, mattes, depth, stale frames, cancellation."""

import json
import shutil

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from torch_backend.contract import (
    NO_DEPTH,
    CameraFrame,
    CameraPath,
    Cancelled,
    FreezeParams,
    JobError,
    TakeFolder,
    TrainParams,
    disk_error,
    later,
)
from torch_backend.footage.color import linear_to_srgb
from torch_backend.footage.images import read_png
from torch_backend.freeze import freeze_at, freeze_shot
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.take import background_writer
from torch_backend.freeze.take import frames as take_frames
from torch_backend.freeze.take.cameras import plan
from torch_backend.freeze.take.job import missable
from torch_backend.freeze.take.video import write_video
from torch_backend.gaussians.ply import read_ply
from torch_backend.scene import load_scene
from torch_backend.shot import Shot, write_json
from torch_backend.train import device, load_run, train_shot
from torch_backend.train.checkpoint import load_checkpoint, save_checkpoint
from torch_backend.train.identity import solve_key
from torch_backend.train.self_test import SelfTest


def test_a_video_that_cannot_be_replaced_is_missed_in_words_and_ends_no_freeze(quiet, tmp_path):
    """Windows refuses to replace a file that a player has open. A folder in its place is refused on all systems."""
    report, frames = quiet(), [np.zeros((16, 16, 3), np.uint8)]
    (tmp_path / "video.mp4").mkdir()
    with missable("video", report):
        write_video(tmp_path / "video.mp4", frames, 24.0)
    (event,) = report.events
    assert event[0] == "warning" and "The video was not written" in event[1] and "video.mp4" in event[1]
    with pytest.raises(OSError, match="No space"), missable("video", report):
        raise OSError(28, "No space left on device", "video.mp4")


@pytest.fixture(scope="module")
def takes(trained, quiet):
    """Frames 102, 105, ... of three takes; only the second instant is not developed."""
    cases = [(105, "on", "on"), (105, "off", "on"), (112, "on", "off")]
    for t, detail, develop in cases:
        ask = FreezeParams(take=f"t{t}{detail}", t_star=t, detail=detail, develop=develop, first=102, step=3)
        freeze_shot(trained.shot, ask, quiet())
    return [(t, detail) for t, detail, _ in cases]


def frozen(world, t_star, frame, detail="on"):
    return read_frozen_exr(world.shot.take(f"t{t_star}{detail}") / f"{frame:06d}.exr")


def psnr(a, b):
    return -10 * np.log10(np.mean((np.asarray(a, float) - np.asarray(b, float)) ** 2))


def test_every_pose_shows_the_world_at_t_star(trained, takes):
    for t_star, detail in takes:
        scores = []
        for n in (1, 7, 10, 13):
            image = frozen(trained, t_star, 101 + n, detail)
            truth = trained.image(n, (t_star - 101) / 15).numpy()
            scores.append(psnr(linear_to_srgb(image.rgba[..., :3]), truth))
        assert min(scores) > 18.0
        assert np.mean(scores) > 21.0


def test_two_instants_differ_only_where_the_patch_moved(trained, takes):
    early, late = frozen(trained, 105, 108), frozen(trained, 112, 108)
    difference = np.abs(early.rgba[..., :3] - late.rgba[..., :3]).mean(-1)
    truth = (trained.image(7, 4 / 15) - trained.image(7, 11 / 15)).abs().mean(-1).numpy()
    moved = truth > 0.1
    still = truth < 0.002
    assert difference[moved].mean() > 0.05
    # A few pixels around the patch are removed with it: on average 1/40 of an 8-bit step.
    assert difference[still].mean() < 1e-4 and np.quantile(difference[still], 0.98) == 0.0
    assert early.motion[moved].mean() > 0.35 > 0.15 > early.motion[still].mean()


def test_frames_of_a_run_that_is_trained_while_it_is_frozen_are_not_believed(trained, quiet):
    """These frames show the old model; with the new model's key they would be kept forever."""
    run = shutil.copytree(trained.shot.run("main"), trained.shot.run("trained meanwhile"))
    tensors, meta = load_checkpoint(run / "checkpoint.safetensors")
    tensors["gaussians.sh0"] = -tensors["gaussians.sh0"]

    class TrainsMeanwhile(quiet):
        def warning(self, message, hint=""):
            super().warning(message, hint)
            if "was not trained on" in message:  # this message comes between loading the model and the first frame
                save_checkpoint(run / "checkpoint.safetensors", tensors, meta)

    options = dict(run=run.name, take="meanwhile", t_star=109, first=105, last=105, only_missing=True)
    options |= dict(detail="off", develop="off")
    frame, report = trained.shot.take("meanwhile") / "000105.exr", TrainsMeanwhile()
    freeze_shot(trained.shot, FreezeParams(**options), report)
    old, again = read_frozen_exr(frame), quiet()
    freeze_shot(trained.shot, FreezeParams(**options), again)
    assert np.abs(read_frozen_exr(frame).rgba - old.rgba).mean() > 0.1, "rendered again, from the new model"
    event = ["trained during the freeze" in "".join(str(e) for e in r.events) for r in (report, again)]
    assert event == [True, False]


def test_a_freeze_says_why_it_does_not_use_the_card(trained, quiet, monkeypatch):
    monkeypatch.setattr(device, "cuda_refusal", lambda: "")
    monkeypatch.setattr(device, "card_verdict", lambda: SelfTest(problem="a frame comes out wrong on it"))
    small = dict(take="no card", t_star=105, first=105, last=105, detail="off", develop="off")
    for cases, times in (("auto", 1), ("cpu", 0)):
        report = quiet()
        freeze_shot(trained.shot, FreezeParams(**small, device=cases), report)
        said = [event[1] for event in report.events if event[0] == "warning" and "graphics card" in event[1]]
        assert len(said) == times and all(s.startswith("Freezing uses the processor") for s in said)


def test_depth_is_in_solve_units_and_empty_is_1e10(trained, takes):
    image = frozen(trained, 105, 105)
    centre = np.median(image.depth[4:44, 4:14])
    assert centre == pytest.approx(4.0, rel=0.05)
    assert (image.depth[image.rgba[..., 3] == 0] == np.float32(NO_DEPTH)).all()
    assert image.metadata.t_star_frame == 105
    np.testing.assert_allclose(image.metadata.viewmat, trained.viewmats[4].numpy(), atol=1e-4)


def test_support_is_high_where_everything_was_seen(trained, takes):
    assert frozen(trained, 105, 102).support[8:40, 8:56].mean() > 0.9


def test_what_a_take_leaves(trained, takes):
    folder = trained.shot.take("t105on")
    facts = json.loads((folder / "take.json").read_text())
    assert facts["frames"] == 5
    assert facts["t_star_frame"] == 105
    assert (folder / "contact_sheet.png").stat().st_size > 1000
    assert (folder / "video.mp4").stat().st_size > 500
    assert read_png(folder / "preview" / "000102.png").shape == (48, 64, 3)
    ply = read_ply(folder / "frozen.ply")
    kept = load_checkpoint(trained.shot.run("main") / "developed" / "000105.safetensors")[0]
    assert facts["developed"] == [105] and len(ply.means) == len(kept["state.means"]), "the developed instant"
    assert np.median(ply.means[:, 1]) == pytest.approx(4.0, rel=0.1), "upright: ahead is y"


def test_query_nearest_is_the_plain_one_where_everything_is_supported(trained):
    model = load_run(trained.shot, "main").model
    model.gaussians.support[:] = True
    time = float(model.centres[4])
    plain, nearest = freeze_at(model, time, 1.5, "plain"), freeze_at(model, time, 1.5, "nearest")
    for name, value in plain.state.items():
        torch.testing.assert_close(value, nearest.state[name])
    with pytest.raises(ValueError, match="query"):
        freeze_at(model, time, 1.5, "best")


def test_only_missing_frames_are_rendered_again(trained, quiet):
    ask = dict(take="again", develop="off", detail="off", first=102, last=104, only_missing=True)
    freeze_shot(trained.shot, FreezeParams(**ask, t_star=104), quiet())
    folder = trained.shot.take("again")
    (folder / "000103.exr").unlink()
    before = {p.name: p.stat().st_mtime_ns for p in folder.glob("*.exr")}
    freeze_shot(trained.shot, FreezeParams(**ask, t_star=104), quiet())
    after = {p.name: p.stat().st_mtime_ns for p in folder.glob("*.exr")}
    assert {n for n in after if after[n] != before.get(n)} == {"000103.exr"}
    freeze_shot(trained.shot, FreezeParams(**ask, t_star=110), quiet())
    assert all(p.stat().st_mtime_ns != after[p.name] for p in folder.glob("*.exr"))


def test_frames_written_in_a_thread_equal_those_written_directly(trained, quiet, monkeypatch):
    options = dict(t_star=108, first=103, last=104, develop="off")
    for take, limit in (("beside", 1 << 40), ("at once", -1)):
        monkeypatch.setattr(background_writer, "MAX_BACKGROUND_BYTES", limit)
        freeze_shot(trained.shot, FreezeParams(take=take, **options), quiet())
    threaded, at_once = trained.shot.take("beside"), trained.shot.take("at once")
    pictures = sorted(p.relative_to(threaded) for p in threaded.rglob("*.exr"))
    assert len(pictures) == 4
    for picture in pictures:
        first_file, second_file = (
            oiio.ImageBuf(str(folder / picture)).get_pixels(oiio.FLOAT) for folder in (threaded, at_once)
        )
        assert np.array_equal(first_file, second_file, equal_nan=True), picture
    for n in (103, 104):
        first_file, second_file = (folder / "preview" / f"{n:06d}.png" for folder in (threaded, at_once))
        assert first_file.read_bytes() == second_file.read_bytes()


def test_a_frame_that_cannot_be_written_ends_the_take_and_leaves_whole_frames(trained, quiet):
    folder = trained.shot.take("refused")

    class InTheWay(quiet):
        def progress(self, stage, done, total, message=""):
            if (stage, done) == ("freezing", 0):
                (folder / "preview" / "000105.png").mkdir()

    options = dict(take="refused", t_star=108, first=103, last=106, detail="off", develop="off")
    with pytest.raises(OSError, match="000105"):
        freeze_shot(trained.shot, FreezeParams(**options), InTheWay())
    assert [p.name for p in sorted(folder.glob("*.exr"))] == ["000103.exr", "000104.exr"]
    assert read_frozen_exr(folder / "000104.exr").rgba.any() and not list(folder.rglob(".*"))
    (folder / "preview" / "000105.png").rmdir()
    before = (folder / "000104.exr").stat().st_mtime_ns
    assert freeze_shot(trained.shot, FreezeParams(**options, only_missing=True), quiet())["frames"] == 4
    assert (folder / "000104.exr").stat().st_mtime_ns == before


def test_what_ends_before_the_first_frame_leaves_the_take_of_before(trained, quiet, monkeypatch):
    ask = dict(take="kept-back", first=103, last=105, detail="off")
    freeze_shot(trained.shot, FreezeParams(**ask, develop="off", t_star=104), quiet())
    folder = trained.shot.take("kept-back")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(Cancelled):
        freeze_shot(trained.shot, FreezeParams(**ask, t_star=106), quiet(cancel_at=("developing", 0.1)))

    def full(folder, *_):
        raise disk_error(folder)

    monkeypatch.setattr(take_frames, "need_disk", full)
    with pytest.raises(JobError, match="full"):
        freeze_shot(trained.shot, FreezeParams(**ask, develop="off", t_star=106), quiet())
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_take_stays_until_the_one_that_replaces_it_is_done(trained, quiet):
    """Another instant under the same name: cancelled, continued, killed during the replacement, and finished."""
    ask = dict(take="again", develop="off", first=103, last=106)
    freeze_shot(trained.shot, FreezeParams(**ask, t_star=104), quiet())
    folder = trained.shot.take("again")
    new_take = TakeFolder(folder).next.root

    def contents():
        return {
            p.relative_to(folder): p.read_bytes()
            for p in folder.rglob("*")
            if p.is_file() and new_take not in p.parents
        }

    before = contents()
    with pytest.raises(Cancelled):
        freeze_shot(trained.shot, FreezeParams(**ask, t_star=106), quiet(cancel_at=("freezing", 0.5)))
    assert contents() == before, "cancelled: the old take is whole"
    begun = {p.name: p.stat().st_mtime_ns for p in new_take.glob("*.exr")}
    assert 0 < len(begun) < 4
    second_request = dict(ask, take="beside")
    freeze_shot(trained.shot, FreezeParams(**second_request, t_star=106), quiet())
    (folder / "take.json").unlink()  # the state after a kill at the worst moment: some old frames, some new, one moved
    first = min(begun)
    for name in (f"preview/{first[:6]}.png", f"warp/{first}", first):
        (new_take / name).rename(folder / name)
    facts = freeze_shot(trained.shot, FreezeParams(**ask, t_star=106, only_missing=True), quiet())
    assert facts["t_star_frame"] == 106 and facts["frames"] == 4 and not new_take.exists()
    assert all((folder / name).stat().st_mtime_ns == at for name, at in begun.items()), "what was begun is used"
    for number in range(103, 107):
        names = (f"{number:06d}.exr", f"warp/{number:06d}.exr", f"preview/{number:06d}.png")
        for replaced, wanted in ((folder / n, trained.shot.take("beside") / n) for n in names):
            assert replaced.read_bytes() == wanted.read_bytes()


def test_camera_path_can_set_the_frame_size(trained, quiet, tmp_path):
    viewmat = trained.viewmats[7].clone()
    viewmat[2, 3] = 0.3
    path = CameraPath(128, 96, [CameraFrame(1, viewmat.flatten().tolist(), [120.0, 120.0, 64.0, 48.0], "blender")])
    write_json(tmp_path / "path.json", path.to_json())
    params = FreezeParams(take="path", t_star=108, camera_path=str(tmp_path / "path.json"), width=128, develop="off")
    assert freeze_shot(trained.shot, params, quiet())["frames"] == 1
    image = read_frozen_exr(trained.shot.take("path") / "000001.exr")
    assert image.rgba.shape == (96, 128, 4)
    assert np.median(image.depth[30:60, 100:120]) == pytest.approx(4.3, rel=0.05)


def test_frames_that_the_footage_lacks_are_frozen_through_a_camera_between(trained, quiet, tmp_path):
    """Frames 107 and 109 are lost. A gap of more than two seconds would stay a gap."""
    shot = Shot(tmp_path / "lost.splannequin")
    shutil.copytree(trained.shot.root, shot.root, ignore=shutil.ignore_patterns("takes", "jobs"))
    for file in (shot.listing, shot.cameras):
        event = json.loads(file.read_text())
        event["frames"] = [row for row in event["frames"] if row["frame"] not in (107, 109)]
        event["timecode"] = "01:00:00:22"
        file.write_text(json.dumps(event))
        (shot.frames / "000107.png").unlink(missing_ok=True)
    checkpoint = shot.run("main") / "checkpoint.safetensors"
    tensors, meta = load_checkpoint(checkpoint)
    save_checkpoint(checkpoint, tensors, {**meta, "solve": solve_key(shot)})
    scene, params = load_scene(shot), FreezeParams(take="lost", t_star=105, develop="off", detail="off")
    planned = {output.frame: output for output in plan(scene, params, 105, 96, 72)}
    assert sorted(planned) == load_scene(trained.shot).frames and 107 not in scene.frames
    before, at, after = (torch.linalg.inv(planned[n].viewmat)[:3, 3] for n in (106, 107, 108))
    assert torch.allclose(at, (before + after) / 2, atol=1e-5) and torch.dist(before, after) > 0.1
    assert torch.equal(planned[107].K, planned[106].K)
    assert freeze_shot(shot, params, quiet())["frames"] == 16
    image = read_frozen_exr(shot.take("lost") / "000107.exr")
    assert psnr(linear_to_srgb(image.rgba[..., :3]), trained.image(6, 4 / 15).numpy()) > 18.0
    assert image.metadata.timecode == later("01:00:00:22", 6, json.loads(shot.listing.read_text())["fps"])
    scene.seconds[6:] += 3.0
    assert 107 not in {output.frame for output in plan(scene, params, 105, 96, 72)}


@pytest.mark.parametrize(
    ("params", "word"),
    [
        ({"t_star": 7}, "frames 101 to 116"),
        ({"t_star_per_frame": {"103": 130.0}}, "at frame 103 is frame 130, the shot has frames 101 to 116"),
        ({"run": "nobody"}, "no trained run"),
        ({"first": 300}, "No frame lies"),
    ],
)
def test_wrong_requests_are_sentences(trained, quiet, params, word):
    with pytest.raises(JobError, match=word):
        freeze_shot(trained.shot, FreezeParams(take="wrong", **params), quiet())


def test_t_star_snaps_to_a_trained_frame_with_a_note(trained, quiet):
    report = quiet()
    facts = freeze_shot(trained.shot, FreezeParams(take="snap", t_star=109, first=109, last=109, develop="off"), report)
    assert facts["t_star_frame"] in (108, 110)
    assert any(e[0] == "warning" and "109" in e[1] for e in report.events)


def test_pictures_of_the_artist_outlive_a_take_and_a_run_of_that_name(trained, quiet, tmp_path):
    (tmp_path / "preview").mkdir()
    mine = [tmp_path / "000105.exr", tmp_path / "preview" / "000105.png"]
    for picture in mine:
        picture.write_bytes(b"mine")
    for link in (trained.shot.take("linked"), trained.shot.run("linked"), trained.shot.take("inner") / "preview"):
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(tmp_path, target_is_directory=True)
    for name in ("linked", "inner"):
        with pytest.raises(JobError, match="is a link to"):
            freeze_shot(trained.shot, FreezeParams(take=name, t_star=105), quiet())
    with pytest.raises(JobError, match="is a link to"):
        train_shot(trained.shot, TrainParams(run="linked"), quiet())
    trained.shot.take("theirs").mkdir()
    mine.append(trained.shot.take("theirs") / "000101.exr")
    mine[-1].write_bytes(b"mine")
    with pytest.raises(JobError, match="theirs contains numbered pictures that Splannequin did not write"):
        freeze_shot(trained.shot, FreezeParams(take="theirs", t_star=105), quiet())
    assert [picture.read_bytes() for picture in mine] == [b"mine"] * 3
