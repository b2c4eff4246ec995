"""Impossible requests are refused with one sentence before any work, with exit code 2, on the real command line."""

import dataclasses
import json
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from torch_backend import contract, job
from torch_backend.cli import main
from torch_backend.contract import ExitCode
from torch_backend.shot import Shot
from torch_backend.train import train_shot

HUGE = "9" * 25
LONG = "x" * 300


@pytest.fixture(scope="module")
def place(trained, tmp_path_factory):
    """Folder with a trained shot `s`, a plain file `file`, and broken camera paths."""
    folder = tmp_path_factory.mktemp("words")
    ignored = shutil.ignore_patterns("jobs", "takes")
    shutil.copytree(trained.shot.root, folder / "s", ignore=ignored)
    (folder / "file").write_text("no folder")
    (folder / "deep.json").write_text("[" * 200_000)
    (folder / "list.json").write_text("[]")
    (folder / "odd.json").write_text(json.dumps({"width": None, "height": 2, "frames": [[]]}))
    return folder


def said(capsys, place, *arguments):
    """(exit code, printed text) of a command; {} stands for the folder `place`."""
    try:
        code = main([a.replace("{}", str(place)) for a in arguments])
    except SystemExit as stop:  # raised by the parser
        code = stop.code
    printed = capsys.readouterr()
    return code, printed.out + printed.err


SMALL = ("--iterations", "20", "--max-gaussians", "200")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("train {}/s --iterations -1", "iterations) is -1: it should be 10 to"),
        ("train {}/s --iterations 9", "or 0 for the preset's"),
        ("train {}/s --width 5", "width of the training images is 5"),
        (f"train {{}}/s --width {HUGE}", "width"),
        ("train {}/s --max-gaussians 1", "budget of Gaussians is 1"),
        ("train {}/s --holdout 1", "held-out frames is 1"),
        ("train {}/s --holdout -2", "or 0 for none, or -1 for the preset's"),
        ("train {}/s --seed -1", "random seed is -1"),
        (f"train {{}}/s --seed {HUGE}", "random seed"),
        ("train {}/s --extend -3", "steps to add is -3"),
        ("train {}/s --run ../x", "run name"),
        (f"train {{}}/s --run {LONG}", "run name"),
        ("train {}/s --run a/b", "run name"),
        ("train {}/none", "none"),
        ("train {}/file", "file"),
        (f"train {{}}/{LONG}", "too long"),
        ("take {}/s --freeze-width -4", "width of the frozen frames is -4"),
        ("take {}/s --freeze-width 1000000000", "16 to 16384, or 0 for the source's"),
        ("take {}/s --overscan 500", "0 to 100 percent, or lens"),
        ("take {}/s --overscan nan", "0 to 100 percent, or lens"),
        ("take {}/s --overscan=-1", "0 to 100 percent, or lens"),
        ("take {}/s --overscan wide", "0 to 100 percent, or lens, got 'wide'"),
        ("take {}/s --take CON/../x", "take name"),
        ("take {}/s --camera-path {}/gone.json", "gone.json does not exist"),
        ("take {}/s --camera-path {}/deep.json", "deep.json is not valid JSON"),
        ("take {}/s --camera-path {}/list.json", "should hold a JSON object"),
        ("take {}/s --camera-path {}/odd.json", "odd.json is not a camera path"),
        ("take {}/s --camera-path {}", "is not a file"),
        (f"take {{}}/s --t-star {HUGE}", "t*"),
        ("import {}/s clip.mp4 --camera-model OPENCV", "unrecognized arguments: --camera-model"),
        ("import {}/file/x clip.mp4", "a file where a folder is needed"),
        ("import {}/file clip.mp4", "a file where a folder is needed"),
        (f"import {{}}/{LONG} clip.mp4", "too long"),
        ("import {}/s clip.mp4 --working-height 3", "height of the working frames is 3"),
        ("import {}/s clip.mp4 --step -1", "step between solved frames is -1"),
        ("freeze clip.mp4 --output {}/file", "a file where a folder is needed"),
        (f"freeze clip.mp4 --output {{}}/{LONG}", "too long"),
        ("freeze clip.mp4 --output {}/o --shot-name ../x", "shot name"),
        ("freeze clip.mp4 --output {}/o --freeze-width -4", "width of the frozen frames is -4"),
        ("freeze clip.mp4 --output {}/o --take a/b", "take name"),
        ("freeze clip.mp4 --output {}/o --camera-path {}/gone.json", "gone.json does not exist"),
        ("export {}/s --output {}/file", "a file where a folder is needed"),
        ("stmaps {}/file", "file"),
        ("status {}/none", "none"),
        pytest.param(
            "import /sys/kernel/x clip.mp4", "is protected",
            marks=pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="no folder that root cannot write to"),
        ),
    ],
)  # fmt: skip
def test_wrong_arguments_are_one_sentence(capsys, place, arguments, word):
    before = sorted(p for p in place.rglob("*") if "jobs" not in p.parts)
    code, text = said(capsys, place, *arguments.split(" "))
    assert code == ExitCode.USAGE, text
    assert word in text
    assert "Traceback" not in text and "a bug" not in text and "[Errno" not in text
    assert text.count("rror: ") == 1, "one sentence"
    assert sorted(p for p in place.rglob("*") if "jobs" not in p.parts) == before, "nothing was begun"


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        ("take {}/s --run nobody", ExitCode.FREEZE, "no trained run named 'nobody'"),
        ("take {}/s --t-star 5000", ExitCode.FREEZE, "t* is frame 5000, the shot has frames 101 to 116"),
        ("train {}/s --run nobody --extend 5", ExitCode.TRAIN, "no trained run 'nobody' to extend"),
    ],
)
def test_what_the_shot_lacks_is_one_sentence(capsys, place, arguments, code, word):
    got, text = said(capsys, place, *arguments.split(" "))
    assert (got, word in text, "Traceback" in text) == (code, True, False), text


