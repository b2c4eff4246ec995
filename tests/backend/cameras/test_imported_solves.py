"""Whole solves with imported cameras of the rendered room, and round trips through export and import."""

import json
import math
import shutil

import numpy as np
import pytest

from tests.backend.cameras.test_imported import some_poses, transforms
from torch_backend.cameras import imported
from torch_backend.cameras.colmap_files import read_model
from torch_backend.cameras.export import export_cameras
from torch_backend.cameras.stored import load_points
from torch_backend.contract import CameraFrame, CameraPath, JobError, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import read_png
from torch_backend.footage.pairing import Counted
from torch_backend.lens.plate_lens import load_plate_lenses
from torch_backend.lens.undistort import Undistorter
from torch_backend.sfm.imported_cameras import doubts, refuse_misfit
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot


@pytest.fixture(scope="module")
def fresh(solved, tools, tmp_path_factory):
    """fresh(folder): new shot of the room's raw frames, all of them to be solved."""
    made = Shot.create(tmp_path_factory.mktemp("fresh") / "again.splannequin")
    import_footage(made, solved.shot.info().source, FootageConfig(step=1), tools.recorder())
    return lambda folder: Shot(shutil.copytree(made.root, folder / made.root.name))


def the_lens(scale=1):
    return {
        "w": 320 * scale, "h": 240 * scale, "fl_x": 300.0 * scale, "cx": 160.0 * scale, "cy": 120.0 * scale, "k1": -0.06
    }  # fmt: skip


def test_true_cameras_of_two_lenses_give_a_solve_in_their_world_space(solved, fresh, tools, tmp_path):
    """The room's true cameras at twice the picture size, without points: poses are exact, points lie on the walls.

    Every frame is undistorted with its own lens, and keeps it.
    """
    shot = fresh(tmp_path)
    report = tools.recorder()
    poses = solved.poses[:13]
    file = transforms(tmp_path / "transforms.json", poses, **the_lens(2), splannequin={"world": "scene"})
    data = json.loads(file.read_text())
    for frame in data["frames"][10:]:
        frame["k1"] = -0.0601
    file.write_text(json.dumps(data))
    result = solve_shot(shot, SolveConfig(features=1000), report, str(file))
    path = CameraPath.load(shot.solve / "cameras.json")
    assert [f.frame for f in path.frames] == list(range(101, 116))
    assert [f.source for f in path.frames] == ["registered"] * 13 + ["interpolated"] * 2
    for frame, pose in zip(path.frames, poses, strict=False):
        np.testing.assert_allclose(np.reshape(frame.viewmat, (4, 4)), pose, atol=1e-9)
    assert any("frames 114-115" in w for w in report.warnings)
    xyz = load_points(shot)["xyz"]
    walls = np.minimum(np.abs(xyz - [-2.0, -1.5, -1.0]), np.abs(xyz - [2.0, 1.5, 5.0])).min(1)
    block = np.minimum(np.abs(xyz - [-0.9, 0.1, 1.8]), np.abs(xyz - [0.1, 1.5, 2.8])).min(1)
    assert len(xyz) > 300 and np.median(np.minimum(walls, block)) < 0.02
    # The undistorted frame equals the pinhole camera's picture.
    ideal = tools.room().render(poses[7], path.frames[7].K).astype(float)
    shifted = tools.room().render(poses[7], np.add(path.frames[7].K, (0, 0, 0.5, 0))).astype(float)
    got = read_png(shot.frames / "000108.png").astype(float)
    assert np.sqrt(((got - ideal) ** 2).mean()) < 0.5 * np.sqrt(((shifted - ideal) ** 2).mean()) + 2.0
    Ks = np.array([f.K for f in path.frames])
    assert len({k[0] for k in Ks.tolist()}) == 2 and Ks[9, 0] != Ks[10, 0] and Ks[10, 0] == Ks[12, 0]
    assert len(read_model(shot.solve / "colmap").cameras) == 13
    lenses = load_plate_lenses(shot)
    assert lenses[110].lens.params[4] != lenses[111].lens.params[4]
    for frame in (105, 112):
        undistort = Undistorter(lenses[frame].where(320, 240))
        difference = undistort(read_png(shot.frames / f"raw/{frame:06d}.png")).astype(int)
        assert np.abs(difference - read_png(shot.frames / f"{frame:06d}.png")).max() <= 1
    record = read_json(shot.solve / "solve.json")
    assert (record["camera_model"], record["focal_px"], record["cameras_from"]) == ("OPENCV", 300.0, "transforms.json")
    assert record["world"] == "scene" and read_json(solved.shot.solve / "solve.json")["world"] == ""
    assert result["quality"].startswith("Fair: cameras imported for 13 of 15 frames, ")
    assert result["reprojection_error_px"] < 0.8
    assert (shot.solve / "colmap" / "images.bin").is_file()
    before = (shot.solve / "solve.json").stat().st_mtime_ns
    assert solve_shot(shot, SolveConfig(features=1000), tools.recorder(), str(file)) == result
    assert (shot.solve / "solve.json").stat().st_mtime_ns == before, "taken in once"


