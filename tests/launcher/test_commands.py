"""The launcher's commands as a newcomer runs them: `python splannequin.py ...` in a separate process."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from launcher import commands, doctor, environments, interpreters, main
from launcher.summary import failed_job
from torch_backend.cards import Card
from torch_backend.contract import write_json

ROOT = Path(__file__).resolve().parents[2]
LAUNCHER = ROOT / "splannequin.py"


def launch(*arguments: str | Path, python: str = sys.executable, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [python, str(LAUNCHER), *map(str, arguments)], capture_output=True, text=True, env={**os.environ, **environ}
    )


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_doctor_before_set_up_gives_a_readable_error(tmp_path: Path):
    ran = launch("doctor", "--output", tmp_path, SPLANNEQUIN_HOME=str(tmp_path / "nothing here yet"))
    assert "not created yet: `python3 splannequin.py setup`" in ran.stdout
    found = summary(tmp_path)
    assert found["exit_code"] == ran.returncode
    assert found["findings"]["backend"]["state"] == "note"
    assert not (tmp_path / "nothing here yet").exists()


def test_a_name_that_the_console_has_no_letters_for_ends_nothing(tmp_path: Path):
    """Output redirected to a file on Windows uses a code page that lacks many characters."""
    home = tmp_path / "\N{CJK UNIFIED IDEOGRAPH-65E5}"
    ran = launch("doctor", "--output", tmp_path, SPLANNEQUIN_HOME=str(home), PYTHONIOENCODING="cp1252")
    assert "to create it in" in ran.stdout and "\\u65e5" in ran.stdout and "Traceback" not in ran.stderr


def test_missing_clip_is_refused_before_set_up(tmp_path: Path):
    """The summary holds no figure of an earlier run."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "summary.json").write_text('{"heldout_psnr_db": 99}')
    ran = launch(
        "freeze", tmp_path / "absent.mp4", "--output", tmp_path / "out", SPLANNEQUIN_HOME=str(tmp_path / "home")
    )
    assert ran.returncode == 2
    assert ran.stderr.startswith("Error: There is no clip at") and ran.stderr.count("\n") == 1
    assert summary(tmp_path / "out")["exit_code"] == 2 and "heldout_psnr_db" not in summary(tmp_path / "out")
    assert not (tmp_path / "home").exists()


def test_benchmark_of_existing_scenes_needs_no_blender():
    assert commands._brings_scenes(["--truth", "folder"]) and commands._brings_scenes(["--shot=x", "--seeds", "2"])
    assert not commands._brings_scenes(["--shot", "x", "--hard"])
    assert not commands._brings_scenes(["--quick"]) and not commands._brings_scenes(["--shot", "x", "--size=tiny"])


def test_bench_help_is_that_of_the_benchmark():
    if not environments.backend_environment().ready():
        pytest.skip("the backend's environment is not set up by the launcher")
    ran = launch("bench", "--help")
    assert ran.returncode == 0 and "--reference" in ran.stdout and "--jobs" in ran.stdout


@pytest.mark.parametrize("output", ["file", "file/out", "n" * 300, "made/" + "n" * 300])
def test_an_output_that_cannot_be_written_is_refused_before_any_work(tmp_path: Path, output: str):
    (tmp_path / "file").touch()
    home = tmp_path / "home"
    nothing = {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull, "PIP_FIND_LINKS": ""}
    ran = launch("setup", "--backend", "--output", tmp_path / output, SPLANNEQUIN_HOME=str(home), **nothing)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.startswith("Error: Cannot write to") and ran.stderr.count("\n") == 1
    assert not home.exists()


