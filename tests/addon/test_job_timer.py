"""The timer: Blender's own work in turns, requests to the backend, ended jobs, and renders that it follows."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import bpy
import pytest

from tests.addon.data.pixels import set_format


@pytest.fixture
def supervisor(addon):
    return addon("process.job_timer")


@pytest.fixture
def watch(supervisor, scene, shot):
    scene.splannequin.shot_path = str(shot)
    return supervisor.watch_of(shot)


def test_work_is_done_a_turn_at_a_time_and_shows_how_far_it_is(supervisor, watch, shot):
    done = []

    def turns():
        for n in (1, 2):
            done.append(n)
            yield supervisor.Progress(f"Reading the camera, frame {n} of 2", n, 2)
        done.append("end")

    watch.notes["freeze"] = ["of before"]
    supervisor.work(shot, "freeze", turns())
    assert done == [] and watch.running() == "freeze" and "freeze" not in watch.notes
    assert supervisor.tick() == supervisor.WORKING_SECONDS and done == [1]
    assert (watch.work.progress.done, watch.work.progress.total) == (1, 2)
    supervisor.tick()
    assert done == [1, 2] and watch.running() == "freeze"
    assert supervisor.tick() == supervisor.TICK_SECONDS
    assert done == [1, 2, "end"] and watch.running() is None and not watch.failures


def test_work_that_fails_says_why_and_is_over(supervisor, contract, watch, shot):
    def turns():
        yield None
        raise contract.JobError("The camera is gone.", "Choose another one.")

    supervisor.work(shot, "freeze", turns())
    supervisor.tick()
    supervisor.tick()
    assert watch.failures == {"freeze": ("The camera is gone.", "Choose another one.")} and watch.running() is None


def test_what_the_last_turn_begins_goes_on(supervisor, watch, shot):
    def turns():
        yield None
        supervisor.watch_of(shot).work = supervisor.Work("bake", None, supervisor.Progress("Rendering", 0, 3))

    supervisor.work(shot, "bake", turns())
    supervisor.tick()
    supervisor.tick()
    assert watch.running() == "bake" and watch.work.turns is None, "Blender renders by itself"


def test_a_shot_that_cannot_be_read_for_a_moment_is_read_again(contract, supervisor, watch, shot):
    """Size and time of the file stay equal: the network disk was away, or Windows replaced the file during a read."""
    file = contract.ShotFolder(shot).info_path
    whole = file.read_bytes()
    assert watch.state.info
    file.write_bytes(b"{")
    assert supervisor.refresh(watch) and not watch.state.info
    assert "cannot be read" in watch.failures["import"][0]
    assert not supervisor.refresh(watch)  # nothing new to draw
    damaged = file.stat()
    file.write_bytes(whole)
    os.utime(file, ns=(damaged.st_atime_ns, damaged.st_mtime_ns))
    assert supervisor.refresh(watch) and watch.state.info
    assert "import" not in watch.failures


def test_failing_callback_does_not_stop_the_timer(supervisor, capfd):
    calls = []
    supervisor.call_until_false(lambda: 1 / 0)
    supervisor.call_until_false(lambda: len(calls) < 2 and not calls.append(len(calls)))
    for _ in range(4):
        supervisor.tick()
    assert calls == [0, 1] and not supervisor._callbacks
    assert capfd.readouterr().err.count("ZeroDivisionError") == 1


def test_a_job_with_much_output_does_not_starve_the_others(addon, contract, supervisor, tmp_path):
    """The first job uses up the whole budget of a check. The next check begins with the other one."""
    jobs = []
    for name, events in (("first", 200_000), ("second", 1)):
        (tmp_path / name).mkdir()
        job = addon("process.jobs").new_job(tmp_path / name, "import", contract.ImportParams(source="clip.mp4"))
        line = json.dumps({"type": "note", "seq": 0, "time": 0.0, "data": {}}) + "\n"
        (job.folder / contract.EVENTS_FILE).write_text(line * events, encoding="utf-8")
        supervisor.follow("import", job)
        jobs.append(job)
    first, second = jobs
    supervisor.tick()
    assert 0 < first.read_to < (first.folder / contract.EVENTS_FILE).stat().st_size and not second.read_to
    supervisor.tick()
    assert second.read_to


def test_bake_with_finished_frames_is_inserted_step_by_step(addon, contract, supervisor, watch, shot):
    """The turns are: read a picture, read the next, change the compositor, render. Blender blocks during each turn."""
    params = contract.FreezeParams(take="freeze")
    job = addon("process.jobs").new_job(shot, "freeze", params)
    job.status = contract.Status("freeze", "done", 0, 0.0, 1.0, 0.0)
    images = len(bpy.data.images)
    supervisor.follow("bake", job)
    supervisor._ended(watch, "bake", job)
    group_node, tree = addon("bake.freeze_group").group_node, addon("compat").compositor_tree
    assert watch.running() == "bake" and len(bpy.data.images) == images
    supervisor.tick()
    assert len(bpy.data.images) == images + 1 and tree(bpy.context.scene) is None
    supervisor.tick()
    assert len(bpy.data.images) == images + 2 and tree(bpy.context.scene) is None
    supervisor.tick()
    assert group_node(tree(bpy.context.scene)) is not None and watch.notes["bake"]
    assert watch.running() == "bake" and not watch.failures, "the render begins with the next turn"


def ended_bake(addon, contract, supervisor, watch, shot, scene: str, uid: int = 0):
    """Let a bake end whose frames exist. The job stores the scene's name and, in this session, its number `uid`."""
    job = addon("process.jobs").new_job(shot, "freeze", contract.FreezeParams(take="freeze"))
    (job.folder / contract.SCENE_FILE).write_text(scene, encoding="utf-8")
    job.scene_uid = uid
    job.status = contract.Status("freeze", "done", 0, 0.0, 1.0, 0.0)
    supervisor.follow("bake", job)
    supervisor._ended(watch, "bake", job)


