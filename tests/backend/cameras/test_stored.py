"""Damaged files of a shot: the error names the file and the step that rebuilds it, and that step does rebuild it."""

import json
import shutil

import numpy as np
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.footage.images import is_whole_png, read_png
from torch_backend.lens.lens import load_lens
from torch_backend.scene import load_images, load_scene
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot


@pytest.fixture
def shot(world, tmp_path):
    return Shot(shutil.copytree(world.shot.root, tmp_path / "a.splannequin"))


def cut(path):
    """Truncate a file to half its length."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def with_points(**changes):
    def change(path):
        with np.load(path) as stored:
            kept = {name: stored[name] for name in stored.files} | changes
        np.savez(path, **{name: value for name, value in kept.items() if value is not None})

    return change


def edited(edit):
    def change(path):
        data = json.loads(path.read_text())
        edit(data)
        path.write_text(json.dumps(data))

    return change


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("points.npz", cut),
        ("points.npz", lambda path: path.write_bytes(b"")),
        ("points.npz", lambda path: path.write_bytes(bytes(range(256)) * 9)),
        ("points.npz", with_points(xyz=np.zeros((5, 3), np.float32))),
        ("points.npz", with_points(rgb=None)),
        ("points.npz", with_points(xyz=np.zeros((4, 2), np.float32))),
        ("points.npz", with_points(xyz=np.array(1.0, np.float32))),
        ("points.npz", with_points(rgb=np.array([{}], object))),
        ("points.npz", with_points(xyz=np.full((330, 3), np.nan, np.float32))),
        ("cameras.json", cut),
        ("cameras.json", lambda path: path.write_text("[" * 100_000)),
        ("cameras.json", edited(lambda data: data["frames"][2].pop("viewmat"))),
        ("cameras.json", edited(lambda data: data["frames"][2].update(viewmat=[1.0]))),
        ("cameras.json", edited(lambda data: data["frames"][2].update(K=[0.0, 0.0, 1.0, 1.0]))),
        ("cameras.json", edited(lambda data: data.update(frames=7))),
        ("cameras.json", edited(lambda data: data["frames"][-1].update(frame=9999))),
    ],
)
def test_a_damaged_file_of_the_solve_is_named_and_solving_again_is_the_advice(shot, name, damage):
    damage(shot.solve / name)
    with pytest.raises(JobError) as error:
        load_scene(shot)
    assert error.value.message.startswith(f"{shot.solve / name} is damaged (")
    assert (error.value.hint, error.value.exit_code) == ("Solve the camera again.", ExitCode.SOLVE)


def test_a_damaged_solve_json_is_named(shot):
    (shot.solve / "solve.json").write_text("{")
    with pytest.raises(JobError, match=r"solve\.json is damaged"):
        load_lens(shot)


@pytest.mark.parametrize(
    "damage",
    [
        cut,
        lambda path: path.write_text("[" * 200_000),
        edited(lambda data: data.pop("frames")),
        edited(lambda data: data.update(frames=[3])),
        edited(lambda data: data["frames"][1].pop("seconds")),
    ],
)
def test_a_damaged_listing_of_frames_is_named_and_importing_again_is_the_advice(shot, damage):
    damage(shot.frames / "frames.json")
    with pytest.raises(JobError, match=r"frames\.json is damaged") as error:
        load_scene(shot)
    assert (error.value.hint, error.value.exit_code) == ("Import the clip again.", ExitCode.FOOTAGE)


@pytest.mark.parametrize("damage", [cut, lambda path: path.unlink()])
def test_a_damaged_frame_is_named_by_training(shot, damage):
    scene = load_scene(shot)
    damage(scene.image_path(3))
    with pytest.raises(JobError) as error:
        load_images(scene, [2, 3], 32, 24)
    assert error.value.message == f"Frame {scene.frames[3]} is damaged or missing: {scene.image_path(3)}."
    assert (error.value.hint, error.value.exit_code) == ("Solve the camera again.", ExitCode.SOLVE)


def test_a_png_is_checked_without_decoding_it(shot, tmp_path):
    path = shot.frames / f"{load_frames(shot)['frames'][0]['frame']:06d}.png"
    assert is_whole_png(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    for name, broken in (("bit", data), ("cut", data[:-20]), ("none", b""), ("text", b"not a picture at all")):
        (tmp_path / name).write_bytes(broken)
        assert not is_whole_png(tmp_path / name)
    assert not is_whole_png(tmp_path)


def test_solving_again_mends_what_was_damaged(again, tools):
    shot, cameras = again
    solve_shot(shot, SolveConfig(), tools.recorder(), cameras)
    plate = shot.frames / "000105.png"
    good = read_png(plate)
    cut(plate)
    solve_shot(shot, SolveConfig(), tools.recorder(), cameras)
    assert (read_png(plate) == good).all()


def test_damaged_frame_is_detected_before_the_solve_and_reimported(solved, again, tools):
    shot, _ = again
    cut(shot.frames / "raw/000107.png")
    (shot.frames / "raw/000109.png").unlink()
    with pytest.raises(JobError) as error:
        solve_shot(shot, SolveConfig(features=1000), tools.recorder(cancel_at=("solve: features", 0.0)))
    assert error.value.message == f"Damaged or missing in {shot.frames / 'raw'}: frames 107, 109."
    assert (error.value.hint, error.value.exit_code) == ("Import the clip again.", ExitCode.FOOTAGE)
    import_footage(shot, solved.shot.info().source, FootageConfig(step=2), tools.recorder())
    assert is_whole_png(shot.frames / "raw/000107.png") and is_whole_png(shot.frames / "raw/000109.png")
