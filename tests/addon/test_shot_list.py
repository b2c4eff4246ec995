"""Several shots in one scene: settings, keys, cameras, jobs and removal of one shot do not affect the others."""

import json
import shutil

import bpy
import numpy as np
import pytest


@pytest.fixture
def second_shot(shot, tmp_path):
    """Second solved shot, also with frames 5 to 7."""
    folder = tmp_path / "second.splannequin"
    shutil.copytree(shot, folder)
    return folder


@pytest.fixture
def two(addon, scene, shot, second_shot):
    """Scene with both shots and their cameras; the second is chosen."""
    props = scene.splannequin
    props.shot_path, props.run_name = str(shot), "first run"
    addon("solve.arrival").load_camera(scene, shot)
    assert bpy.ops.splannequin.shot_add() == {"FINISHED"}
    props.shot_path = str(second_shot)
    addon("solve.arrival").load_camera(scene, second_shot)
    return scene


def test_settings_are_stored_and_restored_per_shot(addon, scene, shot, second_shot, clip):
    props, shot_list = scene.splannequin, addon("shot.selection")
    assert not bpy.ops.splannequin.shot_add.poll(), "there is no first shot yet"
    props.shot_path, props.clip = str(shot), "//first.mov"
    artists_camera = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
    scene.collection.objects.link(artists_camera)
    tracked = bpy.data.movieclips.load(str(clip))
    values = {"run_name": "b", "preset": "final", "use_range": True, "first": 3, "last": 9, "t_star": 6}
    values |= {"choose_t_star": True, "path_camera": artists_camera, "freeze_width": 640, "live_show": "motion"}
    values |= {"take_name": "x", "camera_model": "OPENCV", "overscan": "LENS", "extend_steps": 77}
    values |= {"overscan_percent": 4.0, "lut": "//look.cube", "use_start": True, "start": 1001}
    values |= {"detail": False, "develop": False, "passes": True, "deep": True, "motion_blur": True, "depth": "//depth"}
    values |= {"matte_mask": bpy.data.masks.new("c")}
    values |= {"cameras_from": "FILE", "cameras_path": "//model", "tracking_clip": tracked}
    values |= {"shot_seen": "//first.splannequin", "solve_step": 2, "fps": 25.0, "colour_space": "x"}
    values |= {"layer": "left", "pixel_aspect": 2.0, "matrix": "bt2020", "levels": "full"}
    values |= {"ignore_from": "FILE", "ignore_path": "//logo.png", "people_from": "DRAWN", "people_path": "//m.png"}
    values |= {"ignore_drawn": bpy.data.masks.new("a"), "people_drawn": bpy.data.masks.new("b")}
    values |= {"scene_camera": scene.objects["Camera"]}
    values |= {"st_map": "//lens.exr", "st_map_way": "redistort", "st_map_layer": "left"}
    values |= {"focal_mm": 24.0, "sensor_mm": 13.5, "refine_focal": False, "retry": False}
    for name, value in values.items():
        setattr(props, name, value)
    assert set(shot_list.names()) == {*values, "clip", "shot_path"}, "a setting that is not tested here"
    props.set_up_scene = True
    bpy.ops.splannequin.shot_add()
    assert (props.clip, props.shot_path, props.run_name, props.path_camera) == ("", "", "main", None)
    assert props.set_up_scene, "what is the scene's own stays"
    props.shot_path, props.t_star = str(second_shot), 7
    assert shot_list.folders(scene) == [shot, second_shot] and addon("shot.selection").shot_folder(scene) == second_shot
    assert shot_list.labels(scene) == ["my shot é", "second"]
    props.active_shot = 0
    assert addon("shot.selection").shot_folder(scene) == shot and {n: getattr(props, n) for n in values} == values
    assert shot_list.folders(scene) == [shot, second_shot]
    props.active_shot = 1
    assert (props.shot_path, props.t_star, props.run_name) == (str(second_shot), 7, "main")
    props.active_shot = 99
    assert props.active_shot == 1, "no shot, no change"


def keyed(addon, scene):
    """Map from data path to values of the keys."""
    return {c.data_path: [k.co[1] for k in c.keyframe_points] for c in addon("compat_animation").fcurves(scene)}


