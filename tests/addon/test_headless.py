"""The add-on's command line, in this process: exit codes, output files, and a baked file that renders."""

import argparse
import importlib
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy.app.handlers import persistent


@pytest.mark.parametrize(
    "found",
    [
        '{"version": 1, "shot": "/another.splannequin", "registered": 3}',
        '{"version": 1, "take": "another", "registered": 3}',
        '{"version": 1, "wall_seconds_by_stage": 1}',
        '{"version": 1, "regis',
    ],
)
def test_a_summary_of_another_bake_or_a_damaged_one_is_written_anew(run, shot, tmp_path, found):
    """The output folder holds the summary of an earlier bake."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "summary.json").write_text(found)
    assert run("bake", "--shot", shot, "--output", out, "--first", "5", "--last", "5")[0] == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["shot"] == str(shot) and summary["take"] == "freeze" and "registered" not in summary
    assert set(summary["wall_seconds_by_stage"]) == {"bake"}


def test_bake_leaves_frames_a_file_and_a_summary(run, shot, tmp_path, pictures, layers, addon, scene):
    out = tmp_path / "out"
    out.mkdir()
    (out / "summary.json").write_text('{"version": 1, "registered": 3, "wall_seconds_by_stage": {"train": 2.0}}')
    code, said, _ = run("bake", "--shot", shot, "--take", "freeze", "--output", out)
    assert code == 0 and "View transform set from AgX to Standard" in said
    summary = json.loads((out / "summary.json").read_text())
    assert summary["composited_dir"] == str(out / "composited") and summary["composited_frames"] == 3
    assert summary["registered"] == 3 and set(summary["wall_seconds_by_stage"]) == {"train", "bake"}
    for frame in (5, 6, 7):
        found = pictures.read(out / "composited" / f"{frame:06d}.png")
        assert np.abs(found - pictures.srgb(layers(frame)["rgba"][..., :3])).max() * 255 < 0.6
    assert sorted(p.name for p in out.iterdir()) == ["composited", "shot.blend", "summary.json"]


def test_a_baked_file_renders_again_after_its_folder_moved(run, shot, tmp_path, pictures, layers, package, addon):
    out = shot.parent / "out"
    assert run("bake", "--shot", shot, "--output", out)[0] == 0
    moved = tmp_path.with_name(tmp_path.name + "-moved")
    tmp_path.rename(moved)
    for picture in (moved / "out" / "composited").iterdir():
        picture.unlink()
    package.unregister()  # a machine without the add-on
    try:
        bpy.ops.wm.open_mainfile(filepath=str(moved / "out" / "shot.blend"))
        bpy.ops.render.render(animation=True)
    finally:
        package.register()
    for frame in (5, 7):
        found = pictures.read(moved / "out" / "composited" / f"{frame:06d}.png")
        assert np.abs(found - pictures.srgb(layers(frame)["rgba"][..., :3])).max() * 255 < 0.6


def test_bake_into_an_artists_file_keeps_its_settings(run, shot, tmp_path, addon):
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.frame_start, scene.frame_end = 40, 30, 6, 7
    scene.render.image_settings.file_format = "TIFF"
    tree = addon("compat").new_compositor_tree(scene, "Mine")
    colour = tree.nodes.new("CompositorNodeRGB")
    tree.links.new(colour.outputs[0], addon("compat").output_socket(tree))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "artist.blend"))
    before = (tmp_path / "artist.blend").read_bytes()
    assert run("bake", "--shot", shot, "--output", tmp_path / "out", "--blend", tmp_path / "artist.blend")[0] == 0
    assert (tmp_path / "artist.blend").read_bytes() == before, "the artist's file is not written"
    assert sorted(p.name for p in (tmp_path / "out" / "composited").iterdir()) == ["000006.tif", "000007.tif"]
    scene = bpy.context.scene
    assert (scene.render.resolution_x, scene.render.resolution_y) == (40, 30)
    names = {n.bl_idname for n in addon("compat").compositor_tree(scene).nodes}
    assert {"CompositorNodeRGB", "CompositorNodeGroup"} <= names


@pytest.mark.parametrize("kind", ["script", "driver"])
def test_python_in_the_artists_file_does_not_run(run, shot, tmp_path, kind):
    """Python never runs, whatever the preferences: a file on a command line may come from a stranger."""
    ran = tmp_path / "ran"
    call = f"open({ran.as_posix()!r}, 'w').close()"
    if kind == "script":
        text = bpy.data.texts.new("on_load.py")
        text.write(call)
        text.use_module = True
    else:
        driven = bpy.data.objects.new("driven", None)
        bpy.context.scene.collection.objects.link(driven)
        driver = driven.driver_add("location", 0).driver
        driver.type = "SCRIPTED"
        bpy.context.preferences.filepaths.use_scripts_auto_execute = False
        driver.expression = f"{call} or 1.0"
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.resolution_x, scene.render.resolution_y = 6, 6, 16, 12
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "artist.blend"))
    ran.unlink(missing_ok=True)
    bpy.context.preferences.filepaths.use_scripts_auto_execute = True
    try:
        code, _, said = run("bake", "--shot", shot, "--output", tmp_path / "out", "--blend", tmp_path / "artist.blend")
    finally:
        bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    assert code == 0 and not ran.exists()
    assert "artist.blend contains Python" in said


def test_camera_points_and_plate_are_in_the_baked_file(run, shot, tmp_path):
    assert run("bake", "--shot", shot, "--output", tmp_path / "out")[0] == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out" / "shot.blend"))
    scene = bpy.context.scene
    assert scene.camera.animation_data and scene.camera.data.background_images[0].image
    assert {o.type for o in scene.objects} == {"EMPTY", "CAMERA", "MESH", "LIGHT"}
    assert (scene.frame_start, scene.frame_end) == (5, 7)
    assert scene.render.filepath.startswith("//")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ((), 2, "required"),
        (("bake",), 2, "--shot"),
        (("bake", "--shot", "nowhere", "--output", "out"), 2, "is not a shot folder"),
        (("status", "nowhere"), 2, "is not a shot folder"),
        (("solve", "nowhere"), 2, "is not a shot folder"),
        (("freeze", "no-such-clip.mp4", "--output", "out"), 3, "no-such-clip.mp4"),
        (("freeze", "clip.mp4", "--preset", "best"), 2, "invalid choice"),
    ],
)
def test_wrong_arguments_are_one_sentence_and_an_exit_code(run, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    found, _, said = run(*arguments)
    assert found == code and words in said
    assert "Traceback" not in said
    if code != 2:
        assert said.startswith("Error: ") and said.strip().count("\n") == 0


def test_a_bake_whose_freeze_fails_leaves_no_file(run, shot, tmp_path, stand_in):
    stand_in("exit 6")
    code, _, said = run("bake", "--shot", shot, "--take", "other", "--output", tmp_path / "out")
    assert code == 6 and said.startswith("Error: ")
    assert not (tmp_path / "out" / "shot.blend").exists()


def test_help_lists_commands_and_exit_codes(run):
    code, said, _ = run("--help")
    assert code == 0
    for word in ("import", "solve", "train", "freeze", "bake", "status", "doctor", "130 cancelled"):
        assert word in said


def test_import_and_status(run, clip, tmp_path: Path):
    shot = tmp_path / "s.splannequin"
    code, said, _ = run("import", shot, clip, "--first", 1, "--last", 8, "--json")
    events = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    assert code == 0 and events[-2]["type"] == "done" and events[-1]["result"] is not None
    code, said, _ = run("status", shot)
    assert code == 0 and "-import-" in said and "done" in said


def test_doctor_tells_both_sides(run, stand_in):
    stand_in("""echo '{"packages": {"torch": "2"}}'""")
    code, said, _ = run("doctor")
    facts = json.loads(said)
    assert code == 0 and facts["blender"] == bpy.app.version_string and facts["backend"]["packages"]["torch"] == "2"


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_ctrl_c_while_frames_render_ends_the_bake_with_130(run, shot, tmp_path, name):
    @persistent
    def press(*_) -> None:
        signal.raise_signal(getattr(signal, name))

    bpy.app.handlers.render_write.append(press)
    try:
        code, _, err = run("bake", "--shot", shot, "--output", tmp_path / "out")
    finally:
        bpy.app.handlers.render_write.remove(press)
    assert code == 130 and "Cancelled" in err
    assert [p.name for p in (tmp_path / "out" / "composited").iterdir()] == ["000005.png"]
    assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (5, 7)


@pytest.mark.skipif(bool(bpy.app.binary_path), reason="a Blender is no Python that runs a script")
@pytest.mark.parametrize(("starter", "code", "baked"), [("gone", 130, False), ("there", 0, True)])
def test_a_bake_ends_with_the_launcher_that_started_it(shot, tmp_path, root, starter, code, baked):
    script = root / "splannequin_addon" / "run_in_bpy.py"
    words = ["bake", "--shot", str(shot), "--take", "freeze", "--output", str(tmp_path / "out"), "--tied"]
    bake = subprocess.Popen([sys.executable, "-P", str(script), *words], stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert bake.stdin and bake.stderr
    if starter == "gone":
        bake.stdin.close()
    said = bake.stderr.read().decode()
    assert bake.wait(120) == code, said
    assert ("Cancelled" in said) == (not baked)
    assert (tmp_path / "out" / "shot.blend").is_file() == baked
    bake.stdin.close()
    bake.stderr.close()


def option_help(parser: argparse.ArgumentParser) -> dict[str, dict[str, tuple]]:
    """Map from verb to option to (help, choices, default, value, required), as printed by --help."""
    verbs = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices
    return {
        verb: {
            (a.option_strings or [a.dest])[0]: (
                a.help,
                a.choices and tuple(a.choices),
                a.default,
                a.metavar,
                a.required,
            )
            for a in one._actions
            if a.help != argparse.SUPPRESS
        }
        for verb, one in verbs.items()
    }


def test_both_command_lines_print_the_same_options_for_the_same_verb(addon, package):
    backend = importlib.import_module(f"{package.__name__}.torch_backend.cli")
    ours, theirs = option_help(addon("command_line.headless").parser()), option_help(backend.parser())
    assert ours.keys() - theirs.keys() == {"bake"}
    assert theirs.keys() - ours.keys() == {"take", "run-job", "live", "farm-task"}
    for verb in ours.keys() & theirs.keys():
        if "--device" in ours[verb]:  # without this option the add-on uses its preferences
            said, choices, default, *rest = ours[verb]["--device"]
            assert said.endswith("(default: from the add-on's preferences)") and default == ""
            ours[verb]["--device"] = (said.replace("from the add-on's preferences", "auto"), choices, "auto", *rest)
        if verb == "freeze":
            assert ours[verb].pop("--blend"), "a .blend is Blender's own"
        assert ours[verb] == theirs[verb], verb


def test_freeze_of_a_shot_runs_only_that_step(run, root, tmp_path):
    shot = tmp_path / "stored.splannequin"
    shutil.copytree(root / "tests" / "data" / "shot", shot)
    words = ("--run", "tiny", "--t-star", 8, "--take", "again", "--detail", "off", "--develop", "off",
             "--freeze-width", 32, "--first", 8, "--last", 8, "--device", "cpu")  # fmt: skip
    code, said, wrong = run("freeze", shot, *words)
    assert code == 0, wrong
    assert json.loads((shot / "takes" / "again" / "take.json").read_text())["t_star_frame"] == 8
    assert "Poor." in said and not list(tmp_path.rglob("shot.blend"))
    code, _, wrong = run("freeze", shot, "--output", tmp_path / "out")
    assert code == 2 and "--output is for a clip" in wrong and wrong.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_command_line_options_reach_the_backend(addon, contract, monkeypatch, tmp_path):
    headless = addon("command_line.headless")
    monkeypatch.setattr(addon("process.backend"), "device", lambda: "cpu")  # stands for a choice in the preferences

    def requested(*words):
        return headless.requested_params(headless.parser().parse_args([str(w) for w in words]))

    train = requested("train", tmp_path, "--method", "mlp", "--host", "mlp", "--host-config", "reference",
                  "--detector", "weight")["train"]  # fmt: skip
    assert (train.method, train.host, train.host_config, train.detector) == ("mlp", "mlp", "reference", "weight")
    assert train.device == "cpu" and requested("train", tmp_path, "--device", "cuda")["train"].device == "cuda"
    assert requested("train", tmp_path, "--extend", 10)["train"].extend == 10
    frozen = requested("freeze", "a.mp4", "--no-grain", "--camera-path", tmp_path / "p.json")["freeze"]
    assert (frozen.grain, frozen.camera_path, frozen.device) == (False, str(tmp_path / "p.json"), "cpu")
    assert frozen.only_missing, "frames that are finished are not rendered again"
    assert requested("import", tmp_path, "a.0001.png", "--fps", 25)["import"].fps == 25.0


def test_an_output_that_cannot_be_is_one_sentence(run, shot, clip, tmp_path):
    (tmp_path / "file").touch()
    for words in (("bake", "--shot", shot), ("freeze", clip)):
        code, _, said = run(*words, "--output", tmp_path / "file" / "out")
        assert code == 2 and said.startswith("Error: Cannot write to") and said.strip().count("\n") == 0
        assert "Choose another --output folder." in said
    for name in ("s" * 300, "file/s"):
        code, _, said = run("status", tmp_path / name)
        assert code in (2, 8) and said.startswith("Error: ") and said.strip().count("\n") == 0
