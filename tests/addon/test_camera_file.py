"""Cameras in Alembic, FBX and USD files: written by this Blender, read by another, compared with the source camera."""

import json

import bpy
import numpy as np
import pytest

FIRST, LAST = 5, 7  # of the test shot, whose frames are 16 x 12


def animated(scene, name, film=(24.0, 18.0), end=1.0):
    """Camera that moves over the shot's frames and uses only what files can store: film back of the frames' shape,
    shift."""
    data = bpy.data.cameras.new(name)
    data.sensor_width, data.sensor_height, data.lens = *film, 28.0
    data.sensor_fit, data.shift_x, data.shift_y = "HORIZONTAL", 0.12, -0.07
    camera = bpy.data.objects.new(name, data)
    scene.collection.objects.link(camera)
    for frame, share in ((FIRST, 0.0), (LAST, end)):
        camera.location, camera.rotation_euler = (1 + share, -2 + 0.3 * share, 1.5), (1.3 + 0.1 * share, 0.2, 0.3)
        for path in ("location", "rotation_euler"):
            camera.keyframe_insert(path, frame=frame)
    return camera


def seen(addon, scene, camera):
    """The camera's samples. `test_scene_camera` compares such samples with Blender's projection."""
    evaluated, sample_of = addon("shot.seen_camera").evaluated, addon("solve.camera_samples").sample_of
    numbers = range(FIRST, LAST + 1)
    return [sample_of(n, *evaluated(scene, camera.name, n, (16, 12))[:2], (16, 12)) for n in numbers]


def export(path):
    """Export the whole scene as a file."""
    if path.suffix == ".abc":
        if not bpy.app.alembic.supported:
            pytest.skip("this Blender was built without Alembic")
        bpy.ops.wm.alembic_export(filepath=str(path), start=FIRST, end=LAST, as_background_job=False)
    elif path.suffix == ".fbx":
        if "fbx" not in dir(bpy.ops.export_scene):
            pytest.skip("this Blender has no exporter for FBX")
        bpy.ops.export_scene.fbx(filepath=str(path), bake_anim_use_all_actions=False, bake_anim_use_nla_strips=False)
    else:
        if not bpy.app.usd.supported:
            pytest.skip("this Blender was built without USD")
        bpy.ops.wm.usd_export(filepath=str(path), export_animation=True)


@pytest.fixture
def filmed(scene, shot):
    """Scene with the shot's size, rate and range, without the scene's default camera."""
    scene.splannequin.shot_path, scene.splannequin.cameras_from = str(shot), "FILE"
    scene.render.resolution_x, scene.render.resolution_y = 16, 12
    fps = json.loads((shot / "shot.json").read_text(encoding="utf-8"))["fps"]
    scene.render.fps, scene.render.fps_base = round(fps), round(fps) / fps
    scene.frame_start, scene.frame_end = FIRST, LAST
    for item in list(scene.objects):
        bpy.data.objects.remove(item)
    return scene


@pytest.mark.parametrize("ending", [".abc", ".usdc", ".fbx"])
def test_a_camera_comes_back_from_a_file(addon, filmed, shot, tmp_path, ending):
    """Reading the file adds no data-block to the artist's file."""
    camera = animated(filmed, "match")
    file = tmp_path / f"set é{ending}"
    export(file)
    filmed.splannequin.cameras_path = str(file)
    kinds = ("scenes", "objects", "cameras", "actions", "collections", "cache_files", "meshes")
    before = {kind: [b.name for b in getattr(bpy.data, kind)] for kind in kinds}
    filmed.frame_set(40)
    params = addon("process.steps").STEPS["solve"].params(filmed)
    assert params.cameras == str(shot / "tracking" / "transforms.json") and filmed.frame_current == 40
    assert {kind: [b.name for b in getattr(bpy.data, kind)] for kind in kinds} == before
    transforms = json.loads((shot / "tracking" / "transforms.json").read_text(encoding="utf-8"))
    assert transforms["splannequin"] == {"world": "scene", "is_numbered_as_shot": False, "notes": []}
    assert [f["file_path"] for f in transforms["frames"]] == ["5.png", "6.png", "7.png"]
    for found, wanted in zip(transforms["frames"], seen(addon, filmed, camera), strict=True):
        np.testing.assert_allclose(found["transform_matrix"], wanted.pose, atol=2e-5)
        np.testing.assert_allclose([transforms[n] for n in ("fl_x", "fl_y", "cx", "cy")], wanted.K, atol=2e-5)


