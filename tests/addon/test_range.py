"""Frames that a bake requests from the backend and renders: the scene's range and step, missing or stale frames."""

import json
import os
import shutil

import bpy


def test_a_bake_asks_for_the_scenes_range_and_step_of_the_take(addon, with_shot, shot):
    scene = with_shot
    scene.frame_start, scene.frame_end, scene.frame_step = 6, 7, 1
    params = addon("process.steps").STEPS["bake"].params(scene)
    assert (params.first, params.last, params.step, params.only_missing) == (6, 7, 1, True)
    assert (params.take, params.run, params.t_star, params.grain) == ("freeze", "main", 6, False)
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 250, 3
    params = addon("process.steps").STEPS["bake"].params(scene)
    assert (params.first, params.last, params.step) == (1, 250, 3)
    assert addon("process.steps").STEPS["freeze"].params(scene).first is None, "the freeze is about all of the clip"


def test_bake_freezes_missing_frames_and_needs_only_a_run(addon, with_shot, shot):
    bake = addon("process.steps").STEPS["bake"]
    shutil.rmtree(shot / "takes" / "freeze")
    view = bake.view(with_shot, addon("shot.inventory").read(shot))
    assert (view.done, view.ready) == (False, True) and "Freezes the scene's range" in view.advice
    (shot / "runs" / "main" / "summary.json").unlink()
    view = bake.view(with_shot, addon("shot.inventory").read(shot))
    assert not view.ready and view.advice == "Freeze first."


def test_a_bake_keeps_the_grain_of_its_take(addon, with_shot, shot):
    path = shot / "takes" / "freeze" / "take.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"grain": {"softness_px": 0.5}}))
    assert addon("process.steps").STEPS["bake"].params(with_shot).grain is True


def test_a_bake_follows_the_keys_of_t_star_as_they_are_now(addon, with_shot, shot):
    path = shot / "takes" / "freeze" / "take.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"t_star_per_frame": {"5": 5.0, "6": 5.5, "7": 6.0}}))
    props, steps = with_shot.splannequin, addon("process.steps")
    with_shot.frame_start, with_shot.frame_end = 5, 7
    assert steps.STEPS["bake"].params(with_shot).t_star_per_frame == {"5": 5.0, "6": 5.5, "7": 6.0}
    props.choose_t_star, props.t_star = True, 7
    params = steps.STEPS["bake"].params(with_shot)
    assert (params.t_star, params.t_star_per_frame) == (7, {}), "one instant was chosen since"
    props.t_star = 5
    with_shot.keyframe_insert("splannequin.t_star", frame=5)
    props.t_star = 7
    with_shot.keyframe_insert("splannequin.t_star", frame=7)
    requested = steps.STEPS["bake"].params(with_shot).t_star_per_frame
    assert requested["5"] == 5.0 and requested["7"] == 7.0


def test_completeness_counts_only_requested_frames(addon, shot):
    addon("process.steps")
    (shot / "takes" / "freeze" / "000006.exr").unlink()
    assert not addon("freeze.takes").complete(shot, "freeze")
    assert addon("freeze.takes").complete(shot, "freeze", range(5, 8, 2)) and addon("freeze.takes").complete(
        shot, "freeze", range(7, 100)
    )
    assert not addon("freeze.takes").complete(shot, "freeze", range(5, 7))
    assert not addon("freeze.takes").complete(shot, "nobody", range(5, 7))


def test_a_run_that_was_trained_on_makes_a_take_suspect(addon, shot):
    addon("process.steps")
    checkpoint, take = shot / "runs" / "main" / "checkpoint.safetensors", shot / "takes" / "freeze" / "take.json"
    assert not addon("freeze.takes").may_be_stale(shot, "freeze")
    checkpoint.write_bytes(b"")
    os.utime(take, (1000, 1000))
    assert addon("freeze.takes").may_be_stale(shot, "freeze")
    os.utime(checkpoint, (900, 900))
    assert not addon("freeze.takes").may_be_stale(shot, "freeze")


def test_a_take_tells_by_content_whether_its_run_was_trained_on(addon, contract, shot):
    """Modification times are unreliable: `cp -r` copies files in any order."""
    addon("process.steps")
    stale = addon("freeze.takes").may_be_stale
    checkpoint, take = shot / "runs" / "main" / "checkpoint.safetensors", shot / "takes" / "freeze" / "take.json"
    checkpoint.write_bytes(b"as frozen")
    frozen = contract.file_digest(checkpoint)
    take.write_text(json.dumps({**json.loads(take.read_text()), "checkpoint": frozen}))
    os.utime(take, (1000, 1000))
    assert not stale(shot, "freeze")
    checkpoint.write_bytes(b"trained on")
    os.utime(checkpoint, (900, 900))
    assert stale(shot, "freeze")