def until_it_renders(supervisor, watch):
    """Run the turns of a bake up to the one that renders."""
    for _ in range(3):
        if watch.work is not None and not watch.notes.get("bake"):
            supervisor.tick()


def baked(addon) -> list[str]:
    group_node, tree = addon("bake.freeze_group").group_node, addon("compat").compositor_tree
    return [s.name for s in bpy.data.scenes if tree(s) is not None and group_node(tree(s)) is not None]


def test_bake_is_inserted_only_into_the_requesting_scene(addon, contract, supervisor, watch, shot):
    second_scene = bpy.data.scenes.new("A lookdev")
    second_scene.splannequin.shot_path = str(shot)
    before = second_scene.view_settings.view_transform
    ended_bake(addon, contract, supervisor, watch, shot, "Scene")
    until_it_renders(supervisor, watch)
    assert baked(addon) == ["Scene"] and second_scene.view_settings.view_transform == before and not watch.failures
    addon("bake.insertion").remove(bpy.data.scenes["Scene"])
    watch.work = None
    ended_bake(addon, contract, supervisor, watch, shot, "A lookdev")
    until_it_renders(supervisor, watch)
    assert baked(addon) == ["A lookdev"] and "A lookdev is not open in any window" in watch.notes["bake"][-1]


def test_a_bake_of_a_scene_that_is_gone_comes_into_those_of_the_shot(addon, contract, supervisor, watch, shot):
    second_scene = bpy.data.scenes.new("A lookdev")
    second_scene.splannequin.shot_path = str(shot)
    ended_bake(addon, contract, supervisor, watch, shot, "deleted since")
    until_it_renders(supervisor, watch)
    assert sorted(baked(addon)) == ["A lookdev", "Scene"]


def test_a_bake_comes_into_its_scene_though_that_is_renamed_meanwhile(addon, contract, supervisor, watch, scene, shot):
    """It is renamed during the job and between the turns. Another scene gets its old name."""
    uid = scene.session_uid
    scene.name = "renamed"
    second_scene = bpy.data.scenes.new("Scene")
    second_scene.splannequin.shot_path = str(shot)
    ended_bake(addon, contract, supervisor, watch, shot, "Scene", uid)
    supervisor.tick()
    scene.name = "renamed again"
    until_it_renders(supervisor, watch)
    assert baked(addon) == ["renamed again"] and not watch.failures


