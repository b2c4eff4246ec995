"""What a 3D view asks the live session for, and a session that cannot begin. Drawing is seen in window/scrub.py."""

import sys
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

VIEWMAT = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_view_through_the_solved_camera_is_the_solved_camera(addon, contract, shot, scene, scale):
    cameras, viewport = addon("cameras"), addon("viewport")
    scene.splannequin.shot_path = str(shot)
    addon("steps").load_camera(scene, shot)
    root = cameras.find(scene, shot, "EMPTY")
    root.matrix_world = Matrix.LocRotScale((1, 2, 3), Matrix.Rotation(0.7, 3, "Y"), (scale,) * 3) @ root.matrix_world
    path = contract.CameraPath.load(shot / "solve" / "cameras.json")
    for pose in path.frames:
        scene.frame_set(pose.frame)
        graph = bpy.context.evaluated_depsgraph_get()
        seen = scene.camera.evaluated_get(graph)
        size = (path.width * 4, path.height * 4)
        window = seen.calc_matrix_camera(graph, x=size[0], y=size[1])
        matrices = (seen.matrix_world.normalized().inverted(), window)
        whole = viewport.view_of(scene, shot, size, matrices, 6.0, 10**9)
        np.testing.assert_allclose(whole.viewmat, pose.viewmat, atol=2e-5)
        np.testing.assert_allclose(np.array(whole.K) / 4, pose.K, rtol=1e-4)
        assert (whole.width, whole.height, whole.t_star) == (*size, 6.0)
        small = viewport.view_of(scene, shot, size, matrices, 6.0, path.width * path.height)
        assert small.width * small.height <= 1.1 * path.width * path.height
        np.testing.assert_allclose(small.K, np.array(pose.K) * small.width / path.width, rtol=0.05)
        assert viewport._same(whole, small)
        small.viewmat[3] += 1e-3
        assert not viewport._same(whole, small)


def test_an_orthographic_view_is_not_asked_for(addon, shot, scene):
    scene.splannequin.shot_path = str(shot)
    assert addon("viewport").view_of(scene, shot, (64, 48), (Matrix(), Matrix()), 6.0, 10**9) is None


def test_without_a_run_nothing_begins(addon, contract, shot, scene):
    scene.splannequin.shot_path = str(shot)
    with pytest.raises(contract.JobError):
        addon("viewport").begin(scene)
    assert addon("viewport").session() is None
    assert not bpy.ops.splannequin.live.poll()
    assert not bpy.ops.splannequin.suggested_instant.poll()


def test_a_session_that_cannot_begin_says_why_and_ends(addon, shot, root):
    """A real backend on a shot without a run."""
    session = addon("live").open_session(shot, "nothing", addon("backend").python(), root)
    until = time.monotonic() + 120
    while session.open and time.monotonic() < until:
        time.sleep(0.05)
    assert "'nothing'" in session.failure[0]
    assert session.failure[1] == "Run the training step first."
    assert session._process.wait(20) != 0


def _stand_in(tmp_path, name, body):
    """A program in place of the backend's Python, to see what becomes of a child that would live on."""
    program = tmp_path / name
    program.write_text(f"#!/bin/sh\n{body}\n")
    program.chmod(0o755)
    return str(program)


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in is a shell script")
def test_a_closed_session_leaves_no_process(addon, contract, shot, root, tmp_path):
    live = addon("live")
    session = live.open_session(shot, "main", _stand_in(tmp_path, "listens", "exec cat > /dev/null"), root)
    session.ask(contract.LiveView(1, 0, VIEWMAT, [9.0, 9, 8, 6], 16, 12, 6.0))
    time.sleep(0.2)
    assert session._process.poll() is None
    began = time.perf_counter()
    session.close()
    assert time.perf_counter() - began < 1.0, "does not wait for the child"
    assert session.busy(1)
    assert session._process.wait(5) == 0, "its input ended"
    assert not session.open


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in is a shell script")
def test_a_session_that_hangs_is_ended(addon, shot, root, tmp_path, monkeypatch):
    live = addon("live")
    monkeypatch.setattr(live, "_PATIENCE_SECONDS", 0.2)
    session = live.open_session(shot, "main", _stand_in(tmp_path, "hangs", "exec sleep 600"), root)
    session.close()
    assert session._process.wait(30) < 0


def test_a_python_that_does_not_start_is_named(addon, contract, shot, root):
    with pytest.raises(contract.JobError, match="could not be started"):
        addon("live").open_session(shot, "main", str(Path(root) / "README.md"), root)