def test_missing_frames_of_the_range_are_reported(addon, with_shot, shot):
    (shot / "takes" / "freeze" / "000006.exr").unlink()
    with_shot.frame_start, with_shot.frame_end = 5, 7
    said = addon("bake.insertion").insert(with_shot, shot, "freeze")
    assert "The take lacks 1 frames of the scene's range. The first missing frame is 6." in said
    with_shot.frame_step = 2
    assert not any("not in the take" in line for line in addon("bake.insertion").insert(with_shot, shot, "freeze"))


def test_headless_bakes_a_part_of_a_take_and_leaves_it_in_the_file(addon, shot, tmp_path, capfd):
    (shot / "takes" / "freeze" / "000006.exr").unlink()
    out = tmp_path / "out"
    arguments = ["bake", "--shot", str(shot), "--output", str(out)]
    assert addon("command_line.headless").main([*arguments, "--first", "5", "--step", "2"]) == 0
    assert [p.name for p in sorted((out / "composited").iterdir())] == ["000005.png", "000007.png"]
    assert not list((shot / "jobs").iterdir()) if (shot / "jobs").is_dir() else True, "no backend was asked"
    bpy.ops.wm.open_mainfile(filepath=str(out / "shot.blend"))
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end, scene.frame_step) == (5, 7, 2)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (16, 12)
    capfd.readouterr()
    assert addon("command_line.headless").main([*arguments, "--first", "9"]) == 2
    assert "The last frame, 7, comes before the first, 9." in capfd.readouterr().err


def larger_plate(shot, times: int) -> None:
    """Enlarge the shot's recorded plate size and camera intrinsics `times` times."""
    for name in ("shot.json", "solve/cameras.json"):
        facts = json.loads((shot / name).read_text())
        facts |= {"width": 16 * times, "height": 12 * times}
        for frame in facts.get("frames", []):
            frame["K"] = [times * value for value in frame["K"]]
        (shot / name).write_text(json.dumps(facts))


def size_of(scene) -> tuple[int, int, int]:
    return scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage


def test_a_new_scene_bakes_at_the_size_of_the_plate_however_small_the_take(addon, shot, tmp_path, pictures):
    larger_plate(shot, 4)
    out = tmp_path / "out"
    arguments = ["bake", "--shot", str(shot), "--output", str(out), "--first", "6", "--last", "6"]
    assert addon("command_line.headless").main(arguments) == 0
    assert size_of(bpy.context.scene) == (64, 48, 100)
    assert pictures.read(out / "composited" / "000006.png").shape == (48, 64, 3)


def test_a_bake_never_lowers_the_size_of_a_scene_nor_takes_back_what_the_artist_set(addon, with_shot, shot, tmp_path):
    larger_plate(shot, 80)
    scene = with_shot
    addon("solve.arrival").load_camera(scene, shot)
    assert size_of(scene) == (1280, 960, 100)
    assert addon("bake.insertion").fit_take(scene, shot, "freeze") == [] and size_of(scene) == (1280, 960, 100)
    scene.frame_start = 6
    blend = str(tmp_path / "mine.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    arguments = ["bake", "--shot", str(shot), "--blend", blend, "--output", str(tmp_path / "out")]
    assert addon("command_line.headless").main([*arguments, "--last", "6"]) == 0
    scene = bpy.context.scene
    assert size_of(scene) == (1280, 960, 100) and scene.frame_start == 6
    scene.render.resolution_x, scene.render.resolution_percentage = 2560, 50
    addon("solve.arrival").load_camera(scene, shot)
    assert size_of(scene) == (2560, 960, 50), "changed since by the artist"
    larger_plate(shot, 1)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    assert size_of(scene) == (16, 12, 100), "asked for with Fit Scene to Clip"


def test_the_camera_is_looked_at_again_only_if_the_take_was_seen_from_one(addon, contract, with_shot, shot):
    assert not addon("freeze.own_camera").follows_camera(with_shot)
    with_shot.splannequin.path_camera = with_shot.camera
    assert not addon("freeze.own_camera").follows_camera(with_shot), "the take is of the clip's own move"
    file = shot / "paths" / "freeze.json"
    take = shot / "takes" / "freeze" / "take.json"
    take.write_text(json.dumps(json.loads(take.read_text()) | {"camera_path": str(file)}))
    assert addon("freeze.own_camera").follows_camera(with_shot)

    def path(numbers, shift: float):
        pose = [1.0, 0, 0, shift, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]
        frames = [contract.CameraFrame(n, pose, [20.0, 20.0, 8.0, 6.0], "blender") for n in numbers]
        return contract.CameraPath(16, 12, frames)

    contract.write_json(file, path((5, 6, 7), 0.0).to_json())
    with_shot.frame_start, with_shot.frame_end = 6, 6
    params = addon("freeze.takes").freeze_from(with_shot, path((6,), 0.5), "bake")
    kept = contract.CameraPath.load(params.camera_path)
    assert [(f.frame, f.viewmat[3]) for f in kept.frames] == [(5, 0.0), (6, 0.5), (7, 0.0)]
    assert (params.first, params.last) == (6, 6)
