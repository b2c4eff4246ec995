"""Requests of a 3D view to the live session, and sessions that fail to start. window/scrub.py tests the drawing."""

import os
import threading
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

VIEWMAT = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def test_a_view_through_the_solved_camera_is_the_solved_camera(addon, contract, shot, scene):
    cameras, viewport = addon("solve.cameras"), addon("freeze.viewport")
    scene.splannequin.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    root = cameras.find(scene, shot, "EMPTY")
    root.matrix_world = Matrix.LocRotScale((1, 2, 3), Matrix.Rotation(0.7, 3, "Y"), (2.5,) * 3) @ root.matrix_world
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


def _answer(session, request):
    """Answer a request as the backend does after drawing a view."""
    pixels = np.zeros(5 * request.width * request.height, np.float32).tobytes()
    size = {"width": request.width, "height": request.height}
    session._take_in({"kind": "frame", "seq": request.seq, "t_star": 6, **size}, pixels)


def test_resting_view_is_requested_sharper_then_with_plate_detail(addon, contract, shot, monkeypatch):
    """Only one request is open at a time, none while the view changes. Switching detail on or off takes effect at
    once."""
    viewport, live = addon("freeze.viewport"), addon("freeze.live")
    session = live.Session(shot, "main")
    monkeypatch.setattr(viewport, "_session", session)
    monkeypatch.setattr(viewport, "_moved", {})

    def look(t_star=6.0, detail=True, rested=True):
        """Draw the region once; return the (width, detail) of a new request, or None."""
        before = session.wanted(1)
        if rested and 1 in viewport._moved:
            viewport._moved[1] -= 1.0
        quick, sharp = (contract.LiveView(1, 0, VIEWMAT, [f, f, 8 * n, 6 * n], 16 * n, 12 * n, t_star)
                        for n, f in ((1, 9.0), (2, 18.0)))  # fmt: skip
        sharp.detail = detail
        viewport._ask(1, quick, sharp)
        request = session.wanted(1)
        return None if request is before else (request.width, request.detail)

    assert look() == (16, False)
    assert look() is None, "it is still being drawn"
    _answer(session, session.wanted(1))
    assert look(t_star=7.0) == (16, False)
    _answer(session, session.wanted(1))
    viewport._moved[1] = time.monotonic()
    assert look(t_star=7.0, rested=False) is None, "it does not rest yet"
    assert look(t_star=7.0) == (32, False)
    assert look(t_star=7.0) is None
    _answer(session, session.wanted(1))
    assert look(t_star=7.0) == (32, True)
    assert look(t_star=7.0) is None
    assert look(t_star=8.0) == (16, False), "what is being made of plates is not waited for"
    _answer(session, session.wanted(1))
    assert not session.busy(1), "and will not be answered any more"
    for wanted in ((32, False), (32, True)):
        assert look(t_star=8.0) == wanted
        _answer(session, session.wanted(1))
    assert look(t_star=8.0) is None, "nothing is left to ask for"
    assert look(t_star=8.0, detail=False) == (32, False)
    _answer(session, session.wanted(1))
    assert look(t_star=8.0, detail=False) is None
    assert look(t_star=8.0) == (32, True)
    seq = session.wanted(1).seq
    session._take_in({"kind": "error", "seq": seq, "message": "no plates", "hint": ""}, b"")
    assert look(t_star=8.0) is None and session.open, "not asked for over and over"


def test_frames_may_arrive_while_the_panel_reads_them(addon, contract, scene, monkeypatch):
    """The reader thread adds frames of new views while the main thread reads the frames that are shown."""
    viewport, live = addon("freeze.viewport"), addon("freeze.live")
    session, views = live.Session(Path("shot"), "main"), 5000
    session.facts = {"suggestions": [{"frame": 5, "seen": 1.0, "sharpness": 1.0}]}
    monkeypatch.setattr(viewport, "_session", session)
    scene.splannequin.choose_t_star, scene.splannequin.t_star = True, 6

    def receive():
        for n in range(views):
            request = contract.LiveView(n, 0, VIEWMAT, [9.0, 9.0, 8.0, 6.0], 1, 1, 6.0)
            session.ask(request)
            _answer(session, request)

    reader = threading.Thread(target=receive)
    reader.start()
    while reader.is_alive():
        assert viewport.reason(scene) == "Suggested: 5."
    reader.join()
    assert len(session.frames) == views


def test_switching_develop_sends_a_new_request(addon, contract):
    views = [contract.LiveView(1, 0, VIEWMAT, [9.0, 9.0, 8.0, 6.0], 16, 12, 6.0, develop=on) for on in (True, False)]
    same = addon("freeze.viewport")._same
    assert same(views[0], views[0]) and not same(*views)


