"""The whole backend on a very small real clip, through its command line: files, figures, pixels, refusals."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.pictures import write
from torch_backend import cli
from torch_backend.contract import HOSTS, ExitCode, host_names, python_child
from torch_backend.footage.color import linear_to_srgb
from torch_backend.footage.display import ROLLED
from torch_backend.footage.images import read_png, resize, write_png
from torch_backend.freeze.exr import read_frozen_exr

CLIP = Path(__file__).parents[2] / "examples" / "sitting.mp4"
SMALL = ("--width", 160, "--iterations", 200, "--max-gaussians", 3000)
KEYS = {
    "frames", "registered", "gaussians", "moving_share", "train_seconds", "heldout_psnr_db", "wall_seconds_by_stage",
    "exr_dir", "contact_sheet", "t_star_frame", "verdict", "plate_share", "invented_share",
}  # fmt: skip


@pytest.fixture
def run(capsys):
    """run(word, ...): runs a command in this process; returns its exit code and what it prints."""

    def command(*arguments):
        code, printed = cli.main([*map(str, arguments)]), capsys.readouterr()
        return SimpleNamespace(returncode=code, stdout=printed.out, stderr=printed.err)

    return command


@pytest.fixture(scope="module")
def frozen(tmp_path_factory):
    output = tmp_path_factory.mktemp("out")
    words = ["--first", 1, "--last", 20, "--t-star", 10, "--working-height", 240, *SMALL]
    command = python_child(sys.executable, "torch_backend", *map(str, ["freeze", CLIP, "--output", output, *words]))
    environ = {**os.environ, "PYTHONPATH": str(CLIP.parents[1])}
    done = subprocess.run(**command, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return output, json.loads((output / "summary.json").read_text()), done.stdout


def test_summary_has_the_figures(frozen):
    _, summary, printed = frozen
    assert summary.keys() >= KEYS
    assert summary["frames"] == 20
    assert summary["registered"] >= 18
    assert abs(summary["t_star_frame"] - 10) <= 1
    assert summary["heldout_psnr_db"] > 19.0
    assert f"{summary['heldout_psnr_db']:.2f} dB" in printed
    assert 0.5 < summary["plate_share"] <= 1.0 and 0.0 <= summary["invented_share"] < 0.5
    assert any("of the picture is plate" in line for line in summary["verdict"])
    assert summary["verdict"] and all(f"\n{line}\n" in printed for line in summary["verdict"])
    assert set(summary["wall_seconds_by_stage"]) == {"import", "solve", "train", "freeze"}


def test_frozen_frames_look_like_their_plates(frozen):
    """Almost everything in this clip is static, so a frozen frame must show what its plate shows."""
    output, summary, _ = frozen
    scores = []
    for frame in (2, 7, 13, 19):
        image = read_frozen_exr(Path(summary["exr_dir"]) / f"{frame:06d}.exr")
        plate = read_png(output / "shot.splannequin" / "frames" / f"{frame:06d}.png")
        small = resize(plate, image.rgba.shape[1], image.rgba.shape[0]).astype(np.float64) / 255
        shown = np.clip(linear_to_srgb(image.rgba[..., :3]), 0, 1)
        scores.append(-10 * np.log10(np.mean((shown - small) ** 2)))
        assert image.rgba[..., 3].mean() > 0.95
        assert 0.0 <= image.motion.mean() < 0.5
    assert min(scores) > 17.0
    assert np.mean(scores) > 19.0


def test_the_same_command_again_only_looks(frozen, run):
    output, _, _ = frozen
    checkpoint = output / "shot.splannequin" / "runs" / "main" / "checkpoint.safetensors"
    before = checkpoint.stat().st_mtime_ns
    done = run("train", output / "shot.splannequin", *SMALL)
    assert done.returncode == 0
    assert "already trained" in done.stdout
    assert checkpoint.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (("freeze", "missing.mp4"), ExitCode.USAGE, "missing.mp4"),
        (("solve", "nowhere"), ExitCode.USAGE, "nowhere"),
    ],
)
def test_wrong_input_is_one_sentence(tmp_path, capsys, arguments, code, word):
    output = ("--output", str(tmp_path / "o")) if arguments[0] == "freeze" else ()
    assert cli.main([*arguments, *output]) in (code, ExitCode.FOOTAGE)
    text = "".join(capsys.readouterr())
    assert word in text
    assert "Traceback" not in text


def test_hosts_are_discovered_from_their_files(capsys):
    from torch_backend.deformation import hosts

    assert HOSTS == host_names() == tuple(hosts())
    with pytest.raises(SystemExit) as refused:
        cli.main(["train", "no.splannequin", "--method", "nerf"])
    assert refused.value.code == ExitCode.USAGE
    assert "control_points" in capsys.readouterr().err


@pytest.mark.parametrize(
    "line", ['HOST = HostSpec("fourth", Config)', 'HOST: HostSpec = HostSpec(\n    config=Config, name="fourth")']
)
def test_a_host_is_known_however_its_file_names_it(tmp_path, line):
    (tmp_path / "fourth.py").write_text(f"from .protocol import HostSpec\n\n{line}\n", encoding="utf-8")
    (tmp_path / "protocol.py").write_text("HOSTS = ('none',)\nHOST_WORDS = dict(name='none')\n", encoding="utf-8")
    assert host_names(tmp_path) == ("fourth",)


def test_export_writes_and_refuses_in_words(world, tmp_path, run):
    done = run("export", world.shot.root, "--format", "colmap", "--text", "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    written = [tmp_path / "out" / name for name in ("cameras.txt", "images.txt", "points3D.txt")]
    assert done.stdout.split() == [str(path) for path in written]
    assert "1 PINHOLE 64 48 60.0 60.0 32.0 24.0" in written[0].read_text()
    refused = run("export", world.shot.root, "--output", tmp_path / "out")
    assert refused.returncode == ExitCode.USAGE
    assert refused.stderr.startswith("Error: ") and "already contains another COLMAP model" in refused.stderr


def test_solve_refuses_missing_cameras(world, tmp_path, run):
    shot = tmp_path / "s.splannequin"
    shutil.copytree(world.shot.root, shot)
    listing = shot / "frames" / "frames.json"
    listing.write_text(json.dumps({**json.loads(listing.read_text()), "key": "imported"}))
    done = run("solve", shot, "--cameras", tmp_path / "gone")
    assert done.returncode == ExitCode.SOLVE and "gone does not exist" in done.stdout
    assert (shot / "solve" / "cameras.json").is_file()


def test_a_sequences_rate_and_layer_come_from_the_command_line(tmp_path, run):
    rng = np.random.default_rng(0)
    wide = np.repeat(np.repeat(rng.random((12, 40, 3)), 4, axis=0), 4, axis=1).astype(np.float32)
    for i in range(10):
        picture = np.concatenate([np.ones((48, 64, 3), np.float32), wide[:, 2 * i : 2 * i + 64]], axis=2)
        names = [f"{layer}.{c}" for layer in ("left", "right") for c in "RGB"]
        write(tmp_path / f"a.{i:03d}.exr", picture.astype(np.float16), names)
    shot = tmp_path / "a.splannequin"
    unsure = run("import", shot, tmp_path / "a.000.exr")
    assert unsure.returncode == ExitCode.FOOTAGE
    assert "none is recognised as the picture itself: left, right. Choose one by its name (--layer)" in unsure.stdout
    done = run("import", shot, tmp_path / "a.000.exr", "--layer", "right", "--fps", 12, "--step", 1)
    assert done.returncode == ExitCode.OK, done.stdout + done.stderr
    info = json.loads((shot / "shot.json").read_text())
    assert (info["fps"], info["last"]) == (12.0, 9)
    assert np.abs(read_png(shot / "frames/raw/000000.png") / 65535 - ROLLED.from_light(wide[:, :64])).max() < 2e-3


def test_a_failed_import_leaves_no_empty_shot(tmp_path, run):
    wrong = tmp_path / "text.mp4"
    wrong.write_text("no video")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    done = run("import", tmp_path / "s.splannequin", wrong)
    assert done.returncode == ExitCode.FOOTAGE and "text.mp4" in done.stdout
    done = run("import", tmp_path / "mine", wrong)
    assert done.returncode == ExitCode.USAGE and "contains other files (notes.txt)" in done.stderr
    assert run("freeze", wrong, "--output", tmp_path / "out").returncode == ExitCode.FOOTAGE
    assert not (tmp_path / "s.splannequin").exists() and not list((tmp_path / "out").iterdir())
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_a_shot_of_another_clip_is_not_used_again(tmp_path, capsys):
    """A copy of the shot's own clip is accepted."""
    shot, clips = tmp_path / "out" / "shot.splannequin", []
    for place in "ab":
        (tmp_path / place).mkdir()
        wide = resize(np.random.default_rng(ord(place)).integers(0, 256, (6, 12, 3), np.uint8), 96, 48)
        for n in range(12):
            write_png(tmp_path / place / f"p.{n:04d}.png", np.ascontiguousarray(wide[:, 2 * n : 2 * n + 64]))
        clips.append(str(tmp_path / place / "p.0000.png"))
    shutil.copytree(tmp_path / "a", tmp_path / "copy")
    assert cli.main(["import", str(shot), clips[0]]) == 0
    before = (shot / "frames" / "frames.json").read_bytes()
    assert cli.main(["freeze", clips[1], "--output", str(tmp_path / "out")]) == ExitCode.USAGE
    assert f"is the shot folder of another clip: {clips[0]}" in capsys.readouterr().err
    assert (shot / "frames" / "frames.json").read_bytes() == before
    words = ["--output", str(tmp_path / "out"), "--t-star", "99"]
    assert cli.main(["freeze", str(tmp_path / "copy" / "p.0000.png"), *words]) == ExitCode.USAGE
    assert "t* is frame 99" in capsys.readouterr().err, "it was taken for the same clip"


def test_a_shot_folder_that_cannot_be_is_one_sentence(tmp_path, capsys):
    (tmp_path / "file").touch()
    for where in ("file/s.splannequin", "s" * 300):
        assert cli.main(["import", str(tmp_path / where), str(CLIP)]) == ExitCode.USAGE
        said = capsys.readouterr().err
        assert said.startswith("Error: ") and str(tmp_path / where) in said and "Choose" in said
        assert said.count("\n") == 1
        assert cli.main(["train", str(tmp_path / where)]) != 0
        said = capsys.readouterr().err
        assert said.startswith("Error: ") and said.count("\n") == 1
