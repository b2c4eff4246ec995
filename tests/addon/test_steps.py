"""The five steps and their buttons, run headless on real jobs, and their changes to the scene."""

import io
import json
import os
import shutil
import types
from pathlib import Path

import bpy
import numpy as np
import pytest


def test_the_import_button_brings_the_clip_in_and_replaces_work_only_with_consent(addon, scene, clip, tmp_path):
    props = scene.splannequin
    props.clip, props.shot_path = str(clip), str(tmp_path / "s.splannequin")
    props.use_range, props.first, props.last = True, 2, 9
    props.use_start, props.start = True, 1001
    assert bpy.ops.splannequin.import_clip() == {"FINISHED"}
    state = addon("shot.inventory").read(tmp_path / "s.splannequin")
    assert state.frames == 8 and state.frame_range == (1001, 1008)
    assert (scene.frame_start, scene.frame_end) == (1001, 1008), "a new scene takes the clip's range"
    assert (scene.render.resolution_x, scene.render.resolution_y) == state.size
    assert scene.render.fps / scene.render.fps_base == pytest.approx(state.info["fps"])
    assert 1001 <= props.t_star <= 1008

    folder = tmp_path / "s.splannequin"  # other frames replace work only with consent
    (folder / "solve").mkdir()
    (folder / "solve" / "cameras.json").write_text("{}")
    question = addon("footage.operators").replaces(scene)
    assert "a solved camera" in question and "gelöste Kamera" in addon("translations").translate(question, "de_DE")
    props.first, props.last = 3, 12
    with pytest.raises(RuntimeError, match="--replace"):
        bpy.ops.splannequin.import_clip()
    assert (folder / "solve" / "cameras.json").is_file()
    assert bpy.ops.splannequin.import_clip(replace=True) == {"FINISHED"}
    assert (folder / "replaced" / "001" / "solve" / "cameras.json").is_file() and not (folder / "solve").exists()


def test_scene_in_use_changes_only_with_consent(addon, scene, shot):
    scene.render.resolution_x, scene.frame_end = 4096, 99
    said = addon("footage.arrival").imported(scene, shot)
    assert (scene.render.resolution_x, scene.frame_end) == (4096, 99) and "not changed" in said[0]
    scene.splannequin.set_up_scene = True
    addon("footage.arrival").imported(scene, shot)
    assert (scene.render.resolution_x, scene.frame_end) == (16, 7)


def test_no_clip_is_said_in_words(scene):
    with pytest.raises(RuntimeError, match=r"No clip is chosen\. Choose a video or image sequence\."):
        bpy.ops.splannequin.import_clip()


def test_shot_opened_by_folder_reimports_its_stored_clip(addon, with_shot, shot, contract):
    source = str(shot.parent / "clip.mp4")
    contract.write_json(shot / "shot.json", {**contract.read_json(shot / "shot.json"), "source": source})
    assert not with_shot.splannequin.clip
    assert addon("process.steps").STEPS["import"].params(with_shot).source == source


def test_no_backend_writes_nothing(addon, scene, clip, tmp_path, monkeypatch):
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(tmp_path / "gone"))
    scene.splannequin.clip, scene.splannequin.shot_path = str(clip), str(tmp_path / "s.splannequin")
    with pytest.raises(RuntimeError, match="SPLANNEQUIN_BACKEND_PYTHON does not exist"):
        bpy.ops.splannequin.import_clip()
    assert not list(tmp_path.iterdir())


def test_a_folder_of_no_shot_is_refused(scene, tmp_path):
    scene.splannequin.shot_path = str(tmp_path)
    with pytest.raises(RuntimeError, match="is not a shot folder"):
        bpy.ops.splannequin.solve_camera()


def test_existing_artist_folder_is_not_used_as_a_shot(scene, clip, tmp_path):
    mine = tmp_path / "project"
    mine.mkdir()
    (mine / "scene.blend").write_bytes(b"BLENDER")
    scene.splannequin.clip, scene.splannequin.shot_path = str(clip), str(mine)
    with pytest.raises(RuntimeError, match=r"contains other files \(scene\.blend\)\. Choose an empty or new folder"):
        bpy.ops.splannequin.import_clip()
    assert [p.name for p in mine.iterdir()] == ["scene.blend"]


