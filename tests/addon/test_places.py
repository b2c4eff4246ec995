"""A moved project folder keeps working; a missing shot folder is reported and can be located, never created empty."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import bpy
import pytest


def blend(folder: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "work.blend"))


def opened(folder: Path):
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work.blend"))
    return bpy.context.scene


@pytest.fixture
def project(tmp_path, shot, clip, scene) -> Path:
    """Folder with a clip, its shot, and a file with absolute paths of both; the camera is loaded."""
    folder = tmp_path / "project"
    folder.mkdir()
    shutil.copy(clip, folder / "people.mp4")
    shutil.move(shot, folder / "people.splannequin")
    scene.splannequin.clip = str(folder / "people.mp4")
    bpy.ops.splannequin.load_camera()
    bpy.ops.splannequin.insert_freeze()
    return folder


def moved(project: Path) -> Path:
    return project.rename(project.with_name("elsewhere"))


def plate_file() -> Path:
    return Path(bpy.path.abspath(bpy.context.scene.camera.data.background_images[0].image.filepath))


def test_a_project_that_is_moved_as_a_whole_works_on(addon, project):
    blend(project)
    destination = moved(project)
    scene = opened(destination)
    assert addon("shot.selection").shot_folder(scene) == destination / "people.splannequin"
    assert addon("scene.paths").absolute(scene.splannequin.clip) == str(destination / "people.mp4")
    assert addon("process.steps").STEPS["import"].params(scene).source == str(destination / "people.mp4")
    assert addon("solve.cameras").find(scene, destination / "people.splannequin", "CAMERA") == scene.camera
    assert plate_file() == destination / "people.splannequin" / "frames" / "000005.png"
    assert (
        addon("process.steps")
        .STEPS["solve"]
        .view(scene, addon("shot.inventory").read(destination / "people.splannequin"))
        .done
    )


@pytest.mark.parametrize("name", ["ignore_path", "people_path", "st_map", "cameras_path", "depth"])
def test_solve_inputs_are_found_in_a_moved_project(addon, project, name):
    (project / "given.exr").touch()
    setattr(bpy.context.scene.splannequin, name, str(project / "given.exr"))
    blend(project)
    destination = moved(project)
    settings = opened(destination).splannequin
    assert addon("scene.paths").absolute(getattr(settings, name)) == str(destination / "given.exr")


def test_copied_project_uses_the_copied_files(addon, project):
    blend(project)
    copy = Path(shutil.copytree(project, project.with_name("copy")))
    scene = opened(copy)
    assert addon("shot.selection").shot_folder(scene) == copy / "people.splannequin"
    assert addon("solve.cameras").find(scene, copy / "people.splannequin", "CAMERA") == scene.camera


@pytest.mark.skipif(os.sep != "/", reason="there a backslash is what it is")
def test_file_saved_on_windows_finds_its_shot_on_other_systems(addon, project):
    """On Windows, Blender writes backslashes into relative paths."""
    (project / "scenes").mkdir()
    odd = project / "scenes" / "a\\b.exr"
    odd.touch()
    blend(project / "scenes")
    settings, image = bpy.context.scene.splannequin, bpy.context.scene.camera.data.background_images[0].image
    assert settings.clip == "//../people.mp4"
    for owner, name in ((settings, "clip"), (settings, "shot_path"), (image, "filepath")):
        setattr(owner, name, getattr(owner, name).replace("/", "\\").replace("\\\\", "//", 1))
    settings.st_map = "//a\\b.exr"
    bpy.ops.wm.save_mainfile()
    scene = opened(project / "scenes")
    assert addon("scene.paths").absolute(scene.splannequin.clip) == str(project / "people.mp4")
    assert addon("shot.selection").shot_folder(scene) == project / "people.splannequin"
    assert plate_file().resolve() == project / "people.splannequin" / "frames" / "000005.png"
    assert addon("scene.paths").absolute(scene.splannequin.st_map) == str(odd), "a name of Linux's own"


def test_older_file_with_absolute_paths_finds_its_neighbours(addon, project):
    bpy.context.preferences.filepaths.use_relative_paths = False
    try:
        blend(project)
        assert Path(bpy.context.scene.splannequin.clip).is_absolute(), "as the artist has set Blender"
    finally:
        bpy.context.preferences.filepaths.use_relative_paths = True
    destination = moved(project)
    scene = opened(destination)
    assert addon("shot.selection").shot_folder(scene) == destination / "people.splannequin"


def test_save_as_and_save_copy_keep_the_shot(addon, project, tmp_path):
    blend(project)
    (tmp_path / "other").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other" / "copy.blend"), copy=True)
    scene = bpy.context.scene
    assert addon("shot.selection").shot_folder(scene) == project / "people.splannequin", (
        "the open file stays where it is"
    )
    assert scene.splannequin.clip == "//people.mp4"
    blend(tmp_path / "other")
    assert addon("shot.selection").shot_folder(bpy.context.scene) == project / "people.splannequin"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other" / "copy.blend"))
    assert addon("shot.selection").shot_folder(bpy.context.scene) == project / "people.splannequin"


def output() -> Path:
    """Resolved output path of the scene."""
    return Path(bpy.path.abspath(bpy.context.scene.render.filepath)).resolve()


def painted_on(shot: Path):
    """Image for painting the matte of frame 6."""
    image = bpy.data.images.new("Motion", 4, 4)
    image["splannequin_matte"], image["splannequin_matte_shot"] = 6, str(shot)
    image.use_fake_user = True
    image.pixels[0] = 1.0
    image.pack()
    return image


def test_save_as_keeps_bake_output_and_paint(addon, project, tmp_path):
    shot, mattes = project / "people.splannequin", addon("solve.mattes")
    image = painted_on(shot)
    addon("bake.rendering").choose_output(bpy.context.scene, shot, "freeze")
    wanted = shot / "bake" / "freeze" / "######"
    blend(project)
    assert bpy.context.scene.render.filepath == "//people.splannequin/bake/freeze/######"
    destination = tmp_path / "other" / "deep"
    destination.mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(destination / "copy.blend"), copy=True)
    assert bpy.context.scene.render.filepath == "//people.splannequin/bake/freeze/######", "the open file stays"
    assert mattes.find_image(shot, 6) == image
    blend(destination)
    assert output() == wanted and mattes.find_image(shot, 6) is not None
    opened(destination)
    assert output() == wanted and mattes.find_image(shot, 6) is not None
    bpy.ops.wm.open_mainfile(filepath=str(destination / "copy.blend"))
    assert output() == wanted and mattes.find_image(shot, 6) is not None


@pytest.mark.parametrize("artists_path", ["//out/######", "//people.splannequin/bake/mine_####"])
def test_an_output_path_of_the_artists_is_left_as_it_is(project, tmp_path, artists_path):
    blend(project)
    bpy.context.scene.render.filepath = artists_path
    blend(tmp_path)
    assert bpy.context.scene.render.filepath == artists_path


def test_older_file_with_absolute_output_bakes_next_to_itself(addon, project):
    bpy.context.preferences.filepaths.use_relative_paths = False
    try:
        addon("bake.rendering").choose_output(bpy.context.scene, project / "people.splannequin", "freeze")
        blend(project)
    finally:
        bpy.context.preferences.filepaths.use_relative_paths = True
    destination = moved(project)
    opened(destination)
    assert output() == destination / "people.splannequin" / "bake" / "freeze" / "######"


def test_what_is_painted_and_where_a_bake_goes_follow_a_shot_that_is_located(addon, project):
    before, destination = project / "people.splannequin", project / "renamed.splannequin"
    painted_on(before)
    addon("bake.rendering").choose_output(bpy.context.scene, before, "freeze")
    blend(project)
    before.rename(destination)
    scene = opened(project)
    addon("shot.places").locate(scene, destination)
    assert output() == destination / "bake" / "freeze" / "######"
    assert addon("solve.mattes").find_image(destination, 6) is not None


def test_a_renamed_shot_is_missed_and_located(addon, contract, project):
    blend(project)
    addon("process.steps")
    before, destination = project / "people.splannequin", project / "renamed.splannequin"
    before.rename(destination)
    scene = opened(project)
    watch = addon("process.job_timer").watch_of(before)
    assert addon("shot.selection").missing(scene, watch.state)
    for step in ("solve", "train", "freeze", "bake"):
        with pytest.raises(contract.JobError, match="no longer exists") as error:
            addon("process.begin").begin(scene, step)
        assert "Locate" in error.value.hint
    with pytest.raises(contract.JobError):
        addon("freeze.takes").freeze_from(scene, contract.CameraPath(4, 4, []))
    assert not before.exists()
    with pytest.raises(RuntimeError, match="is not a shot folder"):
        bpy.ops.splannequin.locate_shot(directory=str(project))
    assert bpy.ops.splannequin.locate_shot(directory=f"{destination}/") == {"FINISHED"}
    assert (
        addon("shot.selection").shot_folder(scene) == destination
        and scene.splannequin.shot_path == "//renamed.splannequin"
    )
    assert addon("solve.cameras").find(scene, destination, "CAMERA") == scene.camera
    assert plate_file() == destination / "frames" / "000005.png"
    assert addon("bake.shown_take").shown(scene, destination) == "freeze", "the compositor's frames followed"
    assert not addon("shot.selection").missing(scene, addon("shot.inventory").read(destination))


def test_shot_before_its_first_import_is_not_reported_missing(addon, scene, tmp_path):
    scene.splannequin.clip = str(tmp_path / "new.mp4")
    folder = addon("shot.selection").shot_folder(scene)
    assert not addon("shot.selection").missing(scene, addon("shot.inventory").read(folder))


def test_the_timer_remembers_a_shot_that_was_chosen(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    addon("process.job_timer").watch_of(shot)
    addon("process.job_timer").tick()
    shot.rename(shot.with_name("gone"))
    assert addon("shot.selection").missing(scene, addon("shot.inventory").read(shot))


def test_moved_shot_finds_footage_next_to_it(addon, scene, shot, clip, tmp_path):
    info = json.loads((shot / "shot.json").read_text())
    (shot / "shot.json").write_text(json.dumps(info | {"source": "/nowhere/footage/people.mp4"}))
    places, shots = addon("shot.places"), addon("shot.inventory")
    assert places.source_of(shots.read(shot)) == ""
    (tmp_path / "footage").mkdir()
    shutil.copy(clip, tmp_path / "footage" / "people.mp4")
    listing = json.loads((shot / "frames" / "frames.json").read_text())
    (shot / "frames" / "frames.json").write_text(json.dumps(listing | {"beside": "../footage/people.mp4"}))
    assert places.source_of(shots.read(shot)) == str(tmp_path / "footage" / "people.mp4")
    places.locate(scene, shot)
    assert scene.splannequin.clip == str(tmp_path / "footage" / "people.mp4")
    (shot / "frames" / "frames.json").write_text(json.dumps(listing))
    shutil.move(tmp_path / "footage" / "people.mp4", tmp_path / "people.mp4")
    assert places.source_of(shots.read(shot)) == str(tmp_path / "people.mp4"), "of the same name, beside the shot"


def test_a_failed_import_leaves_no_empty_shot(addon, scene, tmp_path):
    wrong = tmp_path / "text.mp4"
    wrong.write_text("no video")
    scene.splannequin.clip = str(wrong)
    with pytest.raises(RuntimeError, match=r"text\.mp4"):
        bpy.ops.splannequin.import_clip()
    assert [p.name for p in tmp_path.iterdir()] == ["text.mp4"]
    assert addon("command_line.headless").main(["freeze", str(wrong), "--output", str(tmp_path / "out")]) == 3
    assert not list((tmp_path / "out").iterdir())


def test_failed_import_is_removed_after_its_process_ended(addon, contract, tmp_path):
    """The process reports its end before it releases the shot's lock and, on Windows, its log."""
    supervisor, jobs, shot = addon("process.job_timer"), addon("process.jobs"), tmp_path / "text.splannequin"
    addon("shot.inventory").create(shot)
    job = jobs.new_job(shot, "import", contract.ImportParams("text.mp4"))
    job.process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    pid, computer = job.process.pid, contract.computer_name()
    began = contract.process_start(pid)
    contract.write_json(
        contract.ShotFolder(shot).lock, dataclasses.asdict(contract.Writer(computer, pid, began, "import", "j", 1.0))
    )
    supervisor.follow("import", job)
    status = contract.Status("import", "failed", pid, 1.0, began, 1.0, message="No video.", exit_code=3, host=computer)
    contract.write_json(job.folder / contract.STATUS_FILE, dataclasses.asdict(status))
    supervisor.tick()
    assert job.ended and shot.is_dir()
    shown = supervisor.watch_of(shot).jobs["import"]
    assert shown.state == "failed" and shown.status.message == "No video."
    job.process.communicate(b"\n")
    supervisor.tick()
    assert not shot.exists()


