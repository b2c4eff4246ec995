"""Interpolated camera frames are marked on the timeline; the markers leave with the shot."""

import json

import bpy
import pytest


def path_of(contract, sources: str):
    """Camera path from frame 1; letters of `sources`: r registered, l localised, i interpolated."""
    words = {"r": "registered", "l": "localised", "i": "interpolated"}
    pose = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    frames = [contract.CameraFrame(n, pose, [9, 9, 4, 4], words[c]) for n, c in enumerate(sources, start=1)]
    return contract.CameraPath(8, 8, frames)


@pytest.mark.parametrize(
    ("sources", "left_out", "ranges"),
    [
        ("rrrr", (), []),
        ("riir", (), [(2, 3)]),
        ("iirlri", (), [(1, 2), (6, 6)]),
        ("ririr", (2, 4), []),  # a frame step of 2: no frame failed
        ("riiir", (2, 4), [(2, 4)]),  # frame 3 failed
        ("rllr", (), []),
    ],
)
def test_ranges_of_frames_that_failed(addon, contract, sources, left_out, ranges):
    solved = set(range(1, len(sources) + 1)) - set(left_out)
    assert addon("solve.guesses").ranges(path_of(contract, sources), solved) == ranges


@pytest.fixture
def failed(addon, contract, scene, shot):
    """Shot solved over frames 5 to 12: frames 7 to 9 and 12 are interpolated, frame 10 is localised."""
    path = contract.CameraPath.load(shot / "solve" / "cameras.json")
    frames = []
    for n, source in enumerate("rriiilri", start=5):
        words = {"r": "registered", "l": "localised", "i": "interpolated"}
        frames.append(contract.CameraFrame(n, path.frames[0].viewmat, path.frames[0].K, words[source]))
    cameras = contract.CameraPath(path.width, path.height, frames)
    (shot / "solve" / "cameras.json").write_text(json.dumps(cameras.to_json()))
    solve = json.loads((shot / "solve" / "solve.json").read_text())
    solve["result"] = {"quality": "A poor solve.", "frames": 8, "interpolated": 4, "localised": 1}
    (shot / "solve" / "solve.json").write_text(json.dumps(solve))
    scene.splannequin.shot_path = str(shot)
    return scene


def marked(scene) -> list[tuple[str, int]]:
    return sorted((m.name, m.frame) for m in scene.timeline_markers)


def test_keyframes_of_guessed_frames_have_a_distinct_colour(addon, failed, shot):
    camera = addon("solve.cameras").build(failed, shot)
    want = ["KEYFRAME"] * 2 + ["EXTREME"] * 3 + ["JITTER", "KEYFRAME", "EXTREME"]
    for curve in addon("compat_animation").fcurves(camera):
        assert [key.type for key in curve.keyframe_points] == want


def test_markers_come_and_go_with_the_shot_and_the_artists_stay(addon, failed, shot):
    failed.timeline_markers.new("mine", frame=7)
    addon("solve.arrival").load_camera(failed, shot)
    assert marked(failed) == [("mine", 7), ("no solve 12", 12), ("no solve 7-9", 7)]
    addon("solve.arrival").load_camera(failed, shot)
    assert len(marked(failed)) == 3, "a second load does not double them"
    failed.timeline_markers["no solve 12"].frame = 13
    failed.timeline_markers.new("no solve 7-9", frame=20)
    addon("process.begin").remove_all(failed, shot)
    assert marked(failed) == [("mine", 7), ("no solve 12", 13), ("no solve 7-9", 20)]


def test_markers_are_part_of_the_undo_step_and_of_the_file(addon, failed, shot, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.splannequin.load_camera("EXEC_DEFAULT", True) == {"FINISHED"}
    assert len(bpy.context.scene.timeline_markers) == 2
    bpy.ops.ed.undo()
    assert not len(bpy.context.scene.timeline_markers)
    addon("solve.arrival").load_camera(bpy.context.scene, shot)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.splannequin.remove_shot()
    assert not len(bpy.context.scene.timeline_markers)


def test_camera_step_reports_the_number_of_guessed_frames(addon, failed, shot):
    lines = addon("process.steps").STEPS["solve"].view(failed, addon("shot.inventory").read(shot)).state
    assert lines == ["A poor solve.", "4 of 8 frames have a guessed camera, shown as pink keys on the timeline."]