def test_a_keyed_instant_goes_with_its_shot(addon, two):
    props = two.splannequin
    two["mine"] = 1.0
    two.keyframe_insert('["mine"]', frame=1)
    artists = set(keyed(addon, two))
    for index, value in ((1, 7), (0, 5)):
        props.active_shot = index
        props.t_star, props.choose_t_star = value, True
        two.keyframe_insert("splannequin.t_star", frame=5)
    ours = {"splannequin.t_star": [5.0], "splannequin.shots[1].t_star": [7.0]}
    assert {k: v for k, v in keyed(addon, two).items() if k not in artists} == ours
    assert addon("freeze.takes").keyed_instants(two)["6"] == 5.0
    props.active_shot = 1
    assert addon("freeze.takes").keyed_instants(two)["6"] == 7.0
    two.frame_set(6)
    assert props.t_star == 7 and props.shots[0].t_star == 5
    assert set(keyed(addon, two)) == {*artists, "splannequin.t_star", "splannequin.shots[0].t_star"}
    bpy.ops.splannequin.shot_remove(things=False)
    assert {k: v for k, v in keyed(addon, two).items() if k not in artists} == {"splannequin.t_star": [5.0]}
    assert artists <= set(keyed(addon, two))


def test_keys_move_up_when_a_shot_before_them_goes(addon, two, shot, tmp_path):
    props = two.splannequin
    bpy.ops.splannequin.shot_add()
    props.shot_path = str(tmp_path / "third")
    props.t_star = 33
    two.keyframe_insert("splannequin.t_star", frame=1)
    props.active_shot = 0
    bpy.ops.splannequin.shot_remove(things=False)
    assert len(props.shots) == 2 and props.shot_path.endswith("second.splannequin") and props.active_shot == 0
    assert keyed(addon, two) == {"splannequin.shots[1].t_star": [33.0]}
    props.active_shot = 1
    assert props.t_star == 33 and keyed(addon, two) == {"splannequin.t_star": [33.0]}


def test_the_chosen_shots_camera_is_the_scenes(addon, two, shot, second_shot):
    cameras, props = addon("solve.cameras"), two.splannequin
    assert two.camera == cameras.find(two, second_shot, "CAMERA")
    props.active_shot = 0
    assert two.camera == cameras.find(two, shot, "CAMERA")
    two.camera = None
    cameras.remove(two, second_shot)
    props.active_shot = 1
    assert two.camera is None, "a shot without a camera here changes nothing"


def seen(scene) -> tuple:
    render = scene.render
    size = render.resolution_x, render.resolution_y, render.resolution_percentage
    return size, round(render.fps / render.fps_base, 3), (scene.frame_start, scene.frame_end)


def test_size_rate_and_range_are_stored_per_shot(addon, scene, shot, second_shot):
    """Switching restores the values that the artist left; removing the last shot restores the scene's own values."""
    first, second = ((16, 12, 100), 12.5, (5, 7)), ((32, 24, 100), 25.0, (5, 7))
    original = seen(scene)
    props = scene.splannequin
    for name, change in (("shot.json", {"fps": 25.0}), ("solve/cameras.json", {})):
        facts = json.loads((second_shot / name).read_text()) | change | {"width": 32, "height": 24}
        (second_shot / name).write_text(json.dumps(facts))
    props.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    assert seen(scene) == first
    bpy.ops.splannequin.shot_add()
    assert seen(scene) == first, "nothing of the new one is known"
    props.shot_path = str(second_shot)
    addon("solve.arrival").load_camera(scene, second_shot)
    assert seen(scene) == second
    props.active_shot = 0
    assert seen(scene) == first
    scene.frame_start, scene.render.resolution_percentage = 6, 50
    props.active_shot = 1
    assert seen(scene) == second
    props.active_shot = 0
    assert seen(scene) == ((16, 12, 50), 12.5, (6, 7))
    bpy.ops.splannequin.shot_remove(things=True)
    assert seen(scene) == second and scene.camera == addon("solve.cameras").find(scene, second_shot, "CAMERA")
    addon("process.begin").remove_all(scene, second_shot)
    assert seen(scene) == original and scene.camera == scene.objects["Camera"]


