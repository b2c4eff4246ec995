"""Whole solves with imported cameras of the rendered room, and round trips through export and import."""

import json
import math

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


def again(solved, tools, folder, step=1):
    """New shot of the room's raw frames."""
    shot = Shot.create(folder / "again.splannequin")
    import_footage(shot, solved.shot.info().source, FootageConfig(step=step), tools.recorder())
    return shot


def the_lens(scale=1):
    return {
        "w": 320 * scale, "h": 240 * scale, "fl_x": 300.0 * scale, "cx": 160.0 * scale, "cy": 120.0 * scale, "k1": -0.06
    }  # fmt: skip


def test_true_cameras_give_a_solve_in_their_world_space(solved, tools, tmp_path):
    """The room's true cameras at twice the picture size, without points: poses are exact, points lie on the walls."""
    shot = again(solved, tools, tmp_path)
    report = tools.recorder()
    poses = solved.poses[:18]
    file = transforms(tmp_path / "transforms.json", poses, **the_lens(2), splannequin={"world": "scene"})
    result = solve_shot(shot, SolveConfig(features=1500), report, str(file))
    path = CameraPath.load(shot.solve / "cameras.json")
    assert [f.frame for f in path.frames] == list(range(101, 122))
    assert [f.source for f in path.frames] == ["registered"] * 18 + ["interpolated"] * 3
    for frame, pose in zip(path.frames, poses, strict=False):
        np.testing.assert_allclose(np.reshape(frame.viewmat, (4, 4)), pose, atol=1e-9)
    assert any("frames 119-121" in w for w in report.warnings)
    xyz = load_points(shot)["xyz"]
    walls = np.minimum(np.abs(xyz - [-2.0, -1.5, -1.0]), np.abs(xyz - [2.0, 1.5, 5.0])).min(1)
    block = np.minimum(np.abs(xyz - [-0.9, 0.1, 1.8]), np.abs(xyz - [0.1, 1.5, 2.8])).min(1)
    assert len(xyz) > 300 and np.median(np.minimum(walls, block)) < 0.02
    # The undistorted frame equals the pinhole camera's picture.
    ideal = tools.room().render(poses[7], path.frames[7].K).astype(float)
    shifted = tools.room().render(poses[7], np.add(path.frames[7].K, (0, 0, 0.5, 0))).astype(float)
    got = read_png(shot.frames / "000108.png").astype(float)
    assert np.sqrt(((got - ideal) ** 2).mean()) < 0.5 * np.sqrt(((shifted - ideal) ** 2).mean()) + 2.0
    record = read_json(shot.solve / "solve.json")
    assert (record["camera_model"], record["focal_px"], record["cameras_from"]) == ("OPENCV", 300.0, "transforms.json")
    assert record["world"] == "scene" and read_json(solved.shot.solve / "solve.json")["world"] == ""
    assert result["quality"].startswith("Fair: cameras imported for 18 of 21 frames, ")
    assert result["reprojection_error_px"] < 0.8
    assert (shot.solve / "colmap" / "images.bin").is_file()
    before = (shot.solve / "solve.json").stat().st_mtime_ns
    assert solve_shot(shot, SolveConfig(features=1500), tools.recorder(), str(file)) == result
    assert (shot.solve / "solve.json").stat().st_mtime_ns == before, "taken in once"


def test_colmap_folder_imports_its_points(solved, tools, tmp_path):
    shot = again(solved, tools, tmp_path, step=2)
    report = tools.recorder()
    result = solve_shot(shot, SolveConfig(), report, str(solved.shot.solve / "colmap"))
    assert "features" not in {stage.removeprefix("solve: ") for stage, _, _ in report.steps}
    was, now = (CameraPath.load(s.solve / "cameras.json").frames for s in (solved.shot, shot))
    for one, second in zip(was[::2], now[::2], strict=True):
        np.testing.assert_allclose(second.viewmat, one.viewmat, atol=1e-9)
        np.testing.assert_allclose(second.K, one.K, rtol=1e-6)
    assert [f.source for f in now[1::2]] == ["interpolated"] * 10
    one, second = load_points(solved.shot), load_points(shot)
    np.testing.assert_allclose(second["xyz"], one["xyz"])
    # COLMAP may count an image twice if the image observes a point twice.
    assert (second["track"] <= one["track"]).all() and (second["track"] == one["track"]).mean() > 0.9
    assert result["registered"] == 11 and result["quality"].startswith("Good: cameras imported for 11 of 11 frames")
    difference = read_png(shot.frames / "000105.png").astype(int) - read_png(solved.shot.frames / "000105.png")
    assert np.abs(difference).max() <= 1