def test_bake_of_a_deleted_scene_changes_no_other_scene(addon, contract, supervisor, watch, shot):
    second_scene = bpy.data.scenes.new("A lookdev")
    second_scene.splannequin.shot_path = str(shot)
    ended_bake(addon, contract, supervisor, watch, shot, "A lookdev", second_scene.session_uid)
    bpy.data.scenes.remove(second_scene)
    for _ in range(4):
        supervisor.tick()
    assert watch.work is None and baked(addon) == [] and not watch.failures


def test_bake_is_only_reported_if_the_scene_changed_its_shot(addon, contract, supervisor, watch, shot):
    second_scene = bpy.data.scenes.new("A lookdev")
    second_scene.splannequin.shot_path = str(shot)
    bpy.data.scenes["Scene"].splannequin.shot_path = str(shot.parent / "another.splannequin")
    ended_bake(addon, contract, supervisor, watch, shot, "Scene")
    assert watch.work is None and baked(addon) == [] and "Bake again" in watch.notes["bake"][0]


def test_a_job_keeps_the_name_of_its_scene(addon, scene, shot):
    """The name is stored in the job's folder, where a later session finds it."""
    scene.name, scene.splannequin.shot_path, scene.splannequin.take_name = "Comp é", str(shot), "freeze"
    job = addon("process.begin").begin(scene, "bake")
    job.process.kill()
    job.process.wait()
    found = addon("process.jobs").open_job(job.folder)
    assert addon("process.steps").scene_of(found) == "Comp é" and addon("process.steps").step_of(found) == "bake"


def test_job_names_the_blend_file_that_started_it(addon, contract, scene, shot):
    started_in = addon("ui.step_panel").started_elsewhere
    scene.splannequin.shot_path, scene.splannequin.take_name = str(shot), "freeze"
    bpy.ops.wm.save_as_mainfile(filepath=str(shot.parent / "a é.blend"))
    job = addon("process.begin").begin(bpy.context.scene, "freeze")
    assert job.blend == "a é.blend" and not started_in(job)
    job.process.kill()
    job.process.wait()
    addon("process.job_timer").forget()
    found = addon("process.job_timer").watch_of(shot).jobs["freeze"]
    assert not started_in(found), "the same file"
    bpy.ops.wm.save_as_mainfile(filepath=str(shot.parent / "b.blend"))
    assert started_in(found) and found.blend == "a é.blend"
    (found.folder / contract.BLEND_FILE).unlink()
    addon("process.job_timer").forget()
    assert not started_in(addon("process.job_timer").watch_of(shot).jobs["freeze"]), "of a command line"


def test_a_job_that_had_ended_before_it_was_met_renders_nothing(addon, contract, supervisor, scene, shot, monkeypatch):
    """This holds even if the job's events are too many for the first read."""
    jobs = addon("process.jobs")
    job = jobs.new_job(shot, "freeze", contract.FreezeParams(take="freeze"))
    (job.folder / contract.STEP_FILE).write_text("bake")
    events = [contract.Event("warning", 1, 1.0, {"message": f"n {n}"}) for n in range(3)]
    events.append(contract.Event("done", 1, 1.0, {"result": {}}))
    (job.folder / contract.EVENTS_FILE).write_text("".join(json.dumps(e.__dict__) + "\n" for e in events))
    status = contract.Status(job.folder.name, "done", 1, 1.0, 2.0, 2.0, fraction=1.0)
    (job.folder / contract.STATUS_FILE).write_text(json.dumps(status.__dict__))
    monkeypatch.setattr(jobs, "_FIRST_LOOK_SECONDS", -1.0)
    scene.splannequin.shot_path = str(shot)
    scene.frame_start = scene.frame_end  # keeps an unwanted render short
    watch = supervisor.watch_of(shot)
    assert not watch.jobs["bake"].ended, "there is more to read"
    for _ in range(5):
        supervisor.tick()
    assert watch.jobs["bake"].state == "done" and len(watch.jobs["bake"].warnings) == 3
    assert watch.work is None and baked(addon) == []