def test_shot_folder_is_created_next_to_the_clip(addon, scene, tmp_path):
    scene.splannequin.clip = str(tmp_path / "a clip.mov")
    assert addon("shot.selection").shot_folder(scene) == tmp_path / "a clip.splannequin"


def test_relative_paths_follow_the_blend(addon, scene, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.context.scene.splannequin.shot_path = "//x.splannequin"
    assert addon("shot.selection").shot_folder(bpy.context.scene) == tmp_path / "x.splannequin"


def test_insert_and_remove_buttons_leave_the_file_as_it_was(addon, with_shot, shot):
    scene = with_shot
    kinds = ("objects", "cameras", "meshes", "images", "actions", "collections", "node_groups")
    names = {kind: set(getattr(bpy.data, kind).keys()) for kind in kinds}
    settings = (scene.view_settings.view_transform, scene.render.dither_intensity, scene.render.resolution_x)
    bpy.ops.splannequin.load_camera()
    bpy.ops.splannequin.insert_freeze()
    assert scene.view_settings.view_transform == "Standard" and scene.render.dither_intensity == 0.0
    notes = addon("process.job_timer").watch_of(shot).notes
    assert notes["solve"] and notes["bake"]
    assert bpy.ops.splannequin.remove_shot() == {"FINISHED"}
    assert set(notes) == {"bake"}, "nothing says any more that the shot's camera is the scene's"
    assert {kind: set(getattr(bpy.data, kind).keys()) for kind in kinds} == names
    assert settings == (scene.view_settings.view_transform, scene.render.dither_intensity, scene.render.resolution_x)
    assert not any(map(lambda key: key.startswith("splannequin_"), scene.keys()))


def test_view_settings_change_only_with_consent(with_shot):
    with_shot.splannequin.keep_colours = False
    bpy.ops.splannequin.insert_freeze()
    assert with_shot.view_settings.view_transform == "AgX"


def test_bake_without_a_backend_renders_a_complete_take(
    addon, with_shot, shot, monkeypatch, tmp_path, pictures, layers
):
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(tmp_path / "gone"))
    scene = with_shot
    bpy.ops.splannequin.load_camera()
    assert bpy.ops.splannequin.bake() == {"FINISHED"}
    out = shot / "bake" / "freeze"
    assert sorted(p.name for p in out.iterdir()) == ["000005.png", "000006.png", "000007.png"]
    assert scene.view_settings.view_transform == "Standard"
    expected = pictures.srgb(layers(6)["rgba"][1:, 1:, :3])
    assert abs(pictures.read(out / "000006.png")[1:, 1:] - expected).max() * 255 < 0.6


def test_the_artists_output_path_is_kept(addon, with_shot, shot, tmp_path):
    with_shot.render.filepath = str(tmp_path / "mine_")
    assert addon("bake.rendering").choose_output(with_shot, shot, "freeze") == []
    assert with_shot.render.filepath == str(tmp_path / "mine_")


def test_t_star_is_clamped_to_the_clip(with_shot):
    with_shot.frame_set(200)
    bpy.ops.splannequin.t_star_here()
    assert with_shot.splannequin.t_star == 7 and with_shot.splannequin.choose_t_star


def test_bake_requests_the_take_with_its_stored_parameters(addon, with_shot):
    params = addon("process.steps").STEPS["bake"].params(with_shot)
    assert (params.run, params.take, params.t_star, params.width, params.only_missing) == (
        "main",
        "freeze",
        6,
        16,
        True,
    )
    with_shot.splannequin.choose_t_star, with_shot.splannequin.t_star = True, 7
    assert addon("process.steps").STEPS["bake"].params(with_shot).t_star == 7


def test_the_timer_applies_a_job_that_ended_and_gives_each_step_its_words(addon, scene, clip, tmp_path):
    props = scene.splannequin
    props.clip, props.shot_path = str(clip), str(tmp_path / "t.splannequin")
    props.use_range, props.first, props.last = True, 1, 8
    job = addon("process.begin").begin(scene, "import")
    supervisor = addon("process.job_timer")
    supervisor.follow("import", job)
    watch = supervisor.watch_of(job.shot)
    assert watch.running() == "import"
    job.process.wait()
    while watch.running():
        assert supervisor.tick() == supervisor.TICK_SECONDS
    assert watch.state.frames == 8
    assert "Frame range set to 1 to 8." in watch.notes["import"] and scene.frame_end == 8


