"""What version 0.2.0 left behind still works: its .blend files, shot folders and command lines."""

import argparse
import dataclasses
import json
import shutil
from pathlib import Path

import bpy
import pytest

OLD = Path(__file__).resolve().parents[1] / "data" / "v0_2"
OPTIONS = json.loads((OLD / "options.json").read_text(encoding="utf-8"))["blender"]
PANEL = json.loads((OLD / "panel.json").read_text(encoding="utf-8"))
LINES = json.loads((OLD / "command_lines.json").read_text(encoding="utf-8"))["blender"]


@pytest.fixture
def saved(package, tmp_path):
    path = tmp_path / "panel.blend"
    shutil.copy(OLD / "panel.blend", path)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.context.scene.splannequin


def test_a_saved_panel_keeps_what_was_set(saved):
    for name, value in PANEL["saved"]["scene"].items():
        found = getattr(saved, name)
        assert getattr(found, "name", found) == value, name
    assert len(saved.shots) == 1
    for name, value in PANEL["saved"]["other"].items():
        assert getattr(saved.shots[0], name) == value, name


def test_a_saved_key_of_t_star_is_found(saved, addon):
    curves = addon("compat").fcurves(bpy.context.scene)
    assert [(c.data_path, c.evaluate(3)) for c in curves] == [("splannequin.t_star", 8.0)]


def test_names_defaults_and_choices_of_saved_properties_are_what_they_were(scene, contract):
    known = scene.splannequin.bl_rna.properties
    follows = {"extend_steps": round(contract.PRESET_STEPS["preview"] / 3)}  # what a preset is, is the release's
    for name, old in PANEL["properties"].items():
        assert (known[name].type, known[name].name) == (old["type"], old["name"]), name
        items = [i.identifier for i in getattr(known[name], "enum_items", ())]
        assert items[: len(old["items"])] == old["items"], f"{name}: saved as a place in the list, new ones go last"
        if old["default"] is not None:
            assert known[name].default == follows.get(name, old["default"]), name


def test_an_old_shot_is_shown_whole(addon, tmp_path):
    root = tmp_path / "old.splannequin"
    shutil.copytree(OLD / "shot", root)
    state = addon("shot.inventory").read(root)
    assert (state.frames, state.frame_range, state.size) == (74, (1, 74), (640, 480))
    assert state.runs["tiny"]["gaussians"] == 100 and state.takes["freeze"]["frame_count"] == 2
    assert not state.damaged["run"] and not state.damaged["take"] and not state.unfinished
    assert not state.runs["tiny"]["other_cameras"]
    assert {kind: job.state for kind, job in addon("process.jobs").latest(root).items()} == dict.fromkeys(
        ("import", "solve", "train", "freeze"), "done"
    )
    assert addon("freeze.takes").take_params(root, "freeze").width == 64
    assert addon("freeze.takes").complete(root, "freeze") and not addon("freeze.takes").may_be_stale(root, "freeze")


@pytest.mark.parametrize(
    ("kind", "told", "step"),
    [
        ("import", "footage", "import"),
        ("solve", "camera", "solve"),
        ("train", "train", "train"),
        ("freeze", "bake", "bake"),
        ("freeze", "freeze", "freeze"),
        ("freeze", "", "freeze"),
    ],
)
def test_a_job_of_an_old_shot_belongs_to_its_step(addon, contract, tmp_path, kind, told, step):
    """What 0.2.0 wrote into job folders: its names of the steps."""
    shot = tmp_path / "a.splannequin"
    addon("shot.inventory").create(shot)
    params = contract.ImportParams("a.mp4") if kind == "import" else contract.PARAMS[kind]()
    job = addon("process.jobs").new_job(shot, kind, params)
    (job.folder / contract.STEP_FILE).write_text(told)
    assert addon("process.steps").step_of(job) == step
    assert set(addon("process.job_timer").watch_of(shot).jobs) == {step}


def test_buttons_take_the_old_names_of_steps(addon, contract, scene, tmp_path):
    shot = tmp_path / "a.splannequin"
    addon("shot.inventory").create(shot)
    job = addon("process.jobs").new_job(shot, "solve", contract.SolveParams())
    scene.splannequin.shot_path = str(shot)
    assert addon("process.job_timer").watch_of(shot).running() == "solve"
    assert bpy.ops.splannequin.cancel(step="camera") == {"FINISHED"}
    assert (job.folder / contract.CANCEL_FILE).exists()


def test_old_command_lines_ask_for_the_same(addon, contract):
    headless = addon("command_line.headless")
    for line in LINES:
        args = headless.parser().parse_args(line["argv"])
        found = headless.asked(args)
        assert found.keys() == line["asks"].keys(), line["argv"]
        for kind, params in found.items():
            told = dataclasses.asdict(params)
            for name in ("cameras", "camera_path"):
                if told.get(name):
                    assert Path(told[name]).is_absolute()
                    told[name] = Path(told[name]).name
            expected = {**dataclasses.asdict(contract.PARAMS[kind]()), **line["asks"][kind]}
            assert told == expected, line["argv"]
        if not found:
            assert vars(args).items() >= line["parsed"].items(), line["argv"]


@pytest.mark.parametrize("command", OPTIONS)
def test_an_old_option_is_still_taken_with_its_choices(addon, command):
    commands = next(
        a for a in addon("command_line.headless").parser()._actions if isinstance(a, argparse._SubParsersAction)
    ).choices
    known = {tuple(a.option_strings) or a.dest: a for a in commands[command]._actions}
    for old in OPTIONS[command]:
        option = known[tuple(old["flags"]) or old["dest"]]
        assert (option.default, option.required) == (old["default"], old["required"]), old
        assert set(option.choices or ()) >= set(old["choices"] or ()), old
