"""Tasks of a farm job on another folder layout with path mapping, and their failure messages."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from torch_backend import cli
from torch_backend.contract import ExitCode, JobError, ShotFolder, write_json
from torch_backend.contract.pace import FIRST_FRAMES, PER_WORKING
from torch_backend.freeze.exr import read_frozen_exr

ROOT = Path(__file__).resolve().parents[2]
PLAIN = ("--develop", "off", "--detail", "off", "--no-grain")


@pytest.fixture(scope="module")
def submitted(trained, tmp_path_factory):
    """Folder with the trained shot on the submitting computer, and the exported job."""
    home = tmp_path_factory.mktemp("artist")
    shutil.copytree(trained.shot.root, home / "shots" / "tiny.splannequin")
    words = ["--output", str(home / "job"), "--t-star", "104,110", "--frames", "16", *PLAIN]
    assert cli.main(["farm", "export", str(home / "shots" / "tiny.splannequin"), *words]) == 0
    return home


def test_a_template_of_one_layout_runs_on_another(submitted, tmp_path):
    pytest.importorskip("openjd.cli")
    farm_folder = tmp_path / "farm"
    shutil.copytree(submitted / "shots", farm_folder / "shots")
    rules = [
        {
            "source_path_format": "POSIX",
            "source_path": str(submitted / "shots"),
            "destination_path": str(farm_folder / "shots"),
        },
        {"source_path_format": "POSIX", "source_path": "/software", "destination_path": str(ROOT)},
    ]
    (farm_folder / "rules.json").write_text(json.dumps({"version": "pathmapping-1.0", "path_mapping_rules": rules}))
    values = json.loads((submitted / "job" / "parameters.json").read_text())
    values |= {"Splannequin": "/software", "HostPython": sys.executable, "BackendPython": sys.executable}
    template = str(submitted / "job" / "template.json")
    command = [sys.executable, "-P", "-m", "openjd", "run", template, "-p", json.dumps(values)]
    command += ["--path-mapping-rules", f"file://{farm_folder / 'rules.json'}", "--no-run-dependencies"]
    before = sorted(p.relative_to(submitted) for p in submitted.rglob("*"))
    said = ""
    for step, first in (("open", None), ("freeze", 101), ("finish", None)):
        task = [f"Shot={submitted / 'shots' / 'tiny.splannequin'}", "TStar=110", *([f"First={first}"] if first else [])]
        words = [word for one in task for word in ("-tp", one)]
        done = subprocess.run([*command, "--step", f"tiny: {step}", *words], capture_output=True, text=True)
        said += done.stdout
        assert done.returncode == 0, done.stdout + done.stderr
    take = ShotFolder(farm_folder / "shots" / "tiny.splannequin").take("freeze_0110")
    assert [int(p.stem) for p in sorted(take.glob("*.exr"))] == list(range(101, 117))
    assert read_frozen_exr(take / "000109.exr").metadata.t_star_frame == 110
    assert json.loads((take / "take.json").read_text())["exr_dir"] == str(take)
    assert sorted(p.relative_to(submitted) for p in submitted.rglob("*")) == before, "nothing where it was submitted"
    assert "openjd_progress: 100.0" in said and "tiny, freeze freeze_0110: freezing" in said
    took = json.loads((farm_folder / "shots" / "tiny.splannequin" / "farm" / "freeze-110-101.json").read_text())
    amount = (16 + (16 + FIRST_FRAMES) * PER_WORKING) * 64 * 48 / 1e6
    assert took["amount"] == pytest.approx(amount, abs=1e-3) and took["cpu_seconds"] > 0


def test_a_task_that_only_hands_on_to_blender_loads_no_torch():
    """Loading torch takes longer than baking a part."""
    seen = "import sys, torch_backend.farm_task; sys.exit(int('torch' in sys.modules))"
    assert (
        subprocess.run([sys.executable, "-P", "-c", seen], env={**os.environ, "PYTHONPATH": str(ROOT)}).returncode == 0
    )


def test_what_a_task_says_and_its_exit_status_reach_the_engine(tmp_path):
    """The process exits immediately, without Python's shutdown."""
    words = ["farm-task", "solve", "--shot", str(tmp_path / "s"), "--request", str(tmp_path / "none.json")]
    command = [sys.executable, "-P", "-m", "torch_backend", *words]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == ExitCode.USAGE
    assert done.stdout.startswith("openjd_fail: s, solve: ") and done.stdout.endswith(".\n")


@pytest.fixture
def imported_shots(tmp_path):
    """Two shots called `shot` with the records of an import."""
    roots = [tmp_path / place / "shot.splannequin" for place in "ab"]
    for root in roots:
        shot = ShotFolder(root)
        write_json(shot.info_path, {"version": 1, "name": "shot"})
        frames = [{"frame": n, "file": f"raw/{n:06d}.png"} for n in range(1, 9)]
        write_json(shot.listing, {"frames": frames, "width": 64, "height": 48})
    return roots


