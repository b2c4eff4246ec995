"""Cameras from Blender's tracker, exported to other programs, and through Alembic, compared with their source."""

import json
import math
from pathlib import Path

import bpy
import numpy as np
import pytest

WIDTH, HEIGHT, FRAMES = 320, 240, 14
FOCAL, CENTRE, K1 = 300.0, (166.0, 111.0), -0.06


def look(position, yaw, pitch) -> np.ndarray:
    """[4, 4] world-to-camera, OpenCV axes."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    viewmat = np.eye(4)
    nod, turn = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]), np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    viewmat[:3, :3] = nod @ turn
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.array(position)
    return viewmat


TRUTH = [
    look((-0.9 + 1.5 * t, 0.1 * math.sin(5 * t), 0.4 * math.sin(3 * t)), -0.5 * (t - 0.5), 0.1 * math.sin(4 * t))
    for t in np.linspace(0, 1, FRAMES)
]


@pytest.fixture
def clip(tmp_path, pictures):
    """Numbered sequence from 101 on, loaded as movie clip."""
    for n in range(FRAMES):
        pictures.write(tmp_path / f"take é.{101 + n:04d}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    return bpy.data.movieclips.load(str(tmp_path / "take é.0101.png"))


@pytest.fixture
def tracked(clip):
    """Clip with tracks of points projected by `TRUTH` and a distorted lens, solved by Blender."""
    camera = clip.tracking.camera
    camera.units, camera.distortion_model = "PIXELS", "POLYNOMIAL"
    camera.focal_length_pixels, camera.k1 = FOCAL, K1
    camera.principal_point_pixels = (CENTRE[0], HEIGHT - CENTRE[1])
    points = np.random.default_rng(0).uniform([-1.2, -0.9, 3], [1.2, 0.9, 6], (40, 3))
    tracker = clip.tracking.objects[0]
    for number, point in enumerate(points):
        track = tracker.tracks.new(name=f"t{number}", frame=1)
        for n, viewmat in enumerate(TRUTH):
            x, y, z = viewmat[:3, :3] @ point + viewmat[:3, 3]
            bent = 1.0 + K1 * (x * x + y * y) / (z * z)
            pixel = FOCAL * x / z * bent + CENTRE[0], FOCAL * y / z * bent + CENTRE[1]
            track.markers.insert_frame(n + 1, co=(pixel[0] / WIDTH, 1.0 - pixel[1] / HEIGHT))
    tracker.keyframe_a, tracker.keyframe_b = 1, FRAMES
    window = bpy.context.window_manager.windows[0]
    area = window.screen.areas[0]
    area.type = "CLIP_EDITOR"
    area.spaces.active.clip = clip
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        assert bpy.ops.clip.solve_camera() == {"FINISHED"}
    assert tracker.reconstruction.average_error < 0.01
    return clip


def opencv(matrices) -> np.ndarray:
    """[F, 4, 4] world-to-camera with OpenCV axes, from camera-to-world with OpenGL axes."""
    return np.linalg.inv(np.array(matrices) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def relative(viewmats) -> np.ndarray:
    """[F, 4, 4] poses relative to the first camera, scaled by the distance between first and last camera."""
    seen = np.array(viewmats) @ np.linalg.inv(viewmats[0])
    seen[:, :3, 3] /= np.linalg.norm(seen[-1, :3, 3])
    return seen


def test_what_blender_tracked_comes_out_as_it_was_filmed(addon, tracked):
    transforms = addon("solve.exchange").transforms(tracked)
    assert [f["file_path"] for f in transforms["frames"]] == [f"{n}.png" for n in range(101, 101 + FRAMES)]
    found = opencv([f["transform_matrix"] for f in transforms["frames"]])
    np.testing.assert_allclose(relative(found), relative(TRUTH), atol=1e-4)
    assert (transforms["w"], transforms["h"]) == (WIDTH, HEIGHT)
    assert [transforms[n] for n in ("fl_x", "fl_y", "cx", "cy")] == pytest.approx([FOCAL, FOCAL, *CENTRE])
    assert [transforms[n] for n in ("k1", "k2", "k3")] == pytest.approx([K1, 0.0, 0.0])


def test_tracked_camera_reaches_the_solve_request(addon, tracked, scene, shot):
    listing = shot / "frames" / "frames.json"
    listing.write_text(json.dumps({**json.loads(listing.read_text()), "key": "imported"}))
    props = scene.splannequin
    props.shot_path, props.cameras_from, props.tracking_clip = str(shot), "TRACKING", tracked
    params = addon("process.steps").STEPS["solve"].params(scene)
    assert params.cameras == str(shot / "tracking" / "transforms.json")
    assert json.loads(Path(params.cameras).read_text(encoding="utf-8")) == addon("solve.exchange").transforms(tracked)
    # The backend reads the file and finds another clip's frames: the test shot has frames 5 to 7 of 16 x 12.
    with pytest.raises(RuntimeError, match=r"Only 0 of the 3 frames needed, from 5 to 7, have a camera.* 101 to 114"):
        bpy.ops.splannequin.solve_camera()
    assert (shot / "solve" / "cameras.json").is_file(), "the solve that was there stays"


@pytest.mark.parametrize("template", ["frame-{:04d}.png", "2026-11-28-{:04d}.png", "f_{:04d}_left.png", "a ({}).png"])
def test_numbers_are_read_as_the_import_reads_them(addon, tmp_path, pictures, template):
    for n in range(101, 105):
        pictures.write(tmp_path / template.format(n), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    clip = bpy.data.movieclips.load(str(tmp_path / template.format(101)))
    assert addon("scene.same_footage").first_number(clip) == 101


def test_numbers_are_those_of_the_files(addon, clip):
    assert addon("scene.same_footage").first_number(clip) == 101
    clip.frame_offset = 3
    assert addon("scene.same_footage").first_number(clip) == 104


def test_pixels_that_are_not_square_have_two_focal_lengths(addon, clip):
    camera = clip.tracking.camera
    camera.units, camera.focal_length_pixels, camera.pixel_aspect = "PIXELS", 300.0, 1.25
    lens = addon("solve.exchange").lens(clip)
    assert (lens["fl_x"], lens["fl_y"]) == pytest.approx((300.0, 375.0))


@pytest.mark.parametrize(("model", "name"), [("DIVISION", "division_k1"), ("NUKE", "nuke_k1"), ("BROWN", "brown_p1")])
def test_unsupported_lens_models_are_refused_unless_undistorted(addon, contract, clip, model, name):
    clip.tracking.camera.distortion_model = model
    assert "k1" not in addon("solve.exchange").lens(clip)
    setattr(clip.tracking.camera, name, 0.01)
    with pytest.raises(contract.JobError, match=f"distortion model {model.title()}"):
        addon("solve.exchange").lens(clip)


def test_missing_cameras_are_said(addon, contract, scene, clip, shot):
    steps, props = addon("process.steps").STEPS, scene.splannequin
    props.shot_path, props.cameras_from = str(shot), "FILE"
    with pytest.raises(contract.JobError, match="No file with cameras is chosen"):
        steps["solve"].params(scene)
    props.cameras_path = str(shot / "x" / ".." / "model")
    assert steps["solve"].params(scene).cameras == str(shot / "model")
    props.cameras_from = "TRACKING"
    with pytest.raises(contract.JobError, match="No tracked clip is chosen"):
        steps["solve"].params(scene)
    props.tracking_clip = clip
    with pytest.raises(contract.JobError, match="is not solved"):
        steps["solve"].params(scene)
    props.cameras_from = "SOLVE"
    assert steps["solve"].params(scene) == contract.SolveParams()


def test_an_st_map_is_handed_on_with_its_way_and_only_where_the_lens_is_ours_to_find(addon, contract, scene, shot):
    solve, props = addon("process.steps").STEPS["solve"], scene.splannequin
    props.shot_path, props.st_map_way, props.st_map_layer = str(shot), "redistort", " back "
    assert solve.params(scene) == contract.SolveParams(), "without a file the rest says nothing"
    props.st_map = str(shot / "x" / ".." / "lens.exr")
    params = solve.params(scene)
    assert (params.st_map, params.st_map_way, params.st_map_layer) == (str(shot / "lens.exr"), "redistort", "back")
    props.cameras_from, props.cameras_path = "FILE", str(shot / "model")
    assert solve.params(scene).st_map == "", "imported cameras already have a lens"


@pytest.mark.parametrize("kind", ["colmap_text", "nerfstudio"])
def test_the_export_button_writes_every_camera(scene, shot, tmp_path, contract, kind):
    scene.splannequin.shot_path = str(shot)
    out = tmp_path / "out é"
    assert bpy.ops.splannequin.export_cameras(directory=str(out), format=kind) == {"FINISHED"}
    path = contract.CameraPath.load(shot / "solve" / "cameras.json")
    names = {
        "colmap_text": {"cameras.txt", "images.txt", "points3D.txt"},
        "nerfstudio": {"transforms.json", "points.ply"},
    }[kind]
    assert {p.name for p in out.iterdir()} == names
    if kind == "colmap_text":
        assert "1 PINHOLE 16 12 20.0 20.0 9.0 5.0" in (out / "cameras.txt").read_text()
        assert [line.split()[-1] for line in (out / "images.txt").read_text().splitlines() if ".png" in line] == [
            "000005.png", "000006.png", "000007.png"
        ]  # fmt: skip
        assert sum(not line.startswith("#") for line in (out / "points3D.txt").read_text().splitlines()) == 20
    if kind == "nerfstudio":
        transforms = json.loads((out / "transforms.json").read_text())
        found = opencv([f["transform_matrix"] for f in transforms["frames"]])
        np.testing.assert_allclose(found, np.reshape([f.viewmat for f in path.frames], (-1, 4, 4)), atol=1e-9)
        assert all((out / f["file_path"]).is_file() for f in transforms["frames"])


def test_the_export_button_says_what_is_wrong(scene, shot, tmp_path):
    with pytest.raises(RuntimeError, match="Solve the camera first"):
        bpy.ops.splannequin.export_cameras(directory=str(tmp_path / "out"))
    scene.splannequin.shot_path = str(shot)
    bpy.ops.splannequin.export_cameras(directory=str(tmp_path / "out"))
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"cameras.bin", "images.bin", "points3D.bin"}
    with pytest.raises(RuntimeError, match=r"already contains another COLMAP model \(cameras\.bin\)"):
        bpy.ops.splannequin.export_cameras(directory=str(tmp_path / "out"), format="colmap_text")


@pytest.mark.parametrize("well", [True, False])
def test_an_export_in_a_window_is_followed_without_waiting(addon, contract, scene, shot, tmp_path, well):
    solves, supervisor = addon("solve.exchange"), addon("process.job_timer")
    scene.splannequin.shot_path = str(shot)
    question = solves.begin_export(contract.ExportWords(str(shot if well else tmp_path), output=str(tmp_path / "out")))
    tell = addon("solve.operators").tell
    supervisor.when_answered(question, lambda: tell(shot, lambda: [solves.exported(question, tmp_path / "out")]))
    supervisor.tick()
    watch = supervisor.watch_of(shot)
    assert not watch.notes and not watch.failures
    question.wait(60)
    supervisor.tick()
    said = watch.notes["solve"][0] if well else watch.failures["solve"][0]
    assert (str(tmp_path / "out") if well else "is not a shot folder") in said


def test_command_line_exports_and_imports_cameras(addon, shot, tmp_path, capfd):
    main = addon("command_line.headless").main
    assert main(["export", str(shot), "--format", "nerfstudio", "--output", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "transforms.json").is_file()
    assert main(["export", str(tmp_path / "nowhere"), "--output", str(tmp_path / "out")]) == 2
    assert "is not a shot folder" in capfd.readouterr().err
    assert main(["solve", str(shot), "--cameras", str(tmp_path / "gone")]) == 4
    assert "gone does not exist" in capfd.readouterr().err


def test_alembic_carries_the_camera(addon, scene, shot, tmp_path):
    """The solved camera survives a round trip through Blender's own Alembic export and import."""
    if not bpy.app.alembic.supported:
        pytest.skip("this Blender was built without Alembic")
    scene.splannequin.shot_path = str(shot)
    bpy.ops.splannequin.load_camera()

    def state(camera):
        states = []
        for frame in (5, 6, 7):
            bpy.context.scene.frame_set(frame)
            graph = bpy.context.evaluated_depsgraph_get()
            seen = camera.evaluated_get(graph)
            states.append(np.concatenate([np.array(seen.matrix_world.normalized()).ravel(), [seen.data.angle_x]]))
        return np.array(states)

    before = state(scene.camera)
    assert np.abs(before[0] - before[2]).max() > 0.05
    file, fps = str(tmp_path / "camera.abc"), (scene.render.fps, scene.render.fps_base)
    for item in scene.objects:
        item.select_set(item == scene.camera)
    bpy.ops.wm.alembic_export(filepath=file, start=5, end=7, selected=True, as_background_job=False)
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = fps
    bpy.ops.wm.alembic_import(filepath=file, as_background_job=False)
    camera = next(o for o in scene.objects if o.type == "CAMERA")
    np.testing.assert_allclose(state(camera), before, atol=1e-5)
