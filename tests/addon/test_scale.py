"""The scale of a solve is estimated from the camera's height above the floor until the artist sets it."""

import json

import bpy
import numpy as np
import pytest


def with_floor(shot, height, sway=0.0):
    """Give the solve a floor with cameras `height` solve units above it; heights alternate by the fraction `sway`."""
    record, cameras = (json.loads((shot / "solve" / name).read_text()) for name in ("solve.json", "cameras.json"))
    for n, frame in enumerate(cameras["frames"]):
        viewmat = np.eye(4)
        viewmat[:3, 3] = -viewmat[:3, :3] @ [0.1 * n, -height * (1.0 + sway * (-1) ** n), 0.0]  # y points down
        frame["viewmat"] = viewmat.ravel().tolist()
    (shot / "solve" / "cameras.json").write_text(json.dumps(cameras))
    floor = {"normal": [0.0, -1.0, 0.0], "height": 0.0} if height else None
    (shot / "solve" / "solve.json").write_text(json.dumps({**record, "floor": floor}))


def heights(addon, scene, shot):
    """[F] world z of the camera at each of its frames, in metres."""
    camera = addon("solve.cameras").find(scene, shot, "CAMERA")
    found = []
    for frame in (5, 6, 7):
        scene.frame_set(frame)
        found.append(camera.matrix_world.translation.z * scene.unit_settings.scale_length)
    return np.array(found)


@pytest.mark.parametrize("height", [0.13, 11.0])
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_the_scale_is_guessed_from_the_cameras_height(addon, scene, shot, height, unit):
    with_floor(shot, height, sway=0.05)
    scene.splannequin.shot_path, scene.unit_settings.scale_length = str(shot), unit
    said = addon("solve.arrival").load_camera(scene, shot)
    assert any("is estimated: the camera is 1.5 m above" in line for line in said)
    assert np.median(heights(addon, scene, shot)) == pytest.approx(1.5 * 0.95, rel=0.06)
    operators = addon("solve.scale")
    assert not operators.scaled(scene, shot) and operators.guessed_scale(scene, shot) > 0
    camera = addon("solve.cameras").find(scene, shot, "CAMERA").data
    assert camera.clip_start < 0.1 * 1.5 / unit < camera.clip_end


@pytest.mark.parametrize(("height", "sway"), [(0.0, 0.0), (2.0, 0.6)])
def test_without_a_floor_or_from_a_crane_nothing_is_guessed(addon, scene, shot, height, sway):
    with_floor(shot, height, sway)
    scene.splannequin.shot_path = str(shot)
    said = addon("solve.arrival").load_camera(scene, shot)
    assert not any("guess" in line for line in said)
    assert addon("shot.scene_objects").depth_scale(scene, shot) == 1.0
    assert not addon("solve.scale").scaled(scene, shot)


def test_set_scale_overrides_a_guess_and_stays(addon, scene, shot):
    with_floor(shot, 0.13)
    scene.splannequin.shot_path = str(shot)
    load, operators = addon("solve.arrival").load_camera, addon("solve.scale")
    load(scene, shot)
    bpy.ops.splannequin.align_scale(places=[0, 0, 0, 1, 0, 0], distance=2.0)
    scale = addon("shot.scene_objects").depth_scale
    chosen = scale(scene, shot)
    assert operators.scaled(scene, shot) and chosen == pytest.approx(2 * 1.5 / 0.13, rel=1e-4)
    with_floor(shot, 0.5)
    load(scene, shot)
    assert scale(scene, shot) == pytest.approx(chosen) and operators.scaled(scene, shot)


def test_another_solve_is_guessed_anew_and_what_stood_without_a_guess_stays(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    load, scale = addon("solve.arrival").load_camera, addon("shot.scene_objects").depth_scale
    with_floor(shot, 0.13)
    load(scene, shot)
    for height, expected in ((0.5, 3.0), (0.0, 1.0)):
        with_floor(shot, height)
        load(scene, shot)
        assert scale(scene, shot) == pytest.approx(expected, rel=1e-4)
    # Scenes of earlier versions have this scale of 1 too, together with objects built to it.
    with_floor(shot, 0.13)
    load(scene, shot)
    assert scale(scene, shot) == pytest.approx(1.0)
    assert not addon("solve.scale").scaled(scene, shot)


def test_manually_scaled_root_is_not_changed(addon, scene, shot):
    with_floor(shot, 0.13)
    scene.splannequin.shot_path = str(shot)
    load, scale = addon("solve.arrival").load_camera, addon("shot.scene_objects").depth_scale
    load(scene, shot)
    addon("solve.cameras").find(scene, shot, "EMPTY").scale = (4.0, 4.0, 4.0)
    bpy.context.view_layer.update()
    with_floor(shot, 0.5)
    load(scene, shot)
    assert scale(scene, shot) == pytest.approx(4.0) and addon("solve.scale").scaled(scene, shot)
