"""What version 0.2.0 left behind still works: its shot folders and the command lines people wrote for it."""

import argparse
import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from torch_backend import cli, contract
from torch_backend.cameras.stored import load_cameras, load_points, load_record
from torch_backend.footage.importing import load_frames
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.scene import load_scene
from torch_backend.shot import Shot
from torch_backend.train.loaded import load_run

OLD = Path(__file__).parents[1] / "data" / "v0_2"
LINES = json.loads((OLD / "command_lines.json").read_text(encoding="utf-8"))["backend"]
OPTIONS = json.loads((OLD / "options.json").read_text(encoding="utf-8"))["backend"]
PATHS = ("cameras", "camera_path")


@pytest.fixture
def shot(tmp_path: Path) -> Shot:
    root = tmp_path / "old.splannequin"
    shutil.copytree(OLD / "shot", root)
    return Shot.open(root)


def test_an_old_shot_is_read_to_the_end(shot: Shot):
    info = shot.info()
    assert (info.first, info.last, info.width, info.height, info.t_star) == (1, 74, 640, 480, 8)
    assert len(load_frames(shot)["frames"]) == 74
    assert len(load_cameras(shot).frames) == 74 and load_record(shot)["registered"] == 74
    assert len(load_points(shot)["xyz"]) == 370
    assert load_scene(shot).viewmats.shape == (74, 4, 4)
    run = load_run(shot, "tiny")
    assert len(run.model.gaussians) == 100 and (run.width, run.height) == (32, 24)
    take = contract.read_json(shot.take("freeze") / "take.json")
    assert take["run"] == "tiny" and contract.verdict_of(take).word == "poor"
    assert read_frozen_exr(shot.take("freeze") / "000008.exr").rgba.shape == (48, 64, 4)


def test_old_jobs_are_told_and_can_be_asked_for_again(shot: Shot, capsys):
    kinds = set()
    for folder in shot.jobs.iterdir():
        request = contract.from_dict(contract.JobRequest, contract.read_json(folder / contract.REQUEST_FILE))
        assert dataclasses.asdict(request.typed_params()) == {
            **dataclasses.asdict(contract.PARAMS[request.kind]()), **request.params,
        }  # fmt: skip
        kinds.add(request.kind)
    assert kinds == set(contract.STEP_PARAMS)
    assert cli.main(["status", str(shot.root)]) == 0
    assert capsys.readouterr().out.count("  done  ") == 4
    assert cli.main(["status", str(shot.root), "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["state"] for line in lines] == ["done"] * 4 and lines[0]["job"].count("-import-") == 1


@pytest.mark.parametrize(("verb", "told"), [("freeze", ""), ("take", "`freeze SHOT` now")])
def test_an_old_run_is_frozen_by_the_new_word_and_by_the_old_one(shot: Shot, capsys, verb: str, told: str):
    words = ["--run", "tiny", "--t-star", "8", "--detail", "off", "--develop", "off", "--freeze-width", "32"]
    assert cli.main([verb, str(shot.root), "--take", "again", *words]) == 0
    captured = capsys.readouterr()
    assert told in captured.err and bool(captured.err) == bool(told)
    facts = contract.read_json(shot.take("again") / "take.json")
    assert (facts["run"], facts["t_star_frame"]) == ("tiny", 8)
    assert read_frozen_exr(shot.take("again") / "000074.exr").rgba.shape == (24, 32, 4)


@pytest.mark.parametrize("line", LINES, ids=lambda line: " ".join(line["argv"]))
def test_an_old_command_line_asks_for_the_same(line):
    args = cli.parser().parse_args(line["argv"])
    found = contract.requested_params(args)
    assert found.keys() == line["asks"].keys()
    for kind, params in found.items():
        told = dataclasses.asdict(params)
        for name in PATHS:
            if told.get(name):
                assert Path(told[name]).is_absolute()
                told[name] = Path(told[name]).name
        assert told == {**dataclasses.asdict(contract.PARAMS[kind]()), **line["asks"][kind]}
    if not found:
        assert vars(args).items() >= line["parsed"].items()


@pytest.mark.parametrize("command", OPTIONS)
def test_an_old_option_is_still_taken_with_its_choices(command):
    commands = next(a for a in cli.parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    known = {tuple(a.option_strings) or a.dest: a for a in commands[command]._actions}
    for old in OPTIONS[command]:
        option = known[tuple(old["flags"]) or old["dest"]]
        assert (option.default, option.required) == (old["default"], old["required"]), old
        assert set(option.choices or ()) >= set(old["choices"] or ()), old