def test_what_the_artist_set_for_a_shot_is_still_the_artists_after_switching(addon, two, shot, second_shot):
    props = two.splannequin
    two.render.resolution_x = 4000
    props.active_shot = 0
    assert two.render.resolution_x == 16
    props.active_shot = 1
    assert two.render.resolution_x == 4000
    for folder in (shot, second_shot):
        addon("process.begin").remove_all(two, folder)
    assert two.render.resolution_x == 4000 and two.frame_end == 250


def test_switching_shots_keeps_scene_settings_untouched(addon, scene, shot, second_shot):
    scene.render.resolution_x, scene.frame_end = 640, 99
    props = scene.splannequin
    props.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    bpy.ops.splannequin.shot_add()
    props.shot_path = str(second_shot)
    addon("solve.arrival").load_camera(scene, second_shot)
    scene.frame_end = 50
    props.active_shot = 0
    assert (scene.render.resolution_x, scene.frame_end) == (640, 50)


def datablocks(scene) -> set[str]:
    kinds = (bpy.data.objects, bpy.data.meshes, bpy.data.images, bpy.data.actions, bpy.data.collections)
    return {item.name for kind in kinds for item in kind}


def test_removing_one_shot_keeps_the_second(addon, scene, shot, second_shot):
    props = scene.splannequin
    props.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    before = datablocks(scene)
    bpy.context.view_layer.update()
    pose = np.array(addon("solve.cameras").find(scene, shot, "CAMERA").matrix_world)
    bpy.ops.splannequin.shot_add()
    props.shot_path = str(second_shot)
    addon("solve.arrival").load_camera(scene, second_shot)
    assert bpy.ops.splannequin.shot_remove(things=True) == {"FINISHED"}
    assert datablocks(scene) == before
    assert not len(props.shots) and addon("shot.selection").shot_folder(scene) == shot
    assert scene.camera == addon("solve.cameras").find(scene, shot, "CAMERA")
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(scene.camera.matrix_world, pose)
    assert addon("bake.freeze_group").shown(scene)[0] == shot / "takes" / "freeze"
    assert scene.view_settings.view_transform == "Standard", "the shot that stays needs its settings"
    assert not bpy.ops.splannequin.shot_remove.poll()
    addon("process.begin").remove_all(scene, shot)
    assert addon("bake.freeze_group").shown(scene) is None and scene.view_settings.view_transform == "AgX"
    assert scene.render.resolution_x == 1920


def test_removing_the_baked_shot_takes_its_group_out(addon, two, shot, second_shot):
    addon("process.steps")
    addon("bake.insertion").insert_freeze(two, second_shot, "freeze")
    addon("process.begin").remove_all(two, second_shot)
    assert addon("bake.freeze_group").shown(two) is None and addon("solve.cameras").find(two, shot, "CAMERA")
    assert two.render.resolution_x == 16, "the settings go with the last shot"


def test_the_panel_says_which_shot_the_compositor_shows(addon, two, shot, second_shot, new_take):
    shots = addon("shot.inventory")
    addon("bake.insertion").insert_freeze(two, second_shot, "freeze")
    assert addon("process.steps").STEPS["bake"].view(two, shots.read(second_shot)).done
    two.splannequin.active_shot = 0
    view = addon("process.steps").STEPS["bake"].view(two, shots.read(shot))
    assert not view.done and "another shot, second" in view.state[0]
    addon("bake.insertion").insert_freeze(two, shot, "freeze")
    assert addon("process.steps").STEPS["bake"].view(two, shots.read(shot)).done
    new_take(shot, "later")
    two.splannequin.take_name = "later"
    assert "take freeze" in addon("process.steps").STEPS["bake"].view(two, shots.read(shot)).state[0]