def test_a_failed_import_takes_nothing_of_a_shot_that_has_frames(addon, shot, tmp_path):
    wrong = tmp_path / "text.mp4"
    wrong.write_text("no video")
    before = sorted(str(p) for p in shot.rglob("*"))
    assert addon("command_line.headless").main(["import", str(shot), str(wrong)]) == 3
    assert [p for p in sorted(str(p) for p in shot.rglob("*")) if "jobs" not in p] == before


def test_a_folder_that_is_not_ours_is_left_as_it_was(addon, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    (tmp_path / "text.mp4").write_text("no video")
    assert addon("command_line.headless").main(["import", str(folder), str(tmp_path / "text.mp4")]) == 2
    assert [p.name for p in folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("where", ["file/s.splannequin", "s" * 300, "/sys/kernel/s.splannequin"])
def test_a_folder_that_cannot_be_is_one_sentence(addon, scene, clip, tmp_path, where, capfd):
    (tmp_path / "file").write_text("a file")
    folder = tmp_path / where
    if where.startswith("/") and not Path("/sys/kernel").is_dir():
        pytest.skip("no folder here that even root cannot write to")
    scene.splannequin.clip, scene.splannequin.shot_path = str(clip), str(folder)
    with pytest.raises(RuntimeError, match="Cannot write to") as error:
        bpy.ops.splannequin.import_clip()
    assert str(error.value).strip().count("\n") == 0
    watch = addon("process.job_timer").watch_of(folder)
    assert "Cannot write to" in watch.failures["import"][0]
    addon("process.job_timer").tick()
    for step in addon("process.steps").STEPS.values():
        step.view(scene, watch.state)
    capfd.readouterr()
    assert addon("command_line.headless").main(["import", str(folder), str(clip)]) == 2
    said = capfd.readouterr().err
    assert said.startswith("Error: Cannot write to") and said.strip().count("\n") == 0


def test_a_keyed_camera_of_a_moved_shot_is_found(addon, shot):
    (shot / "paths").mkdir()
    shutil.copy(shot / "solve" / "cameras.json", shot / "paths" / "freeze.json")
    take_file = shot / "takes" / "freeze" / "take.json"
    take_file.write_text(json.dumps(json.loads(take_file.read_text()) | {"camera_path": "/nowhere/paths/freeze.json"}))
    assert addon("freeze.takes").take_params(shot, "freeze").camera_path == str(shot / "paths" / "freeze.json")


def test_images_linked_from_the_same_shot_of_another_project_are_not_used(addon, project, tmp_path):
    """Two projects made alike: what is linked from the one has the same relative paths as the other's images."""
    other = Path(shutil.copytree(project, tmp_path / "other"))
    blend(project)
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    blend(other)
    with bpy.data.libraries.load(str(project / "work.blend"), link=True) as (there, here):
        here.images = there.images
    linked = {i.name: i.filepath for i in bpy.data.images if i.library}
    bpy.context.scene.splannequin.shot_path = str(other / "people.splannequin")
    bpy.ops.splannequin.load_camera()
    bpy.ops.splannequin.insert_freeze()
    image = bpy.context.scene.camera.data.background_images[0].image
    assert image.library is None and plate_file() == other / "people.splannequin" / "frames" / "000005.png"
    assert addon("bake.freeze_group").shown(bpy.context.scene)[0] == other / "people.splannequin" / "takes" / "freeze"
    tree = addon("compat").compositor_tree(bpy.context.scene)
    group = addon("bake.freeze_group").group_node(tree).node_tree
    assert not [n for n in group.nodes if n.bl_idname == "CompositorNodeImage" and n.image.library]
    addon("scene.sequences").relative_images()
    assert {i.name: i.filepath for i in bpy.data.images if i.library} == linked


@pytest.mark.skipif(not hasattr(bpy.app.handlers, "blend_import_post"), reason="since 4.3")
@pytest.mark.parametrize("is_saved", [True, False])
def test_an_appended_scene_keeps_its_shot(addon, project, tmp_path, is_saved):
    """The other folder has a shot of the same name, as a second project made by the command line has."""
    other, scene = Path(shutil.copytree(project, tmp_path / "other")), bpy.context.scene
    scene.name = "Layout"
    painted_on(project / "people.splannequin")
    blend(project)
    assert scene.splannequin.clip == "//people.mp4"
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    if is_saved:
        blend(other)
    with bpy.data.libraries.load(str(project / "work.blend"), link=False) as (_, here):
        here.scenes, here.images = ["Layout"], ["Motion"]
    scene = bpy.data.scenes["Layout"]
    assert scene.library is None
    assert addon("shot.selection").shot_folder(scene) == project / "people.splannequin"
    assert addon("scene.paths").absolute(scene.splannequin.clip) == str(project / "people.mp4")
    assert addon("solve.cameras").find(scene, project / "people.splannequin", "CAMERA") is not None
    assert addon("solve.mattes").find_image(project / "people.splannequin", 6) is not None
    blend(other)
    assert addon("shot.selection").shot_folder(scene) == project / "people.splannequin"
    assert scene.splannequin.clip == "//../project/people.mp4"


def test_bakes_of_a_shot_with_braces_in_its_name_follow_the_project(addon, project, tmp_path):
    shot = (project / "people.splannequin").rename(project / "{a} {{b}}.splannequin")
    scene = bpy.context.scene
    scene.splannequin.shot_path = str(shot)
    blend(project)
    addon("bake.rendering").choose_output(scene, shot, "freeze")

    def image() -> Path:
        return Path(os.path.normpath(bpy.path.abspath(bpy.context.scene.render.frame_path(frame=6))))

    assert image() == shot / "bake" / "freeze" / "000006.png"
    (tmp_path / "elsewhere").mkdir()
    blend(tmp_path / "elsewhere")
    assert image() == shot / "bake" / "freeze" / "000006.png"
    located = shot.rename(project / "{c}.splannequin")
    addon("shot.places").locate(bpy.context.scene, located)
    assert image() == located / "bake" / "freeze" / "000006.png"