@pytest.fixture
def small(addon, scene, tmp_path):
    """Scene of three small frames with a render that has begun."""
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.frame_end = 3
    scene.render.filepath = str(tmp_path / "out" / "f_####")
    tree = addon("compat").new_compositor_tree(scene, "Mine")
    colour = tree.nodes.new("CompositorNodeRGB")
    tree.links.new(colour.outputs[0], addon("compat").output_socket(tree))
    addon("compat").enable_compositor(scene)
    run = addon("bake.rendering").Run(scene)
    run.begin(scene)
    return scene, run


def test_a_render_is_followed_by_its_handlers(addon, supervisor, watch, shot, small):
    scene, run = small
    seen = []

    def see(*_) -> None:
        seen.append((watch.running(), watch.work.progress.text, watch.redraw))

    addon("bake.progress").began(shot, run)
    bpy.app.handlers.render_write.append(see)
    try:
        bpy.ops.render.render(animation=True)
    finally:
        bpy.app.handlers.render_write.remove(see)
    assert seen[1] == ("bake", "Rendering, frame 2 of 3", True)
    supervisor.tick()
    assert watch.running() is None and watch.notes["bake"][0] == "3 of 3 frames rendered."
    assert scene.render.filepath.endswith("f_####") and not supervisor._callbacks
    assert len(list(Path(bpy.path.abspath(scene.render.filepath)).parent.iterdir())) == 3


def test_no_draw_is_interrupted_while_a_render_goes_on(small):
    """If a render begins while a panel is drawn, Blender 4.3 refuses all later writes of Python to its data."""
    scene, run = small
    assert sys.getswitchinterval() >= 1.0
    run.finish(scene, is_cancelled=True)
    assert sys.getswitchinterval() == pytest.approx(0.005)


@pytest.fixture
def unwritable_movie(scene, tmp_path):
    """Scene that writes a movie into a folder that cannot be created: Blender calls no handler at the end of its
    render."""
    (tmp_path / "file").write_text("")
    set_format(scene, "FFMPEG")
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.frame_end = 2
    scene.render.filepath = str(tmp_path / "file" / "inside" / "movie")
    return scene


def test_a_render_that_tells_no_end_is_over(addon, supervisor, watch, shot, small):
    """Blender leaves this state if it cannot create a movie file."""
    scene, run = small
    addon("bake.progress").began(shot, run)
    supervisor.tick()
    assert watch.running() == "bake", "the job of a render may be about to begin"
    supervisor.tick()
    assert watch.running() is None and not supervisor._callbacks
    assert "wrote no image for frame 1" in watch.failures["bake"][0]
    assert scene.render.filepath.endswith("f_####")


def test_a_render_that_wrote_nothing_is_no_success(watch, unwritable_movie):
    with pytest.raises(RuntimeError, match="where a folder is needed"):
        bpy.ops.splannequin.render("EXEC_DEFAULT")
    assert watch.running() is None


def test_cancel_ends_a_render_that_is_no_more(addon, supervisor, watch, shot, small):
    addon("bake.progress").began(shot, small[1])
    assert bpy.ops.splannequin.cancel(step="bake") == {"FINISHED"}
    assert watch.running() is None
    supervisor.tick()
    assert not watch.failures and small[0].render.filepath.endswith("f_####")


def test_another_file_ends_what_blender_itself_was_doing(supervisor, watch, shot):
    supervisor.work(shot, "freeze", iter([None, None]))
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert watch.work is None


def test_undo_takes_back_what_a_step_said_of_the_scene(supervisor, watch):
    """The nodes that the message describes no longer exist."""
    bpy.ops.ed.undo_push(message="before")
    bpy.context.scene.frame_end += 1
    bpy.ops.ed.undo_push(message="a step")
    watch.notes["bake"] = ["The node group was inserted."]
    bpy.ops.ed.undo()
    assert not watch.notes


