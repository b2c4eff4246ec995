"""Import of cameras from other programs: files compared with float64, and matching of cameras to frames."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from torch_backend.cameras import imported
from torch_backend.cameras.colmap_files import read_model, write_model
from torch_backend.contract import CameraPath, ExitCode, JobError, read_json
from torch_backend.footage.pairing import Counted

PLAIN = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 321.0, "cy": 239.0}


def turned(angle, axis=1):
    c, s = math.cos(angle), math.sin(angle)
    matrix = np.eye(3)
    i, j = [n for n in range(3) if n != axis]
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = s, -s
    return matrix


def transforms(path, poses, names=None, **lens):
    """Write a transforms.json of [4, 4] world-to-camera poses, OpenCV axes."""
    names = names or [f"images/frame_{n:05d}.png" for n in range(101, 101 + len(poses))]
    frames = []
    for name, pose in zip(names, poses, strict=True):
        frames.append({"file_path": name, "transform_matrix": (np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])).tolist()})
    path.write_text(json.dumps({**(lens or PLAIN), "frames": frames}), encoding="utf-8")
    return path


def some_poses(count=10):
    poses = []
    for n in range(count):
        pose = np.eye(4)
        pose[:3, :3] = turned(0.1 * n) @ turned(0.05 * n, axis=0)
        pose[:3, 3] = (0.1 * n, -0.2, 0.3)
        poses.append(pose)
    return poses


def fake_solve(count, first=101, lens=None):
    lens = lens or imported.Lens("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    cameras = [imported.ImportedCamera(f"f_{first + n:04d}.png", np.eye(4)[:3], 0) for n in range(count)]
    return imported.ImportedSolve(Path("there"), "COLMAP model", [lens], cameras)


# ------------------------------------------------------------------------------------------------- reading


def test_transforms_come_out_with_opencv_axes(tmp_path):
    """nerfstudio cameras look along -z with y up. A point in front of and above such a camera stays there after
    import."""
    poses = some_poses()
    solve = imported.read(transforms(tmp_path / "transforms.json", poses))
    assert solve.kind == "transforms.json" and len(solve.cameras) == 10
    for camera, pose in zip(solve.cameras, poses, strict=True):
        np.testing.assert_allclose(camera.pose, pose[:3], atol=1e-12)
    assert solve.lenses == [imported.Lens("PINHOLE", 640, 480, (500.0, 510.0, 321.0, 239.0))]


@pytest.mark.parametrize(
    ("fields", "model", "bend"),
    [
        ({"k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": 0.002}, "OPENCV", (0.1, -0.02, 0.001, 0.002)),
        ({"k1": 0.1, "k3": 0.03}, "FULL_OPENCV", (0.1, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.4)),
        ({"camera_model": "PINHOLE"}, "PINHOLE", ()),
    ],
)
def test_the_lens_of_transforms(tmp_path, fields, model, bend):
    lens = imported.read(transforms(tmp_path / "t.json", some_poses(), **PLAIN, **fields)).lenses[0]
    assert (lens.model, lens.params[4:]) == (model, bend)


def test_lens_can_be_given_per_frame_or_as_an_angle(tmp_path):
    file = transforms(tmp_path / "t.json", some_poses(3), w=200, h=100, camera_angle_x=math.pi / 2)
    data = json.loads(file.read_text())
    data["frames"][1] |= {"fl_x": 90.0, "cx": 99.0}
    file.write_text(json.dumps(data))
    solve = imported.read(file)
    assert [c.lens for c in solve.cameras] == [0, 1, 0]
    assert solve.lenses[0].params == pytest.approx((100.0, 100.0, 100.0, 50.0))
    assert solve.lenses[1].params == pytest.approx((90.0, 90.0, 99.0, 50.0))


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", (500, 320, 240), ("PINHOLE", (500, 500, 320, 240))),
        ("SIMPLE_RADIAL", (500, 320, 240, 0.1), ("OPENCV", (500, 500, 320, 240, 0.1, 0, 0, 0))),
        ("RADIAL", (500, 320, 240, 0.1, 0.2), ("OPENCV", (500, 500, 320, 240, 0.1, 0.2, 0, 0))),
        ("RADIAL_FISHEYE", (500, 320, 240, 0.1, 0.2), ("OPENCV_FISHEYE", (500, 500, 320, 240, 0.1, 0.2, 0, 0))),
        ("OPENCV", (500, 501, 320, 240, 0, 0, 0, 0), ("PINHOLE", (500, 501, 320, 240))),
    ],
)
def test_colmap_lenses(model, params, expected):
    lens = imported.lens_from_colmap(model, 640, 480, params)
    assert (lens.model, lens.params) == expected


def test_an_ordinary_lens_bends_as_colmap_says():
    """SIMPLE_RADIAL and the converted model project to the same pixels in COLMAP, which runs in a separate process."""
    import subprocess
    import sys

    lens = imported.lens_from_colmap("SIMPLE_RADIAL", 320, 240, (300.0, 161.0, 119.0, -0.06)).scaled(640, 480)
    code = (
        "import pycolmap, numpy as np, json, sys; r = np.array([[.4, -.3, 1], [-.5, .2, 1]]);"
        "a = pycolmap.Camera(model='SIMPLE_RADIAL', width=320, height=240, params=[300, 161, 119, -.06]);"
        f"b = pycolmap.Camera(model='{lens.model}', width=640, height=480, params={list(lens.params)});"
        "print(abs(2 * a.img_from_cam(r) - b.img_from_cam(r)).max())"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(ran.stdout) < 1e-9


def test_a_colmap_model_reads_as_pycolmap_wrote_it(solved):
    """COLMAP wrote solve/colmap itself; cameras.json holds the same cameras by another code path."""
    solve = imported.read(solved.shot.solve / "colmap")
    path = {f.frame: f for f in CameraPath.load(solved.shot.solve / "cameras.json").frames}
    numbers = [int(c.name.rpartition(".")[0]) for c in solve.cameras]
    assert sorted(numbers) == list(range(101, 116, 2))
    for number, camera in zip(numbers, solve.cameras, strict=True):
        np.testing.assert_allclose(camera.pose, np.reshape(path[number].viewmat, (4, 4))[:3], atol=1e-9)
    record = read_json(solved.shot.solve / "solve.json")
    assert solve.lenses[0].params[0] == pytest.approx(record["focal_px"])
    assert solve.points is not None and solve.points["error"].mean() == pytest.approx(
        record["reprojection_error_px"], rel=0.2
    )


@pytest.mark.parametrize("text", [False, True])
def test_a_model_written_is_the_model_read(solved, tmp_path, text):
    model = read_model(solved.shot.solve / "colmap")
    write_model(tmp_path / "again", model, text)
    again = read_model(tmp_path / "again")
    assert again.cameras == model.cameras
    assert [(i.number, i.name, i.camera) for i in again.images] == [(i.number, i.name, i.camera) for i in model.images]
    for one, second in zip(model.images, again.images, strict=True):
        np.testing.assert_allclose(one.pose, second.pose, atol=1e-14)
    np.testing.assert_array_equal(again.points.xyz, model.points.xyz)
    np.testing.assert_array_equal(again.points.rgb, model.points.rgb)
    np.testing.assert_array_equal(again.points.error, model.points.error)


@pytest.mark.parametrize("below", ["sparse", "sparse/0"])
def test_the_model_is_found_below(solved, tmp_path, below):
    write_model(tmp_path / below, read_model(solved.shot.solve / "colmap"))
    assert len(imported.read(tmp_path).cameras) == 8
    assert len(imported.read(tmp_path / below / "cameras.bin").cameras) == 8


def test_broken_files_are_a_sentence(solved, tmp_path):
    files = {p.name: p.read_bytes() for p in (solved.shot.solve / "colmap").glob("*.bin")}
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        for cut in (0, 5, len(files[name]) // 2):
            for file_name, data in files.items():
                (tmp_path / file_name).write_bytes(data[:cut] if file_name == name else data)
            with pytest.raises(JobError, match=f"These cameras cannot be used: .*{name}"):
                imported.read(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"w": None}, "has no w"),
        ({"fl_x": None}, "has no fl_x"),
        ({"fl_x": -5}, "not above 0"),
        ({"k4": 0.5}, "k4"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"frames": []}, "lists no frames"),
        ({"frames": [{"file_path": "1.png", "transform_matrix": [[1, 2], [3, 4]]}]}, "transform_matrix"),
        ({"frames": [{"file_path": "1.png", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "scaled, sheared"),
    ],
)
def test_unusable_transforms_are_a_sentence(tmp_path, change, words):
    file = transforms(tmp_path / "t.json", some_poses())
    data = {k: v for k, v in {**json.loads(file.read_text()), **change}.items() if v is not None}
    file.write_text(json.dumps(data))
    with pytest.raises(JobError, match=words) as error:
        imported.read(file)
    assert error.value.exit_code == ExitCode.SOLVE


@pytest.mark.parametrize("make", [lambda p: p / "gone", lambda p: p])
def test_missing_cameras_give_a_readable_error(tmp_path, make):
    with pytest.raises(JobError, match="does not exist|contains no cameras"):
        imported.read(make(tmp_path))


# ------------------------------------------------------------------------------------------------- matching


@pytest.mark.parametrize(
    "template",
    ["{:06d}.png", "images/frame_{:05d}.jpg", "shot.{:d}.exr", "f_{:04d}_v2.png", "frame-{:04d}.png", "a\\({:d}).png"],
)
def test_cameras_are_found_by_the_numbers_in_the_names_of_their_pictures(template):
    solve = fake_solve(20, first=1001)
    for n, camera in enumerate(solve.cameras):
        camera.name = template.format(1001 + n)
    solve.cameras.append(imported.ImportedCamera("poster.png", solve.cameras[0].pose, 0))
    matched = imported.match(solve, Counted(list(range(1001, 1021))), (640, 480))
    assert [matched.cameras[n].name for n in range(1001, 1021)] == [template.format(n) for n in range(1001, 1021)]
    assert not matched.missing and not imported.remarks(solve, matched)


def test_cameras_of_two_clips_are_refused_by_their_names():
    solve = fake_solve(40)
    for n, camera in enumerate(solve.cameras):
        camera.name = f"{'right' if n % 2 else 'left'}/{n // 2:04d}.png"
    with pytest.raises(JobError, match=r"left/####\.png, right/####\.png"):
        imported.match(solve, Counted(list(range(20))), (640, 480))
    for camera in solve.cameras[1::2]:
        camera.name = camera.name.replace("/", "/9")
    matched = imported.match(solve, Counted(list(range(20))), (640, 480))
    assert matched.cameras[7].name == "left/0007.png" and not matched.missing


def test_a_picture_with_two_cameras_is_refused():
    solve = fake_solve(20)
    solve.cameras[3].name = solve.cameras[4].name
    with pytest.raises(JobError, match=r"f_0105\.png has two cameras"):
        imported.match(solve, Counted(list(range(101, 121))), (640, 480))


def test_matching_is_by_number_and_says_what_is_missing():
    solve = fake_solve(20)
    matched = imported.match(solve, Counted(list(range(105, 125))), (320, 240))
    assert sorted(matched.cameras) == list(range(105, 121)) and matched.missing == [121, 122, 123, 124]
    assert matched.cameras[110].name == "f_0110.png"
    assert imported.remarks(solve, matched)[0][0] == "4 frames have no camera in there: frames 121-124."


@pytest.mark.parametrize("lost", [[], [19], [3, 4, 11], [0]])
def test_zero_based_pictures_are_not_shifted_by_a_frame(lost):
    """In the last case the first picture has no camera, so it looks like a count from 1."""
    solve = fake_solve(20, first=0)
    solve.cameras = [c for n, c in enumerate(solve.cameras) if n not in lost]
    matched = imported.match(solve, Counted(list(range(1, 21)), clip=(1, 20)), (640, 480))
    step = 0 if lost == [0] else 1
    assert all(camera.name == f"f_{frame - step:04d}.png" for frame, camera in matched.cameras.items())
    assert len(matched.cameras) == len(solve.cameras)
    assert bool(step) == any("numbered 0 to" in words for words, _ in imported.remarks(solve, matched))


def test_too_few_or_another_shape_are_refused():
    with pytest.raises(JobError, match="Only 0 of the 20 frames.* numbered 500 to 509"):
        imported.match(fake_solve(10, first=500), Counted(list(range(1, 21))), (640, 480))
    with pytest.raises(JobError, match="Only 5 of the 20 frames"):
        imported.match(fake_solve(20), Counted(list(range(101, 121))), (640, 480), solved=None) and imported.match(
            fake_solve(5), Counted(list(range(101, 121))), (640, 480)
        )
    with pytest.raises(JobError, match="640 x 480 pixels, but the shot's frames have another aspect ratio, 640 x 360"):
        imported.match(fake_solve(20), Counted(list(range(101, 121))), (640, 360))


def test_frames_that_are_trained_on_are_what_is_counted():
    frames = list(range(101, 141))
    solve = fake_solve(40)
    solve.cameras = solve.cameras[1::2]  # every second frame; the frame step selects the other ones
    with pytest.raises(JobError, match="Only 0 of the 20 frames"):
        imported.match(solve, Counted(frames), (640, 480), solved=frames[::2])


def test_points_without_tracks_count_the_pictures_they_lie_in():
    lens = imported.Lens("PINHOLE", 100, 100, (100.0, 100.0, 50.0, 50.0))
    solve = fake_solve(3, lens=lens)
    solve.lenses.append(imported.Lens("PINHOLE", 200, 200, (200.0, 200.0, 100.0, 100.0)))
    for n, camera in enumerate(solve.cameras):
        camera.pose = np.concatenate([np.eye(3), [[-1.5 * n], [0.0], [0.0]]], axis=1)
        camera.lens = n % 2
    solve.points = {
        "xyz": np.array([[0.0, 0.0, 4.0], [0.0, 0.0, -4.0], [2.0, 0.0, 3.0]]),
        "rgb": np.zeros((3, 3), np.uint8),
        "error": np.array([1.0, 2.0, -1.0]),
        "seen": [np.zeros(0, np.int64)] * 3,
    }
    matched = imported.Matched({n: c for n, c in enumerate(solve.cameras)}, [])
    points = imported.stored_points(solve, matched, (200, 200))
    assert points is not None
    assert points["track"].tolist() == [2, 0, 2]
    assert points["depth"].tolist() == [4.0, -np.inf, 3.0]
    assert points["error"].tolist() == [1.5, 2.0, 0.0]  # mean of 2 and 1; no camera sees the second
    solve.points["seen"] = [np.array([0, 2]), np.array([1]), np.zeros(0, np.int64)]
    known_points = imported.stored_points(solve, matched, (200, 200))
    assert known_points is not None and known_points["track"].tolist() == [2, 1, 0]
    assert float(known_points["angle"]) == pytest.approx(math.degrees(math.atan(0.75)))
    assert imported.stored_points(fake_solve(3), matched, (200, 200)) is None


def test_what_blender_says_of_a_camera_of_its_scene_is_believed(tmp_path):
    """Such a file states that its numbers are the shot's, even if another count fits too. Its notes are passed on."""
    facts = {"world": "scene", "is_numbered_as_shot": True, "notes": [["One of two.", "Choose."], ["half"], 3]}
    names = [f"{n}.png" for n in range(1, 11)]
    counted = Counted(list(range(1, 13)), (1, 12), shift=-1)
    file = transforms(tmp_path / "transforms.json", some_poses(), names, **PLAIN, splannequin=facts)
    solve = imported.read(file)
    matched = imported.match(solve, counted, (640, 480))
    assert solve.world == "scene" and {n: c.name for n, c in matched.cameras.items()} == dict(enumerate(names, 1))
    said = [sentence for sentence, _ in imported.remarks(solve, matched)]
    assert said[0] == "One of two." and len(said) == 2 and "11-12" in said[1]
    data = json.loads(file.read_text())
    for strange in ({"world": 3, "notes": "x"}, [], "scene"):
        file.write_text(json.dumps({**data, "splannequin": strange}))
        assert (imported.read(file).world, imported.read(file).notes) == ("", [])
    file.write_text(json.dumps({**data, "frames": [{**data["frames"][0], "file_path": "five.png"}]}))
    with pytest.raises(JobError, match="cannot be used"):
        imported.read(file)


@pytest.mark.parametrize("ending", ["abc", "FBX", "usdc"])
def test_files_that_blender_reads_are_said_to_be_blenders(tmp_path, ending):
    (tmp_path / f"set.{ending}").write_bytes(b"x")
    with pytest.raises(JobError, match=f"Only Blender can read set.{ending}"):
        imported.read(tmp_path / f"set.{ending}")