def ended(addon, contract, folder, step, kind, params, result):
    """A job that the supervisor follows and that has just ended successfully."""
    jobs = addon("process.jobs")
    job = jobs.new_job(folder, kind, params)
    (job.folder / "step").write_text(step)
    addon("process.job_timer").follow(step, job)
    event = contract.Event("done", 1, 1.0, {"result": result})
    (job.folder / contract.EVENTS_FILE).write_text(json.dumps(event.__dict__) + "\n")
    status = contract.Status(job.folder.name, "done", 1, 1.0, 2.0, 2.0, fraction=1.0)
    (job.folder / contract.STATUS_FILE).write_text(json.dumps(status.__dict__))
    return job


def test_a_job_of_a_shot_that_is_not_chosen_waits_for_it(addon, contract, scene, shot, second_shot):
    props, supervisor, cameras = scene.splannequin, addon("process.job_timer"), addon("solve.cameras")
    props.shot_path, props.t_star = str(shot), 5
    bpy.ops.splannequin.shot_add()
    props.shot_path, props.t_star = str(second_shot), 7
    frozen = ended(
        addon,
        contract,
        shot,
        "freeze",
        "freeze",
        contract.FreezeParams(),
        {"t_star_frame": 6, "take": "freeze", "first": 5, "last": 7},
    )
    solved = ended(addon, contract, shot, "solve", "solve", contract.SolveParams(), {})
    baked = ended(
        addon,
        contract,
        shot,
        "bake",
        "freeze",
        contract.FreezeParams(),
        {"t_star_frame": 6, "take": "freeze", "first": 5, "last": 7},
    )
    for _ in range(100):  # a turn has a time budget, and the machine may be busy
        supervisor.tick()
        if all(job.ended for job in (frozen, solved, baked)):
            break
    assert solved.ended and baked.ended and props.t_star == 7 and props.shots[0].t_star == 5
    assert cameras.find(scene, shot, "CAMERA") is None and set(supervisor.watch_of(shot).pending) == {
        "freeze", "solve", "bake",
    }  # fmt: skip
    supervisor.tick()
    assert supervisor.watch_of(shot).jobs, "a shot of the list is followed on"
    props.active_shot = 0
    supervisor.tick()
    assert props.t_star == 6 and cameras.find(scene, shot, "CAMERA") == scene.camera
    assert addon("bake.freeze_group").shown(scene) is None, "choosing a shot bakes nothing"
    assert "Bake again" in supervisor.watch_of(shot).notes["bake"][0]
    props.t_star = 7
    supervisor.tick()
    assert props.t_star == 7, "it is applied once"
    assert props.shots[1].t_star == 7


def test_camera_file_of_one_shot_does_not_freeze_another(addon, contract, two, shot, second_shot):
    supervisor = addon("process.job_timer")
    read = addon("freeze.takes").reading(two.session_uid, second_shot, "freeze", iter_path(contract), 1)
    supervisor.work(second_shot, "freeze", read)
    two.splannequin.active_shot = 0
    while supervisor.watch_of(second_shot).work is not None:
        supervisor.tick()
    assert "Another shot was chosen" in supervisor.watch_of(second_shot).failures["freeze"][0]
    assert not (shot / "jobs").exists() and not (second_shot / "jobs").exists()


def iter_path(contract):
    yield 1
    return contract.CameraPath(8, 8, [])


def test_dropped_video_starts_a_second_shot(addon, scene, shot, clip):
    props = scene.splannequin
    props.shot_path = str(shot)
    bpy.ops.splannequin.use_clip(filepath=str(clip))
    assert len(props.shots) == 2 and props.clip == str(clip)
    bpy.ops.splannequin.use_clip(filepath="/another.mov")
    assert len(props.shots) == 2 and props.clip == "/another.mov", "a clip that was not imported is replaced"
    bpy.ops.splannequin.use_clip(filepath=str(clip))
    props.active_shot = 0
    bpy.ops.splannequin.use_clip(filepath=str(clip))
    assert len(props.shots) == 2 and props.active_shot == 1, "one that is in the list is chosen"