def test_every_step_is_whole_and_of_the_one_vocabulary(addon, contract):
    steps = addon("process.steps").STEPS
    assert list(steps) == ["import", "solve", "train", "freeze", "bake"]
    for name, step in steps.items():
        assert step.label == name.capitalize() and step.kind in contract.PARAMS and step.button and step.again
        assert bool(step.needs) != step.makes_shot, "one begins, the others say what comes before"
        (button,) = [c for c in step.classes if getattr(c, "bl_idname", "") == step.panel.operator]
        assert step.panel.step == button.step == name and step.panel.title.endswith(step.label)


@pytest.mark.parametrize("step", ["import", "solve", "train", "freeze", "bake"])
def test_each_step_says_what_comes_next(addon, scene, step):
    view = addon("process.steps").STEPS[step].view(scene, None)
    assert view.advice.endswith(".") and not view.done
    assert view.ready == (step == "import")


def test_a_finished_shot_shows_its_figures(addon, with_shot, shot):
    steps, state = addon("process.steps").STEPS, addon("shot.inventory").read(shot)
    shown = {name: step.view(with_shot, state) for name, step in steps.items()}
    assert shown["import"].state == ["3 frames, 5 to 7", "16 x 12, 12.5 fps"]
    assert shown["solve"].state == ["A good solve."] and "Load the camera" in shown["solve"].advice
    assert shown["train"].state == ["Run main: 24.0 dB on held-out frames", "12,345 Gaussians, 5.0 % may move"]
    assert shown["freeze"].state == ["Time stands still at frame 6", "Take freeze: 3 frames, 16 x 12"]
    assert not shown["bake"].done and shown["bake"].ready


def test_every_button_and_setting_has_a_tooltip(addon):
    classes = [*addon("ui.job_operators").CLASSES, *addon("ui.shots_panel").CLASSES]
    classes += [cls for step in addon("process.steps").STEPS.values() for cls in step.classes]
    operators = [cls for cls in classes if issubclass(cls, bpy.types.Operator)]
    assert len(operators) > 25
    for cls in operators:
        kind = getattr(bpy.ops.splannequin, cls.bl_idname.partition(".")[2]).get_rna_type()
        assert len(kind.description) > 10 and not kind.description.endswith("."), cls
        for prop in kind.properties:
            assert prop.identifier == "rna_type" or prop.description, (cls, prop.identifier)
    for prop in bpy.types.Scene.bl_rna.properties["splannequin"].fixed_type.properties:
        assert prop.identifier in ("rna_type", "name") or prop.description, prop.identifier


def test_a_newer_shot_is_refused_in_words(addon, contract, tmp_path: Path):
    (tmp_path / "shot.json").write_text('{"version": 99, "name": "x"}')
    with pytest.raises(ValueError, match="version 99"):
        addon("shot.inventory").read(tmp_path)
    watch = addon("process.job_timer").watch_of(tmp_path)
    assert "version 99" in watch.failures["import"][0], "the panel shows it instead of breaking"


def test_no_button_meets_a_newer_or_damaged_shot_with_a_traceback(scene, shot, tmp_path, monkeypatch, capfd):
    """The poll functions, which run at every draw, do not fail either."""
    scene.splannequin.shot_path = str(shot)
    # without a backend, Bake reads the shot itself
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(tmp_path / "gone"))
    for text in ('{"version": 99, "name": "x"}', "{"):
        (shot / "shot.json").write_text(text)
        assert not bpy.ops.splannequin.export_for_farm.poll()
        for name in ("bake", "freeze", "solve_camera", "train", "import_clip"):
            with pytest.raises(RuntimeError) as error:
                getattr(bpy.ops.splannequin, name)()
            assert "Traceback" not in str(error.value), name
    assert "Traceback" not in capfd.readouterr().err