def test_two_lenses_in_one_clip(solved, tools, tmp_path):
    """Lens values per frame: every frame is undistorted with its own lens, and keeps it."""
    shot = again(solved, tools, tmp_path)
    file = transforms(tmp_path / "transforms.json", solved.poses, **the_lens())
    data = json.loads(file.read_text())
    for frame in data["frames"][10:]:
        frame["k1"] = -0.0601
    file.write_text(json.dumps(data))
    solve_shot(shot, SolveConfig(features=1000), tools.recorder(), str(file))
    Ks = np.array([f.K for f in CameraPath.load(shot.solve / "cameras.json").frames])
    assert len({k[0] for k in Ks.tolist()}) == 2 and Ks[9, 0] != Ks[10, 0] and Ks[10, 0] == Ks[20, 0]
    assert len(load_points(shot)["xyz"]) > 200
    assert len(read_model(shot.solve / "colmap").cameras) == 21
    lenses = load_plate_lenses(shot)
    assert lenses[110].lens.params[4] != lenses[111].lens.params[4]
    for frame in (105, 115):
        undistort = Undistorter(lenses[frame].where(320, 240))
        difference = undistort(read_png(shot.frames / f"raw/{frame:06d}.png")).astype(int)
        assert np.abs(difference - read_png(shot.frames / f"{frame:06d}.png")).max() <= 1


def test_cameras_of_another_clip_are_refused(solved, tools, tmp_path):
    shot = again(solved, tools, tmp_path)
    wrong = [tools.look([3.0 * math.sin(n), n, 2.0 * n], yaw=2.0 * n, pitch=1.1 * n) for n in range(21)]
    file = transforms(tmp_path / "transforms.json", wrong, **the_lens())
    with pytest.raises(JobError, match="do not fit these frames"):
        solve_shot(shot, SolveConfig(features=800), tools.recorder(), str(file))
    assert not (shot.solve / "cameras.json").exists()


@pytest.mark.parametrize(("kind", "text"), [("colmap", False), ("colmap", True), ("nerfstudio", False)])
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
    result = solve_shot(shot, SolveConfig(features=1000), report, str(tmp_path / "out" / "é"))
    one, second = (CameraPath.load(s.solve / "cameras.json") for s in (solved.shot, shot))
    assert [f.frame for f in second.frames] == [f.frame for f in one.frames]
    np.testing.assert_allclose([f.viewmat for f in second.frames], [f.viewmat for f in one.frames], atol=1e-6)
    np.testing.assert_allclose([f.K for f in second.frames], [f.K for f in one.frames], atol=1e-6)
    assert result["registered"] == 11 and report.warnings == []
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
        "import pycolmap, sys, json; m = pycolmap.Reconstruction(sys.argv[1]);"
        "i = next(i for i in m.images.values() if i.name == '000107.png'); c = i.camera;"
        "print(json.dumps([m.num_reg_images(), m.num_points3D(), c.model_name, list(c.params), c.width,"
        "i.cam_from_world().matrix().tolist(), m.compute_mean_reprojection_error()]))"
    )
    frame = next(f for f in CameraPath.load(solved.shot.solve / "cameras.json").frames if f.frame == 107)
    for folder in ("bin", "txt"):
        command = [sys.executable, "-c", code, tmp_path / folder]
        ran = subprocess.run(command, capture_output=True, text=True, check=True)
        images, points, model, params, width, pose, error = json.loads(ran.stdout)
        assert (images, points, model, width) == (21, len(load_points(solved.shot)["xyz"]), "PINHOLE", 320)
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


def test_static_cameras_are_refused(solved, tools, tmp_path):
    """No point can be triangulated."""
    shot = again(solved, tools, tmp_path)
    file = transforms(tmp_path / "transforms.json", [np.eye(4)] * 21, **the_lens())
    with pytest.raises(JobError, match="do not fit these frames: only 0 points"):
        solve_shot(shot, SolveConfig(features=300), tools.recorder(), str(file))
    assert not (shot.solve / "scratch").exists()


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
    file = transforms(tmp_path / "t.json", some_poses(10), [f"{n}.png" for n in range(10)], **the_lens())
    with pytest.raises(JobError, match="Only 5 of the 11 frames"):
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