def on_a_disk(options: str, fill: str, folder: Path, *command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command with a small disk mounted at `folder`, after the shell command `fill` in this folder."""
    script = f'mount -t tmpfs -o size=64k none "$0" && cd "$0" && {{ {fill}; }} && mount -o remount,{options} "$0"'
    words = ["unshare", "--map-root-user", "--mount", "sh", "-c", f'{script} && cd / && exec "$@"', folder, *command]
    ran = subprocess.run(list(map(str, words)), capture_output=True, text=True)
    if "unshare:" in ran.stderr or "mount:" in ran.stderr:
        pytest.skip(f"no disk can be mounted here: {ran.stderr}")
    return ran


@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare")
@pytest.mark.parametrize(
    ("options", "fill", "code", "words"),
    [
        ("ro", "true", 2, "Read-only file system. Choose another --output folder."),
        ("rw", "head -c 100000 /dev/zero > fills 2>/dev/null || true", 8, "No space left on device"),
    ],
)
def test_a_disk_that_takes_nothing_is_one_sentence(tmp_path: Path, options: str, fill: str, code: int, words: str):
    (tmp_path / "disk").mkdir()
    output = tmp_path / "disk" / ("out" if code == 2 else "")  # on a full disk no folder can be created either
    command = ("env", f"SPLANNEQUIN_HOME={tmp_path}", sys.executable, "-P", LAUNCHER, "doctor", "--output", output)
    ran = on_a_disk(options, fill, tmp_path / "disk", *command)
    assert ran.returncode == code, ran.stderr
    assert ran.stderr.startswith("Error: Cannot write to") and ran.stderr.count("\n") == 1 and words in ran.stderr


@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare")
def test_a_home_on_a_disk_that_takes_nothing_is_one_sentence(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    command = ["env", f"SPLANNEQUIN_HOME={tmp_path / 'disk'}", sys.executable, "-P", LAUNCHER]
    ran = on_a_disk("ro", "true", tmp_path / "disk", *command, "setup", "--backend", "--output", tmp_path / "told")
    assert ran.returncode == 9
    assert "Read-only file system" in ran.stderr and "SPLANNEQUIN_HOME" in ran.stderr and ran.stderr.count("\n") == 1
    assert summary(tmp_path / "told")["exit_code"] == 9
    ran = on_a_disk("ro", "true", tmp_path / "disk", *command, "doctor", "--output", tmp_path / "told")
    assert ran.returncode == 9 and "cannot be written" in summary(tmp_path / "told")["findings"]["home"]["text"]


def test_a_folder_that_is_gone_is_one_sentence(tmp_path: Path):
    code = f"import os, sys; os.rmdir(os.getcwd()); sys.path.insert(0, {str(ROOT)!r}); from launcher import main"
    (tmp_path / "here").mkdir()
    command = [sys.executable, "-P", "-c", f"{code}; sys.exit(main.main(['doctor']))"]
    ran = subprocess.run(command, cwd=tmp_path / "here", capture_output=True, text=True)
    assert ran.returncode == 2 and "change to another" in ran.stderr and "Traceback" not in ran.stderr


def test_a_shot_that_is_frozen_anew_tells_of_the_take_that_was_named():
    shot = ROOT / "tests" / "data" / "shot"
    for words in ([], ["--t-star", "8", "--take=freeze"]):
        found = commands._of_a_shot(str(shot), words, 2.0)
        assert (found["shot"], found["take"], found["t_star_frame"]) == (str(shot), "freeze", 8)
        assert found["verdict"][0].startswith("Poor.") and found["wall_seconds_by_stage"] == {"freeze": 2.0}
        take = shot / "takes" / "freeze"
        assert (found["exr_dir"], found["video"]) == (str(take), str(take / "video.mp4")), "where it lies now"
        assert found["plate_share"] is None and found["run"] == "tiny", "a take of splats alone"
    with pytest.raises(OSError, match="other"):
        commands._of_a_shot(str(shot), ["--take", "other"], 2.0)


def test_shots_and_takes_have_separate_folders_by_default(tmp_path: Path):
    where = main._place_of
    for name in ("a", "b"):
        (tmp_path / name / "shot.splannequin").mkdir(parents=True)
    (tmp_path / "walk.splannequin").mkdir()
    assert where("in/a clip.mp4", []) == "a_clip"
    assert where(str(tmp_path / "a" / "shot.splannequin"), []) == "a_freeze"
    assert where(str(tmp_path / "b" / "shot.splannequin"), ["--t-star", "9", "--take", "at9"]) == "b_at9"
    assert where(str(tmp_path / "walk.splannequin"), ["--take=x"]) == "walk_x"


def test_same_named_clips_and_shots_have_stable_separate_folders(tmp_path: Path):
    clips = [tmp_path / "in" / name for name in ("a.mov", "a.mp4", "b/a.mp4", "a_.mp4", "a .mp4")]
    shots = [tmp_path / place / "walk.splannequin" for place in "ab"]
    for shot in shots:
        shot.mkdir(parents=True)

    def froze(source: Path) -> str:
        place = main._place_of(str(source), [], tmp_path / "output")
        output_folder = tmp_path / "output" / place
        (output_folder / "shot.splannequin").mkdir(parents=True, exist_ok=True)
        if source in clips:
            write_json(output_folder / "shot.splannequin" / "shot.json", {"version": 1, "source": str(source)})
        else:
            (output_folder / "shot.splannequin").rmdir()
        write_json(
            output_folder / "summary.json",
            {"shot": str(output_folder / "shot.splannequin" if source in clips else source)},
        )
        return place

    walk = tmp_path / "in" / "walk_freeze.mp4"
    clips.append(walk)
    first = {source: froze(source) for source in (*shots, *clips)}
    assert len(set(first.values())) == len(first) and first[shots[0]] == "walk_freeze" and first[clips[0]] == "a"
    assert {source: froze(source) for source in (*clips, *shots)} == first


def test_what_only_a_clip_wants_is_refused_of_a_shot(tmp_path: Path):
    if not environments.backend_environment().ready():
        pytest.skip("the backend's environment is not set up by the launcher")
    (tmp_path / "s.splannequin").mkdir()
    ran = launch("freeze", tmp_path / "s.splannequin", "--preset", "final", "--output", tmp_path / "out")
    assert ran.returncode == 2 and "--preset is for a clip" in ran.stderr and "Traceback" not in ran.stderr


def test_a_broken_status_of_a_job_breaks_nothing(tmp_path: Path):
    for number, text in enumerate(("[", "[]", '{"state": "failed"}')):
        job = tmp_path / "shot.splannequin" / "jobs" / str(number)
        job.mkdir(parents=True)
        (job / "status.json").write_text(text)
        assert failed_job(tmp_path) == ""
    (job / "status.json").write_text('{"state": "failed", "message": "It broke.", "hint": "Mend it."}')
    assert failed_job(tmp_path) == "It broke. Mend it."


def test_unknown_options_of_launcher_commands_are_refused(tmp_path: Path):
    assert launch("doctor", "--bogus", "--output", tmp_path).returncode == 2


OLD = ("splannequin.py", "launcher/__init__.py", "launcher/interpreters.py", "launcher/places.py")


@pytest.mark.parametrize("name", OLD)
def test_what_an_old_python_reads_parses_under_python_3_8(name: str):
    ast.parse((ROOT / name).read_text(encoding="utf-8"), feature_version=(3, 8))


def test_an_old_python_says_which_one_is_needed(tmp_path: Path):
    old = interpreters.find_python(
        lambda version: (3, 8) <= version < (3, 11), ("python3.8", "python3.9", "python3.10")
    )
    if old is None:
        pytest.skip("this machine has no Python from 3.8 to 3.10")
    hidden = str(tmp_path)
    ran = launch("doctor", python=old, PATH=hidden, PYENV_ROOT=hidden)
    assert ran.returncode == 9
    assert ran.stderr.startswith("Error: Splannequin needs Python 3.11 or newer") and ran.stderr.count("\n") == 1

    found = launch("doctor", "--output", tmp_path, python=old, PATH=str(Path(sys.executable).parent), PYENV_ROOT=hidden)
    assert found.returncode in (0, 9)
    assert "python" in summary(tmp_path)["findings"]


@pytest.mark.parametrize(
    ("driver", "compute", "state", "says"),
    [
        ("580.65.06", "9.0", "ok", "driver 580.65.06"),
        ("610.10", "7.5", "ok", "compute capability 7.5"),
        ("[N/A]", "8.9", "note", "cannot interpret"),
    ],
)
def test_gpus_are_checked_against_warp_requirements(driver: str, compute: str, state: str, says: str):
    finding = doctor.gpu_finding(Card("Some card", driver, compute))
    assert finding.state == state
    assert says in finding.text