@pytest.fixture
def linked(addon, scene, shot, tmp_path):
    """Scene with the same shot, linked from another file into a new file in the same folder."""
    scene.name, scene.splannequin.shot_path = "Layout", str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "layout.blend"))
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    bpy.context.scene.name, bpy.context.scene.splannequin.shot_path = "Comp", str(shot)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "comp.blend"))
    with bpy.data.libraries.load(str(tmp_path / "layout.blend"), link=True) as (_, wanted):
        wanted.scenes = ["Layout"]
    found = bpy.data.scenes["Layout"]
    assert found.library is not None
    return found


def test_linked_scene_with_the_same_shot_is_not_changed(addon, linked, shot):
    selection, supervisor = addon("shot.selection"), addon("process.job_timer")
    comp_scene = bpy.data.scenes["Comp"]
    assert selection.shot_folder(linked) == shot, "it is the same one"
    assert selection.scenes_of(shot) == [comp_scene] and selection.scenes_with(shot) == [comp_scene]
    camera, watch = linked.camera, supervisor.watch_of(shot)
    supervisor.change(watch, "solve", lambda scene: addon("solve.arrival").load_camera(scene, shot))
    assert not watch.failures and linked.camera == camera and comp_scene.camera not in (None, camera)
    supervisor.tick()
    assert not watch.failures


def test_paths_of_a_linked_scene_stay_over_saving(linked, shot, tmp_path):
    """The paths are relative to the scene's own file, not to the saved file."""
    before = linked.splannequin.shot_path, linked.splannequin.made[0].folder
    (tmp_path / "deeper").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "deeper" / "comp.blend"))
    assert (linked.splannequin.shot_path, linked.splannequin.made[0].folder) == before


def test_a_video_dropped_again_is_the_shot_that_it_was(addon, scene, shot, tmp_path):
    """The path's spelling does not matter: after saving, the .blend stores it as relative."""
    props, clip = scene.splannequin, tmp_path / f"{addon('shot.scene_objects').name_of(shot)}.mp4"
    clip.touch()
    props.shot_path = str(shot)
    bpy.ops.splannequin.use_clip(filepath=str(clip))
    assert not len(props.shots) and props.clip == str(clip), "the shot beside it was opened without a clip"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    props = bpy.context.scene.splannequin
    props.clip = f"//{clip.name}"
    bpy.ops.splannequin.use_clip(filepath=str(clip))
    assert not len(props.shots)
    bpy.ops.splannequin.shot_add()
    props.clip = "/another.mov"
    bpy.ops.splannequin.use_clip(filepath=str(tmp_path / "x" / ".." / clip.name))
    assert len(props.shots) == 2 and props.active_shot == 0 and props.clip == f"//{clip.name}"


def test_data_shared_by_two_entries_survives_removal_of_one(addon, two, shot):
    props, cameras = two.splannequin, addon("solve.cameras")
    props.shot_path = str(shot)
    assert addon("shot.selection").folders(two) == [shot, shot]
    assert bpy.ops.splannequin.shot_remove(things=True) == {"FINISHED"}
    assert addon("shot.selection").folders(two) == [shot] and cameras.find(two, shot, "CAMERA") is not None


def test_a_shot_on_a_disk_that_is_away_keeps_its_camera(addon, scene, shot, tmp_path):
    """Another shot of the same name is not taken for the first one, moved."""
    second_shot = tmp_path / "elsewhere" / shot.name
    shutil.copytree(shot, second_shot)
    props, objects = scene.splannequin, addon("shot.scene_objects")
    props.shot_path = str(shot)
    addon("solve.arrival").load_camera(scene, shot)
    camera = scene.camera
    assert bpy.ops.splannequin.shot_add() == {"FINISHED"}
    props.shot_path = str(second_shot)
    shot.rename(shot.with_name("away"))
    assert objects.of(scene, second_shot) is None
    addon("solve.arrival").load_camera(scene, second_shot)
    assert scene.camera != camera and objects.part(scene, shot, "camera") == camera
    assert objects.part(scene, second_shot, "camera") == scene.camera
    moved = shot.parent / "moved" / shot.name
    moved.parent.mkdir()
    shot.with_name("away").rename(moved)
    props.active_shot = 0
    assert bpy.ops.splannequin.locate_shot(directory=f"{moved}/") == {"FINISHED"}
    assert objects.part(scene, moved, "camera") == camera