@pytest.fixture
def task(submitted, tmp_path, capsys):
    """task(step, *words): runs a task of the job in this process; returns (exit code, lines for the engine)."""
    template = json.loads((submitted / "job" / "template.json").read_text())

    def run(step, *words):
        found = next((one for one in template["steps"] if one["name"] == f"tiny: {step}"), None)
        (tmp_path / "request.json").write_text(found["script"]["embeddedFiles"][0]["data"])
        shot = str(submitted / "shots" / "tiny.splannequin")
        code = cli.main(["farm-task", step, "--shot", shot, "--request", str(tmp_path / "request.json"), *words])
        return code, [line for line in capsys.readouterr().out.splitlines() if line.startswith("openjd_")]

    return run


def test_a_task_that_fails_says_of_which_shot_and_take_and_what_to_do(task):
    code, said = task("freeze", "--t-star=104", "--first=101", "--frames", "16")
    assert code == ExitCode.FREEZE
    assert said == [
        "openjd_fail: tiny, freeze freeze_0104: Take freeze_0104 of tiny.splannequin was not opened. Run its step "
        "`open` first."
    ]


def test_a_request_that_is_none_is_said(submitted, tmp_path, capsys):
    shot = str(submitted / "shots" / "tiny.splannequin")
    (tmp_path / "none.json").write_text("[]")
    assert cli.main(["farm-task", "open", "--shot", shot, "--request", str(tmp_path / "none.json")]) == ExitCode.USAGE
    assert "openjd_fail: tiny.splannequin, open: " in capsys.readouterr().out


def test_a_file_that_cannot_grow_is_said_without_a_traceback(submitted, tmp_path):
    """Linux only: a limit on file sizes acts like a full disk."""
    resource = pytest.importorskip("resource")
    request = {"version": 1, "name": "tiny", "amounts": {}, "takes": {"104": "a"}, "first": 101, "last": 102}
    (tmp_path / "request.json").write_text(json.dumps({**request, "freeze": {"develop": "off", "detail": "off"}}))
    shot = shutil.copytree(submitted / "shots" / "tiny.splannequin", tmp_path / "tiny.splannequin")
    words = ["farm-task", "open", "--shot", str(shot), "--request", str(tmp_path / "request.json"), "--t-star=104"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "torch_backend", *words], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10)),
    )  # fmt: skip
    assert done.returncode == ExitCode.DISK, done.stdout + done.stderr
    assert "openjd_fail: tiny, open a: " in done.stdout and "Traceback" not in done.stderr


def test_missing_blender_gives_a_readable_error(task, monkeypatch, submitted, tmp_path, capsys):
    from torch_backend.farm_task import BLENDER_VARIABLE

    monkeypatch.delenv(BLENDER_VARIABLE, raising=False)
    request = {"version": 1, "name": "tiny", "amounts": {}, "takes": {"104": "a"}, "freeze": {}, "first": 1, "last": 2}
    (tmp_path / "request.json").write_text(json.dumps(request))
    shot = str(submitted / "shots" / "tiny.splannequin")
    words = ["--shot", shot, "--request", str(tmp_path / "request.json"), "--t-star=104", "--output", str(tmp_path)]
    assert cli.main(["farm-task", "bake", *words]) == ExitCode.ENVIRONMENT
    assert "openjd_fail: tiny, bake a: No Blender is set up on this host." in capsys.readouterr().out


def test_two_shots_of_one_name_are_baked_into_two_folders(imported_shots, tmp_path, monkeypatch, capsys):
    from torch_backend.farm_task import BLENDER_VARIABLE

    program = "import json, sys; print('Told:', json.dumps(sys.argv[2:]))"
    monkeypatch.setenv(BLENDER_VARIABLE, json.dumps([sys.executable, "-c", program]))
    roots = [str(root) for root in imported_shots]
    assert cli.main(["farm", "export", *roots, "--bake", "--output", str(tmp_path / "job"), "--t-star", "4"]) == 0
    capsys.readouterr()
    places = set()
    for step in json.loads((tmp_path / "job" / "template.json").read_text())["steps"]:
        if step["name"].endswith(": deliver"):
            (tmp_path / "request.json").write_text(step["script"]["embeddedFiles"][0]["data"])
            shot = step["parameterSpace"]["taskParameterDefinitions"][0]["range"][0]
            words = ["--shot", shot, "--request", str(tmp_path / "request.json"), "--t-star=4"]
            assert cli.main(["farm-task", "deliver", *words, "--output", str(tmp_path / "baked")]) == 0
            (line,) = [row for row in capsys.readouterr().out.splitlines() if row.startswith("Told: ")]
            said = json.loads(line.removeprefix("Told: "))
            assert said[said.index("--shot") + 1] == shot
            places.add(said[said.index("--output") + 1])
    assert len(places) == 2 and all(Path(place).parents[1] == tmp_path / "baked" for place in places)


def test_paths_among_the_parameters_are_those_of_this_computer():
    from torch_backend.farm_task import params_of

    args = cli.parser().parse_args(
        ["farm-task", "solve", "--shot", "s", "--request", "r", "--paths", "solve.people_mask=/mnt/a.png", "train.x=1"]
    )
    params = params_of(args, {"solve": {"focal_mm": 35.0}}, "solve")
    assert (params.focal_mm, params.people_mask) == (35.0, "/mnt/a.png")
    with pytest.raises((ValueError, JobError), match="focal length"):
        params_of(args, {"solve": {"focal_mm": 1e9}}, "solve")