def test_what_pulses_sets_the_pace_and_jobs_keep_theirs(supervisor, watch, monkeypatch):
    looks, pulses = [], []
    monkeypatch.setattr(supervisor, "_jobs_next", 0.0)
    monkeypatch.setattr(supervisor, "_turn", lambda *_: bool(looks.append(1)))

    def turn():
        pulses.append(1)
        return 0.01 if len(pulses) < 5 else None

    supervisor.pulse(turn)
    supervisor.pulse(turn)  # the turn is registered only once
    try:
        waits = [supervisor.tick() for _ in range(4)]
        assert len(pulses) == 4 and len(looks) == 1, "jobs were looked at a moment ago"
        assert all(0.0 <= wait <= 0.01 for wait in waits)
        assert supervisor.tick() == supervisor.TICK_SECONDS, "it said None: the timer is the jobs' again"
        assert supervisor.tick() == supervisor.TICK_SECONDS and len(pulses) == 5
    finally:
        supervisor.drop(turn)


def test_a_pulse_that_fails_does_not_stop_the_timer(supervisor, watch, capsys):
    def broken():
        raise RuntimeError("of no use")

    supervisor.pulse(broken)
    assert supervisor.tick() == supervisor.TICK_SECONDS
    assert "of no use" in capsys.readouterr().err


@pytest.fixture
def solving(addon, contract, supervisor, watch, shot):
    """A running solve of a shot whose cameras are on the disk, and `tell`, which writes an event of the solve."""
    job = addon("process.jobs").new_job(shot, "solve", contract.SolveParams())
    job.process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    events = []

    def tell(kind, in_all="running", /, **data):
        now = time.time()
        events.append(contract.Event(kind, len(events), now, data))
        lines = [json.dumps(dataclasses.asdict(event)) for event in events]
        (job.folder / contract.EVENTS_FILE).write_text("\n".join(lines) + "\n")
        status = contract.Status("solve", in_all, job.process.pid, now, 0.0, now)
        contract.write_json(job.folder / contract.STATUS_FILE, dataclasses.asdict(status))
        supervisor.tick()

    supervisor.follow("solve", job)
    yield job, tell
    job.process.kill()
    job.process.wait()


def test_camera_arrives_during_the_solve_and_is_not_replaced_at_its_end(addon, scene, shot, watch, solving):
    job, tell = solving
    find = addon("solve.cameras").find
    tell("progress", stage="solve", done=1, total=2, message="")
    assert find(scene, shot, "CAMERA") is None
    tell("metric", stage="cameras known", values={})
    camera = find(scene, shot, "CAMERA")
    assert watch.running() == "solve" and scene.camera == camera and camera.data.background_images[0].image
    assert "is the scene's camera" in watch.notes["solve"][0]
    artists_camera = scene.camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    camera.data.background_images[0].alpha = 0.5
    tell("progress", stage="solve", done=3, total=4, message="")
    tell("done", "done", state="done", result={})
    assert job.ended and watch.running() is None and not watch.failures
    assert scene.camera == artists_camera and camera.data.background_images[0].alpha == 0.5
    assert find(scene, shot, "CAMERA") == camera


@pytest.mark.parametrize("state", ["cancelled", "failed"])
def test_a_solve_that_is_stopped_after_its_cameras_are_known_leaves_them(addon, scene, shot, watch, solving, state):
    _, tell = solving
    (shot / "solve" / "motion").mkdir()
    (shot / "solve" / "motion" / "unfinished.json").write_text("{}")
    tell("metric", stage="cameras known", values={})
    tell("done", state, state=state, result=None)
    assert watch.running() is None and addon("solve.cameras").find(scene, shot, "CAMERA") is not None
    said = addon("process.steps").STEPS["solve"].view(scene, watch.state).state
    assert any("What moves is not known yet" in line for line in said)
    (shot / "solve" / "motion" / "motion.json").write_text("{}")
    addon("process.job_timer").refresh(watch)
    said = addon("process.steps").STEPS["solve"].view(scene, watch.state).state
    assert not any("What moves" in line for line in said)