def test_colmap_folder_imports_its_points(solved, tools, tmp_path):
    shot, report = Shot.create(tmp_path / "again.splannequin"), tools.recorder()
    import_footage(shot, solved.shot.info().source, FootageConfig(step=2), tools.recorder())
    result = solve_shot(shot, SolveConfig(), report, str(solved.shot.solve / "colmap"))
    assert "features" not in {stage.removeprefix("solve: ") for stage, _, _ in report.steps}
    was, now = (CameraPath.load(s.solve / "cameras.json").frames for s in (solved.shot, shot))
    for one, second in zip(was[::2], now[::2], strict=True):
        np.testing.assert_allclose(second.viewmat, one.viewmat, atol=1e-9)
        np.testing.assert_allclose(second.K, one.K, rtol=1e-6)
    assert [f.source for f in now[1::2]] == ["interpolated"] * 7
    one, second = load_points(solved.shot), load_points(shot)
    np.testing.assert_allclose(second["xyz"], one["xyz"])
    # COLMAP may count an image twice if the image observes a point twice.
    assert (second["track"] <= one["track"]).all() and (second["track"] == one["track"]).mean() > 0.9
    assert result["registered"] == 8 and result["quality"].startswith("Good: cameras imported for 8 of 8 frames")
    difference = read_png(shot.frames / "000105.png").astype(int) - read_png(solved.shot.frames / "000105.png")
    assert np.abs(difference).max() <= 1


def test_cameras_of_another_clip_and_cameras_that_stand_still_are_refused(solved, fresh, tools, tmp_path):
    shot = fresh(tmp_path)
    wrong = [tools.look([3.0 * math.sin(n), n, 2.0 * n], yaw=2.0 * n, pitch=1.1 * n) for n in range(15)]
    for poses, words in (
        (wrong, "do not fit these frames"),
        ([np.eye(4)] * 15, "do not fit these frames: only 0 points"),
    ):
        file = transforms(tmp_path / "transforms.json", poses, **the_lens())
        with pytest.raises(JobError, match=words):
            solve_shot(shot, SolveConfig(features=150), tools.recorder(), str(file))
        assert not shot.cameras.exists() and not (shot.solve / "scratch").exists()


@pytest.mark.parametrize(("kind", "text"), [("colmap", True), ("nerfstudio", False)])
def test_what_goes_out_comes_back_in(solved, tools, tmp_path, kind, text):
    """Exported cameras are imported by a new shot of the same undistorted frames, with equal poses and lens."""
    plates = tmp_path / "plates"
    plates.mkdir()
    for file in solved.shot.frames.glob("*.png"):
        (plates / file.name).write_bytes(file.read_bytes())
    shot = Shot.create(tmp_path / "fresh.splannequin")
    import_footage(shot, str(plates / "000101.png"), FootageConfig(step=2), tools.recorder())
    written = export_cameras(solved.shot, kind, tmp_path / "out" / "é", text)
    assert all(file.is_file() for file in written)
    report = tools.recorder()
    result = solve_shot(shot, SolveConfig(features=500), report, str(tmp_path / "out" / "é"))
    one, second = (CameraPath.load(s.solve / "cameras.json") for s in (solved.shot, shot))
    assert [f.frame for f in second.frames] == [f.frame for f in one.frames]
    np.testing.assert_allclose([f.viewmat for f in second.frames], [f.viewmat for f in one.frames], atol=1e-6)
    np.testing.assert_allclose([f.K for f in second.frames], [f.K for f in one.frames], atol=1e-6)
    assert result["registered"] == 8 and report.warnings == []
    assert (read_png(shot.frames / "000110.png") == read_png(solved.shot.frames / "000110.png")).all()
    if kind == "colmap":
        was, now = (load_points(s)["xyz"] for s in (solved.shot, shot))
        assert len(now) > 0.98 * len(was)
        assert {tuple(p) for p in now.tolist()} <= {tuple(p) for p in was.tolist()}
    else:
        data = read_json(tmp_path / "out" / "é" / "transforms.json")
        plate = tmp_path / "out" / "é" / data["frames"][0]["file_path"]
        assert plate.resolve() == (solved.shot.frames / "000101.png").resolve()