@pytest.mark.parametrize(
    ("kind", "params", "word"),
    [
        ("train", {"seed": 1 << 70}, "seed"),
        ("train", {"iterations": -1}, "iterations"),
        ("freeze", {"t_star_per_frame": {"101": 1e12}}, r"t\* of a frame is 1000000000000"),
        ("freeze", {"t_star_per_frame": {"first": 3.0}}, "'first'"),
        ("freeze", {"overscan": 500.0}, "overscan in percent is 500.0: it should be 0 to 100, or -1 for what the lens"),
        ("freeze", {"first": 0, "last": 10**11}, "last frame"),
        ("solve", {"overlap": 0}, "following frames"),
    ],
)
def test_a_request_of_blender_gets_the_same_sentences(place, kind, params, word):
    folder = job.new_job(Shot.open(place / "s"), kind, {})
    request = json.loads((folder / contract.REQUEST_FILE).read_text())
    (folder / contract.REQUEST_FILE).write_text(json.dumps({**request, "params": params}))
    if kind == "solve":  # once as the process that Blender starts
        ran = [sys.executable, "-m", "torch_backend", "run-job", str(folder)]
        done = subprocess.run(ran, capture_output=True, text=True, check=False)
        assert done.stdout + done.stderr == ""
        code = done.returncode
    else:
        code, _ = job.run_job(folder)
    message = json.loads((folder / contract.STATUS_FILE).read_text())["message"]
    assert code == ExitCode.USAGE
    assert re.search(word, message), message


def test_limits_name_existing_fields_and_contain_defaults():
    for cls, limits in contract.LIMITS.items():
        assert set(limits) <= {f.name for f in dataclasses.fields(cls)}
        contract.check_params(cls())
    for field in ({"overscan": math.nan}, {"t_star_per_frame": {"101": math.nan}}):
        with pytest.raises(ValueError, match="is nan: it should be"):
            contract.check_params(contract.FreezeParams(**field))


def test_the_smallest_that_is_allowed_trains(world, quiet):
    params = contract.TrainParams(run="smallest", iterations=10, width=16, max_gaussians=100, seed=(1 << 53) - 1)
    contract.check_params(params)
    assert train_shot(world.shot, params, quiet())["width_px"] == 16