def test_damaged_points_give_a_readable_error(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    points = shot / "solve" / "points.npz"
    whole = points.read_bytes()
    archive = io.BytesIO()
    np.savez(archive, other=np.zeros(3))
    for data in (whole[: len(whole) // 2], b"", b"no archive", archive.getvalue()):
        points.write_bytes(data)
        with pytest.raises(RuntimeError) as error:
            bpy.ops.splannequin.load_camera()
        assert str(error.value).strip() == f"Error: {points} is damaged. Solve again."
    german = addon("translations").translate(f"{points} is damaged. Solve again.", "de_DE")
    assert german == f"{points} ist beschädigt. Die Kamera neu lösen."
    points.write_bytes(whole)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}


def imported(addon, scene, clip, name: Path) -> Path:
    """Import a copy of the clip, called `name`, in the scene; return its shot folder."""
    name.parent.mkdir(exist_ok=True)
    shutil.copy(clip, name)
    scene.splannequin.clip = str(name)
    addon("process.begin").run(scene, "import")
    return addon("shot.selection").shot_folder(scene)


@pytest.fixture
def a_few(scene):
    """Scene set to import eight frames."""
    scene.splannequin.use_range, scene.splannequin.first, scene.splannequin.last = True, 1, 8
    return scene


def recorded(addon, contract, scene, name: Path) -> Path:
    """Write the records of an import of a clip, called `name`, in the scene; return its shot folder."""
    name.parent.mkdir(exist_ok=True)
    name.touch()
    scene.splannequin.clip = str(name)
    folder = addon("shot.selection").shot_folder(scene)
    if not folder.exists():
        addon("shot.inventory").create(folder)
        info, record = folder / "shot.json", {"version": 1, "frames": [], "beside": os.path.relpath(name, folder)}
        contract.write_json(info, {**contract.read_json(info), "source": str(name)})
        contract.write_json(folder / "frames" / "frames.json", record)
    return folder


def test_two_clips_that_differ_in_their_ending_have_a_shot_each(addon, contract, a_few, clip, tmp_path):
    first = imported(addon, a_few, clip, tmp_path / "a.mov")
    second = recorded(addon, contract, a_few, tmp_path / "a.mp4")
    assert (first, second) == (tmp_path / "a.splannequin", tmp_path / "a.mp4.splannequin")
    sources = [addon("shot.source").named(folder) for folder in (first, second)]
    assert sources == [str(tmp_path / "a.mov"), str(tmp_path / "a.mp4")]
    for name, folder in (("a.mov", first), ("a.mp4", second)):
        assert recorded(addon, contract, a_few, tmp_path / name) == folder, "the same clip again"
    assert not addon("shot.selection").missing(a_few, addon("shot.inventory").read(second))
    shutil.rmtree(first)
    addon("shot.selection").clear_cache()
    assert addon("shot.selection").shot_folder(a_few) == second, "its own shot, though the shorter name is free"
    (tmp_path / "a").mkdir()
    a_few.splannequin.clip = str(tmp_path / "a")
    assert addon("shot.selection").shot_folder(a_few) == first


def test_a_clip_and_its_shot_stay_together_wherever_they_are_taken(addon, contract, a_few, tmp_path):
    recorded(addon, contract, a_few, tmp_path / "here" / "a.mov")
    shutil.copytree(tmp_path / "here", tmp_path / "copy")
    a_few.splannequin.clip = str(tmp_path / "copy" / "a.mov")
    assert addon("shot.selection").shot_folder(a_few) == tmp_path / "copy" / "a.splannequin"
    (tmp_path / "here").rename(tmp_path / "there")
    a_few.splannequin.clip = str(tmp_path / "there" / "a.mov")
    assert addon("shot.selection").shot_folder(a_few) == tmp_path / "there" / "a.splannequin"


def test_the_shot_of_another_clip_in_a_folder_that_was_chosen_is_not_replaced_without_a_question(
    addon, contract, a_few, tmp_path
):
    replaces, props = addon("footage.operators").replaces, a_few.splannequin
    props.shot_path = str(tmp_path / "own.splannequin")
    props.clip = str(tmp_path / "A" / "shot.mp4")
    assert not replaces(a_few), "nothing is there yet"
    recorded(addon, contract, a_few, tmp_path / "A" / "shot.mp4")
    assert not replaces(a_few), "the same clip again"
    props.clip = str(tmp_path / "B" / "shot.mp4")
    question = replaces(a_few)
    assert question.startswith(f"own.splannequin is the shot of {tmp_path / 'A' / 'shot.mp4'}. Its frames")
    assert addon("translations").translate(question, "de_DE").startswith("own.splannequin ist der Shot von ")
    props.clip = ""
    assert not replaces(a_few), "its own clip is taken"


def test_a_render_that_does_not_start_leaves_the_panel_free(addon, with_shot, shot, tmp_path):
    bpy.ops.splannequin.insert_freeze()
    with_shot.frame_start = with_shot.frame_end = 5
    (tmp_path / "file").write_text("in the way")
    with_shot.render.filepath = str(tmp_path / "file" / "######")
    with pytest.raises(RuntimeError, match="is a file where a folder is needed"):
        bpy.ops.splannequin.render()
    assert addon("process.job_timer").watch_of(shot).running() is None


def test_bake_requests_ramp_or_path_as_stored(addon, shot):
    path = shot / "takes" / "freeze" / "take.json"
    facts = json.loads(path.read_text())
    ramp = {"5": 5.0, "6": 5.5}
    path.write_text(json.dumps({**facts, "last": 6, "t_star_per_frame": ramp, "camera_path": "/a/path.json"}))
    params = addon("freeze.takes").take_params(shot, "freeze")
    assert (params.first, params.last, params.t_star_per_frame, params.camera_path) == (5, 6, ramp, "/a/path.json")


def test_a_step_is_refused_while_another_of_the_shot_runs(addon, contract, scene, clip, tmp_path):
    props = scene.splannequin
    props.clip, props.shot_path = str(clip), str(tmp_path / "t.splannequin")
    job = addon("process.begin").begin(scene, "import")
    try:
        with pytest.raises(contract.JobError, match="is still running|has been running on"):
            addon("process.begin").begin(scene, "import")
    finally:
        job.process.kill()
        job.process.wait()
    assert len(list((tmp_path / "t.splannequin" / "jobs").iterdir())) == 1


def test_rediscovered_job_belongs_to_its_step(addon, contract, shot):
    jobs, steps = addon("process.jobs"), addon("process.steps")
    job = jobs.new_job(shot, "freeze", contract.FreezeParams())
    assert steps.step_of(job) == "freeze", "a job of the backend's own command line names no step"
    (job.folder / "step").write_text("bake")
    watch = addon("process.job_timer").watch_of(shot)
    assert watch.running() == "bake" and watch.jobs["bake"].folder == job.folder


def test_one_broken_shot_does_not_end_the_timer(addon, with_shot, shot, tmp_path, capfd):
    supervisor = addon("process.job_timer")
    broken, sound = supervisor.watch_of(tmp_path), supervisor.watch_of(shot)
    broken.jobs["train"] = types.SimpleNamespace(ended=False)
    sound.redraw = True
    for _ in range(50):  # if a turn takes too long, as on a busy machine, jobs wait for the next
        assert supervisor.tick() == supervisor.TICK_SECONDS and not sound.redraw
        if broken.failures:
            break
    assert "AttributeError" in broken.failures["train"][0] and "Traceback" in capfd.readouterr().err


def test_a_view_that_the_colour_configuration_lacks_is_said(addon, contract, scene, monkeypatch):
    setup = addon("scene.scene_setup")
    monkeypatch.setattr(setup, "NEUTRAL_VIEWS", ("Plain",))
    with pytest.raises(contract.JobError, match=r"no view that keeps colours unchanged \(Plain\)"):
        setup.keep_plate_colours(scene)
    assert scene.view_settings.view_transform == "AgX"


def test_a_dropped_video_becomes_the_clip_and_an_earlier_shot_stays_on_disk(scene, shot, clip):
    props = scene.splannequin
    props.shot_path = str(shot)
    assert bpy.ops.splannequin.use_clip(filepath=str(clip)) == {"FINISHED"}
    assert (props.clip, props.shot_path) == (str(clip), "")
    props.shot_path = str(shot)
    bpy.ops.splannequin.use_clip(filepath=str(clip))
    assert props.shot_path == str(shot), "the same clip again changes nothing"
    handler = bpy.types.SPLANNEQUIN_FH_video
    assert handler.bl_import_operator == "splannequin.use_clip" and ".mp4" in handler.bl_file_extensions.split(";")
    assert not bpy.ops.splannequin.use_movie_clip.poll()


def test_marker_and_instant_follow_whichever_changed_last(addon, with_shot, shot):
    scene, markers = with_shot, addon("shot.markers")
    scene.splannequin.t_star = 6
    bpy.ops.splannequin.t_star_marker()
    marker = scene.timeline_markers[markers.NAME]
    assert marker.frame == 6 and not markers.follow(scene)
    marker.frame = 7
    assert markers.follow(scene)
    assert (scene.splannequin.t_star, scene.splannequin.choose_t_star) == (7, True)
    scene.splannequin.t_star = 5
    assert markers.follow(scene) and marker.frame == 5
    markers.forget()
    marker.frame = 6
    markers.follow(scene)
    assert marker.frame == 5, "after a file load the setting in the file leads"
    scene.name = "renamed"
    marker.frame = 7
    assert markers.follow(scene) and scene.splannequin.t_star == 7, "known by another name"
    artists_marker = scene.timeline_markers.new("mine", frame=3)
    assert "The marker t* was removed." in addon("process.begin").remove_all(scene, shot)
    assert list(scene.timeline_markers) == [artists_marker]


def test_what_the_artist_changed_since_is_not_taken_back(addon, scene, shot):
    setup = addon("scene.scene_setup")
    scene.splannequin.shot_path = str(shot)
    rate = scene.render.fps, scene.render.fps_base
    setup.fit_clip(scene, (16, 12), 12.5, (5, 7))
    setup.keep_plate_colours(scene)
    scene.render.resolution_x = 4000
    scene.view_settings.exposure = 1.5
    addon("process.begin").remove_all(scene, shot)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (4000, 12), "a size belongs together"
    assert scene.view_settings.exposure == 1.5 and scene.view_settings.view_transform == "AgX"
    assert (scene.render.fps, scene.render.fps_base) == rate and (scene.frame_start, scene.frame_end) == (1, 250)
    assert not [key for key in scene.keys() if key.startswith("splannequin_")]  # noqa: SIM118


def test_chosen_look_reaches_the_request(addon, scene, clip, tmp_path):
    look = tmp_path / "camera.cube"
    look.write_text("LUT_3D_SIZE 2\n" + "".join(f"{r} {g} {b}\n" for b in (0, 1) for g in (0, 1) for r in (0, 1)))
    scene.splannequin.clip, scene.splannequin.lut = str(clip), str(look)
    assert addon("process.steps").STEPS["import"].params(scene).lut == str(look)


def test_the_artists_look_comes_back_unless_the_artists_new_view_lacks_it(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    scene.view_settings.look = "AgX - Punchy"
    addon("scene.scene_setup").keep_plate_colours(scene)
    assert bpy.ops.splannequin.remove_shot() == {"FINISHED"}
    assert (scene.view_settings.view_transform, scene.view_settings.look) == ("AgX", "AgX - Punchy")
    addon("scene.scene_setup").keep_plate_colours(scene)
    scene.view_settings.view_transform = "Filmic"
    assert bpy.ops.splannequin.remove_shot() == {"FINISHED"}, "also without its view"
    assert (scene.view_settings.view_transform, scene.view_settings.look) == ("Filmic", "None")
    assert not [key for key in scene.keys() if key.startswith("splannequin_")]  # noqa: SIM118


def test_a_stored_view_that_this_configuration_lacks_does_not_stop_a_removal(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    addon("scene.scene_setup").keep_plate_colours(scene)
    stored = json.loads(scene["splannequin_settings_before"])
    stored["view"]["view_transform"] = "ACES 1.0 - SDR Video"
    scene["splannequin_settings_before"] = json.dumps(stored)
    assert bpy.ops.splannequin.remove_shot() == {"FINISHED"}
    assert scene.view_settings.view_transform == "Standard"


def test_each_take_has_its_own_folder_of_rendered_images(addon, with_shot, shot, tmp_path, new_take):
    rendering, second_shot = addon("bake.rendering"), tmp_path / "second.splannequin"
    new_take(shot, "later")
    shutil.copytree(shot, second_shot)
    rendering.choose_output(with_shot, shot, "freeze")
    assert rendering.choose_output(with_shot, shot, "later")
    assert Path(with_shot.render.filepath) == shot / "bake" / "later" / "######"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    scene = bpy.context.scene
    assert rendering.choose_output(scene, shot, "later") == []
    assert rendering.choose_output(scene, second_shot, "later"), "nor is one shot rendered over another"
    assert Path(bpy.path.abspath(scene.render.filepath)) == second_shot / "bake" / "later" / "######"
    scene.render.filepath = artists = "//second.splannequin/bake/later v2/######"
    assert rendering.choose_output(scene, shot, "later") == [] and scene.render.filepath == artists