@pytest.fixture
def reading(addon, filmed, tmp_path):
    """reading(): exports the scene, reads the file in this Blender as the child does, and returns the result."""
    if not bpy.app.alembic.supported:
        pytest.skip("this Blender was built without Alembic")

    def read():
        file = tmp_path / "set.abc"
        export(file)
        for item in list(filmed.objects):  # avoids renamed imports
            bpy.data.objects.remove(item)
        scene = bpy.data.scenes.new("empty")
        render = filmed.render
        scene.render.resolution_x, scene.render.resolution_y = 16, 12
        scene.render.fps, scene.render.fps_base = render.fps, render.fps_base
        with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
            return addon("solve.camera_file").read(scene, file, (16, 12))

    return read


def test_of_several_cameras_the_first_that_moves_is_taken_and_said(filmed, reading):
    animated(filmed, "b")
    animated(filmed, "a", end=0.0)
    animated(filmed, "c")
    message = reading()
    assert message["splannequin"]["notes"][0][0] == "set.abc contains 3 cameras. b was used, the first that moves."


def test_a_film_back_of_another_shape_is_said_and_its_width_is_the_frames(filmed, reading):
    animated(filmed, "wide", film=(36.0, 20.25))
    message = reading()
    assert message["fl_x"] == pytest.approx(28.0 / 36.0 * 16) and message["fl_y"] == pytest.approx(message["fl_x"])
    assert "is 36 x 20.25 mm, which is a different aspect ratio" in message["splannequin"]["notes"][0][0]


def test_a_file_without_a_camera_that_moves_is_refused(contract, filmed, reading):
    with pytest.raises(contract.JobError, match="set.abc contains no camera"):
        reading()
    animated(filmed, "still", end=0.0)
    with pytest.raises(contract.JobError, match="No camera of set.abc moves"):
        reading()


def test_what_is_no_such_file_is_refused_in_a_sentence(addon, contract, filmed, shot, tmp_path):
    file = tmp_path / "broken.fbx"
    file.write_bytes(b"Kaydara FBX Binary  \x00" + bytes(range(256)))
    filmed.splannequin.cameras_path = str(file)
    with pytest.raises(contract.JobError, match=r"^Blender could not read broken\.fbx: .+\.$") as refusal:
        addon("process.steps").STEPS["solve"].params(filmed)
    assert refusal.value.exit_code == contract.ExitCode.SOLVE and not (shot / "tracking").exists()
    filmed.splannequin.cameras_path = str(tmp_path / "gone.fbx")
    with pytest.raises(contract.JobError, match="does not exist"):
        addon("process.steps").STEPS["solve"].params(filmed)


def test_timer_waits_for_the_second_blender_and_kills_it_on_cancel(addon, filmed, shot, tmp_path):
    animated(filmed, "match")
    file = tmp_path / "set.fbx"
    export(file)
    filmed.splannequin.cameras_path = str(file)
    exchange = addon("solve.exchange")
    turns = exchange.read_in_turns(filmed, shot)
    assert next(turns).text == "Reading the cameras of set.fbx"
    child = turns.gi_frame.f_locals["question"]
    turns.close()
    child.wait(30)
    assert child.process.returncode != 0 and not (shot / "tracking").exists()


def test_the_command_line_reads_it(addon, filmed, shot, tmp_path, capfd):
    """Cameras are matched by the backend, which then finds that the test shot lacks the pictures as filmed."""
    animated(filmed, "match")
    file = tmp_path / "set.fbx"
    export(file)
    main = addon("command_line.headless").main
    assert main(["solve", str(shot), "--cameras", str(file)]) == 3
    assert "Damaged or missing" in capfd.readouterr().err
    assert len(json.loads((shot / "tracking" / "transforms.json").read_text(encoding="utf-8"))["frames"]) == 3
    assert main(["solve", str(shot), "--cameras", str(tmp_path / "gone.usd")]) == 4
    assert "gone.usd does not exist" in capfd.readouterr().err
