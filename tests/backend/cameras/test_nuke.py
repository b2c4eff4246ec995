"""Camera export for Nuke, read back by Nuke's documented rules in float64 and compared with the solve's projection."""

import re

import numpy as np
import pytest

from torch_backend.cameras.nuke import Y_UP, chan_text, euler_zxy, nk_text
from torch_backend.cameras.placement import Similarity, path_viewmats
from torch_backend.contract import CameraFrame, CameraPath, Placement

SCENE = Similarity.of(Placement([0.0, -2.5, 0.0, 4.0, 0.0, 0.0, 2.5, 1.0, -2.5, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0]))
POINTS = np.random.default_rng(1).standard_normal((40, 3)) * [2, 1, 1] + [0, 0, 9]


def about(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    result = np.eye(3)
    result[i, i] = result[j, j] = c
    result[i, j], result[j, i] = -s, s
    return result


def zxy(degrees) -> np.ndarray:
    """Rotation matrix for rotation order ZXY: first about z, then x, then y."""
    return about("y", degrees[1]) @ about("x", degrees[0]) @ about("z", degrees[2])


def in_camera(place, degrees, points):
    """Points of Nuke's world in camera space: x right, y up, looking along -z."""
    return (points - np.asarray(place)) @ zxy(degrees)


def truth(path, n):
    viewmat, K = path_viewmats(path)[n], path.frames[n].K
    seen = POINTS @ viewmat[:3, :3].T + viewmat[:3, 3]
    return np.stack([K[0] * seen[:, 0] / seen[:, 2] + K[2], K[1] * seen[:, 1] / seen[:, 2] + K[3]], 1), seen[:, 2]


def turning(shifted: bool) -> CameraPath:
    """Camera path that turns a full circle and rolls; `shifted` adds zoom, an off-centre principal point and tall
    pixels."""
    frames = []
    for n in range(24):
        turn = about("y", 15.0 * n + 3) @ about("x", 20 * np.sin(n)) @ about("z", 5 * n)
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turn, [0.1 * n, 0.2, 0.3]
        K = [900.0 + 3 * n, 850.0 + 3 * n, 610.0, 350.0] if shifted else [900.0, 900.0, 640.0, 360.0]
        frames.append(CameraFrame(101 + n, viewmat.ravel().tolist(), K))
    return CameraPath(1280, 720, frames)


def test_a_chan_file_sees_what_the_solve_saw():
    path = turning(shifted=False)
    rows = np.array([[float(v) for v in line.split()] for line in chan_text(path, SCENE, "a").splitlines()])
    assert rows.shape == (24, 8) and rows[:, 0].tolist() == [f.frame for f in path.frames]
    placed = Y_UP.after(SCENE).points(POINTS)
    for n, (_, *place, rx, ry, rz, view) in enumerate(rows):
        seen = in_camera(place, (rx, ry, rz), placed)
        pixels, depth = truth(path, n)
        focal = 360.0 / np.tan(np.radians(view) / 2.0)  # vertical field of view in degrees
        x, y = focal * seen[:, 0] / -seen[:, 2] + 640.0, 360.0 - focal * seen[:, 1] / -seen[:, 2]
        np.testing.assert_allclose(-seen[:, 2], 2.5 * depth, rtol=1e-6, atol=1e-6)
        before = np.abs(depth) > 1.0
        np.testing.assert_allclose(np.stack([x, y], 1)[before], pixels[before], rtol=1e-4, atol=1e-3)
    assert np.abs(np.diff(rows[:, 4:7], axis=0)).max() < 90.0, "no jump by a turn, which would blur in between"


def curves(text: str, knob: str) -> np.ndarray:
    """Values [F, N] of an animated knob."""
    line = re.search(rf"^ {knob} \{{(.*)\}}$", text, re.MULTILINE)[1]
    return np.array(
        [[float(v) for v in re.findall(r"x\d+ (\S+)", curve)] for curve in re.findall(r"\{([^}]*)\}", line)]
    ).T


@pytest.mark.parametrize("shifted", [False, True])
def test_a_nuke_script_sees_what_the_solve_saw(shifted):
    """Projection as in nukescripts.snap3d: the window offset is in half widths and subtracted after the lens."""
    path = turning(shifted)
    text = nk_text(path, SCENE, "3 shot é")
    assert " rot_order ZXY\n" in text and "{curve L x101 " in text and " name _3_shot___camera\n" in text
    camera = text.partition("Axis2")[0]
    aperture = float(re.search(r"haperture (\S+)", camera)[1])
    tall = path.frames[0].K[0] / path.frames[0].K[1]
    assert float(re.search(r"vaperture (\S+)", camera)[1]) == pytest.approx(aperture * 720 * tall / 1280)
    places, turns, offsets = (curves(camera, knob) for knob in ("translate", "rotate", "win_translate"))
    (focal,) = curves(camera, "focal").T
    placed = Y_UP.after(SCENE).points(POINTS)
    for n in range(24):
        seen = in_camera(places[n], turns[n], placed)
        pixels, depth = truth(path, n)
        tall = path.frames[n].K[0] / path.frames[n].K[1]
        u = 2.0 * focal[n] / aperture * seen[:, 0] / -seen[:, 2] - offsets[n, 0]
        v = 2.0 * focal[n] / aperture * seen[:, 1] / -seen[:, 2] - offsets[n, 1]
        x = (u + 1.0) * 640.0
        y = 720.0 - (v * 640.0 / tall + 360.0)
        before = np.abs(depth) > 1.0
        np.testing.assert_allclose(np.stack([x, y], 1)[before], pixels[before], rtol=1e-4, atol=2e-3)


def test_script_axis_places_splats_in_nuke_space():
    """Exported splats have z up, as in Blender. The Axis node rotates them into the world of the Nuke camera."""
    text = nk_text(turning(False), SCENE, "a").partition("Axis2")[2]
    degrees = [float(v) for v in re.search(r"rotate \{(.*)\}", text)[1].split()]
    np.testing.assert_allclose(zxy(degrees), Y_UP.rotation, atol=1e-12)


def test_angles_where_x_is_a_right_angle():
    level = np.stack([zxy((90.0, 25.0, 0.0)), zxy((-90.0, 25.0, 0.0))])
    np.testing.assert_allclose([zxy(d) for d in euler_zxy(level)], level, atol=1e-7)