def test_a_view_that_came_to_rest_is_drawn_once_more_however_late_the_timer_is(addon, shot, scene, monkeypatch):
    viewport, drawn = addon("freeze.viewport"), []
    scene.splannequin.shot_path, scene.splannequin.run_name = str(shot), "main"
    session = addon("freeze.live").Session(addon("shot.selection").shot_folder(scene), "main")
    monkeypatch.setattr(viewport, "_session", session)
    monkeypatch.setattr(viewport, "_rested", set())
    monkeypatch.setattr(viewport, "_moved", {1: time.monotonic()})
    monkeypatch.setattr(viewport, "redraw", lambda kinds=(): drawn.append(kinds))
    viewport._tick()
    drawn.clear()
    viewport._tick()
    assert ("WINDOW",) not in drawn, "nothing has changed, and it does not rest yet"
    viewport._moved[1] -= 10.0
    for count in (1, 1, 1):
        viewport._tick()
        assert drawn.count(("WINDOW",)) == count
    scene.splannequin.detail = not scene.splannequin.detail
    viewport._tick()
    assert drawn.count(("WINDOW",)) == 2, "the switch is followed"


def test_closed_views_free_their_images(addon, monkeypatch):
    viewport, session = addon("freeze.viewport"), addon("freeze.live").Session(Path("shot"), "main")
    region = bpy.context.window_manager.windows[0].screen.areas[0].regions[0].as_pointer()
    for name in ("_moved", "_shown"):
        monkeypatch.setattr(viewport, name, {region: 0.0, 1: 0.0})
    session.frames.update({region: None, 1: None})
    viewport._forget_closed_views(session)
    assert viewport._moved.keys() == viewport._shown.keys() == session.frames.keys() == {region}


def test_what_the_backend_warned_of_is_shown_while_it_draws(addon, shot, monkeypatch):
    viewport = addon("freeze.viewport")
    assert viewport.note() == ""
    session = addon("freeze.live").Session(shot, "main")
    monkeypatch.setattr(viewport, "_session", session)
    assert viewport.note() == "", "of an older backend, or one that loads"
    session._take_in({"kind": "ready", "note": "Scrubbing uses the processor."}, b"")
    assert viewport.note() == "Scrubbing uses the processor."


def test_orthographic_view_sends_no_request(addon, shot, scene):
    scene.splannequin.shot_path = str(shot)
    assert addon("freeze.viewport").view_of(scene, shot, (64, 48), (Matrix(), Matrix()), 6.0, 10**9) is None


def test_without_a_run_nothing_begins(addon, contract, shot, scene):
    scene.splannequin.shot_path = str(shot)
    with pytest.raises(contract.JobError):
        addon("freeze.viewport").begin(scene)
    assert addon("freeze.viewport").session() is None
    assert not bpy.ops.splannequin.live.poll()
    assert not bpy.ops.splannequin.suggested_instant.poll()


def test_a_closed_session_leaves_no_process(addon, contract, shot, root, stand_in):
    live = addon("freeze.live")
    session = live.open_session(shot, "main", stand_in("exec cat > /dev/null"), root)
    session.ask(contract.LiveView(1, 0, VIEWMAT, [9.0, 9, 8, 6], 16, 12, 6.0))
    time.sleep(0.2)
    assert session._process.poll() is None
    began = time.perf_counter()
    session.close()
    assert time.perf_counter() - began < 1.0, "does not wait for the child"
    assert session.busy(1)
    assert session._process.wait(5) == 0, "its input ended"
    assert not session.open


@pytest.mark.skipif(os.name == "nt", reason="a link needs a privilege there")
def test_a_log_that_is_a_link_empties_nothing(addon, contract, shot, root, tmp_path, stand_in):
    theirs, live = tmp_path / "theirs.txt", addon("freeze.live")
    theirs.write_text("theirs")
    log = contract.ShotFolder(shot).live_log
    log.parent.mkdir(exist_ok=True)
    log.symlink_to(theirs)
    live.open_session(shot, "main", stand_in("exec cat > /dev/null"), root).close()
    assert theirs.read_text() == "theirs" and not log.is_symlink()


def test_a_session_that_hangs_is_ended(addon, shot, root, stand_in, monkeypatch):
    live = addon("freeze.live")
    monkeypatch.setattr(live, "_PATIENCE_SECONDS", 0.2)
    session = live.open_session(shot, "main", stand_in("exec sleep 600"), root)
    session.close()
    assert session._process.wait(30) < 0


def test_a_python_that_does_not_start_is_named(addon, contract, shot, root):
    with pytest.raises(contract.JobError, match="could not be started"):
        addon("freeze.live").open_session(shot, "main", str(Path(root) / "README.md"), root)