def test_colmap_itself_reads_what_is_exported(solved, tmp_path):
    """pycolmap reads the export in a separate process: names, poses, pinhole, and points that project as expected."""
    import subprocess
    import sys

    export_cameras(solved.shot, "colmap", tmp_path / "bin")
    export_cameras(solved.shot, "colmap", tmp_path / "txt", text=True)
    code = (
        "import pycolmap, sys, json\n"
        "for folder in sys.argv[1:]:\n"
        "    m = pycolmap.Reconstruction(folder)\n"
        "    i = next(i for i in m.images.values() if i.name == '000107.png'); c = i.camera\n"
        "    print(json.dumps([m.num_reg_images(), m.num_points3D(), c.model_name, list(c.params), c.width,"
        "i.cam_from_world().matrix().tolist(), m.compute_mean_reprojection_error()]))"
    )
    frame = next(f for f in CameraPath.load(solved.shot.solve / "cameras.json").frames if f.frame == 107)
    command = [sys.executable, "-c", code, tmp_path / "bin", tmp_path / "txt"]
    answers = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(answers) == 2
    for answer in answers:
        images, points, model, params, width, pose, error = json.loads(answer)
        assert (images, points, model, width) == (15, len(load_points(solved.shot)["xyz"]), "PINHOLE", 320)
        np.testing.assert_allclose(params, frame.K, rtol=1e-12)
        np.testing.assert_allclose(pose, np.reshape(frame.viewmat, (4, 4))[:3], atol=1e-12)
        assert error == pytest.approx(float(load_points(solved.shot)["error"].mean()), rel=1e-3)


def test_an_export_never_hides_behind_another_model(solved, tmp_path):
    export_cameras(solved.shot, "colmap", tmp_path)
    with pytest.raises(JobError, match=r"already contains another COLMAP model \(cameras\.bin\)"):
        export_cameras(solved.shot, "colmap", tmp_path, text=True)
    export_cameras(solved.shot, "colmap", tmp_path)
    with pytest.raises(JobError, match="has no cameras yet"):
        export_cameras(Shot.create(tmp_path / "new.splannequin"), "colmap", tmp_path / "out")


def test_how_much_agrees_decides():
    """The reprojection error cannot decide: cameras are fixed, and observations that do not fit are dropped from it."""
    answer = {"triangulation_angle_deg": 5.0, "agreement": 0.6}
    refuse_misfit(answer, 500)
    assert doubts(answer) == [] and doubts({"triangulation_angle_deg": 5.0}) == []
    assert "Only 40 %" in doubts({**answer, "agreement": 0.4})[0][0]
    with pytest.raises(JobError, match="only 500 points of the scene, and 20 % of the matches agree"):
        refuse_misfit({**answer, "agreement": 0.2}, 500)
    with pytest.raises(JobError, match="only 99 points"):
        refuse_misfit(answer, 99)
    with pytest.raises(JobError, match="moves too little"):
        refuse_misfit({**answer, "triangulation_angle_deg": 1.0}, 500)


def test_refused_cameras_keep_the_existing_solve(solved, tools, tmp_path):
    before = (solved.shot.solve / "cameras.json").read_bytes()
    file = transforms(tmp_path / "t.json", some_poses(6), [f"{n}.png" for n in range(6)], **the_lens())
    with pytest.raises(JobError, match="Only 3 of the 8 frames"):
        solve_shot(solved.shot, SolveConfig(features=1500), tools.recorder(), str(file))
    assert (solved.shot.solve / "cameras.json").read_bytes() == before


def test_a_camera_path_comes_in_by_its_frame_numbers(tmp_path):
    frames = [CameraFrame(n, np.eye(4).ravel().tolist(), [400.0, 400.0, 320.0, 240.0]) for n in range(1, 12)]
    file = tmp_path / "path.json"
    file.write_text(json.dumps(CameraPath(640, 480, frames).to_json()))
    solve = imported.read(file)
    matched = imported.match(solve, Counted(list(range(2, 13))), (320, 240))
    assert solve.kind == "camera path" and matched.missing == [12] and not matched.notes
    assert solve.lenses[0].scaled(320, 240).params == (200.0, 200.0, 160.0, 120.0)
