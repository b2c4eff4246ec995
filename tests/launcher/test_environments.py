"""Set-up of an environment: once, resumed after an interruption, refused in a sentence."""

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from launcher import blender, environments
from launcher.environments import Environment, set_up
from launcher.errors import LauncherError


def value_of(environment: Environment) -> str:
    code = "import smallthing; print(smallthing.value)"
    return subprocess.run([environment.python, "-c", code], capture_output=True, text=True).stdout.strip()


def site_packages(environment: Environment) -> Path:
    return next(environment.folder.rglob("smallthing.py")).parent


def test_set_up_once_then_nothing_is_started(
    environment: Environment, monkeypatch: pytest.MonkeyPatch, hostile, tmp_path: Path
):
    trap = hostile(tmp_path / "clips", tmp_path / "home", tmp_path)  # modules where a child could stand
    assert not environment.ready()
    assert set_up(environment, sys.executable) > 0
    assert environment.ready()
    assert not trap.exists(), trap.read_text()
    assert value_of(environment) == "1"

    monkeypatch.setattr(subprocess, "Popen", None)  # any child process would now fail
    assert set_up(environment, "no such python") == 0


def test_changed_requirements_are_installed(environment: Environment, requirements: Path, write_wheel):
    set_up(environment, sys.executable)
    (requirements / "small.txt").write_text(f"{write_wheel('smallthing', '2.0', 'value = 2')}\n")
    assert not environment.ready()
    set_up(environment, sys.executable)
    assert value_of(environment) == "2"


def test_a_superset_of_the_requirements_is_ready_for_the_subset(environment: Environment, requirements, write_wheel):
    (requirements / "more.txt").write_text(f"{write_wheel('otherthing', '1.0', '')}\n")
    more = dataclasses.replace(environment, requirements=("small.txt", "more.txt"))
    set_up(environment, sys.executable)
    assert not more.ready()
    set_up(more, sys.executable)
    assert more.ready() and environment.ready()


def test_a_complete_list_is_installed_into_what_is_there_and_nothing_else(
    environment: Environment, requirements: Path, write_wheel
):
    set_up(environment, sys.executable)
    wheel = write_wheel("otherthing", "1.0", "", needs="there-is-no-such-package")
    (requirements / "more.txt").write_text(f"{wheel}\n")
    more = dataclasses.replace(environment, requirements=("more.txt",), probe="import smallthing, otherthing")
    with pytest.raises(LauncherError, match="no-such-package"):
        set_up(more, sys.executable)
    set_up(dataclasses.replace(more, complete=True), sys.executable)
    assert more.ready()


def test_an_interrupted_set_up_is_not_believed_and_is_completed(environment: Environment):
    set_up(environment, sys.executable)
    packages = site_packages(environment)
    # What a kill in the middle of pip leaves: the marker, a package whose files are not all there, no RECORD.
    environment.begun.touch()
    (packages / "smallthing-1.0.dist-info" / "RECORD").unlink()
    (packages / "smallthing.py").unlink()
    assert not environment.ready()
    set_up(environment, sys.executable)
    assert environment.ready()
    assert value_of(environment) == "1"


def test_an_environment_of_ours_without_an_interpreter_is_made_anew(environment: Environment):
    environment.state.mkdir(parents=True)
    (environment.folder / "pyvenv.cfg").touch()
    set_up(environment, sys.executable)
    assert value_of(environment) == "1"


def test_an_environment_made_by_hand_is_adopted(environment: Environment):
    subprocess.run([sys.executable, "-m", "venv", str(environment.folder)], check=True)
    kept = environment.folder / "kept"
    kept.touch()
    set_up(environment, sys.executable)
    assert environment.ready() and kept.exists()


def test_a_folder_of_someone_else_is_left_alone(environment: Environment):
    environment.folder.mkdir(parents=True)
    precious = environment.folder / "precious.txt"
    precious.touch()
    with pytest.raises(LauncherError, match="move it away") as refused:
        set_up(environment, sys.executable)
    assert precious.exists()
    assert refused.value.exit_code == 9


def test_a_package_that_cannot_be_had_names_step_log_and_remedy(environment: Environment, requirements: Path):
    (requirements / "small.txt").write_text("there-is-no-such-package==1.0\n")
    with pytest.raises(LauncherError) as refused:
        set_up(environment, sys.executable)
    message = str(refused.value)
    assert "installing packages" in message
    assert "there-is-no-such-package" in message
    assert "package index" in message
    assert str(environment.log) in message
    assert "there-is-no-such-package" in environment.log.read_text()
    assert not environment.ready()


def test_a_package_that_does_not_import_is_not_ready(environment: Environment, requirements: Path, write_wheel):
    (requirements / "small.txt").write_text(f"{write_wheel('smallthing', '3.0', 'import absent_library')}\n")
    with pytest.raises(LauncherError, match="absent_library"):
        set_up(environment, sys.executable)
    assert not environment.ready()


def test_a_full_disk_is_said_before_anything_is_written(environment: Environment):
    with pytest.raises(LauncherError, match="GB free") as refused:
        set_up(dataclasses.replace(environment, disk_gb=1e9), sys.executable)
    assert refused.value.exit_code == 8
    assert not environment.folder.exists()


@pytest.mark.parametrize(("index", "needed"), [("/whl/cpu", 4), ("/whl/cu130", 9)])
def test_the_disk_that_a_set_up_needs_is_that_of_the_torch_it_will_install(
    environment: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, index: str, needed: int
):
    backend = dataclasses.replace(environment, disk_gb=environments.BACKEND_DISK_GB, torch=True)
    monkeypatch.setenv("SPLANNEQUIN_TORCH_INDEX", f"file://{tmp_path}{index}")
    disk = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk._replace(free=int(needed * 1e9 - 1e8)))
    with pytest.raises(LauncherError, match=f"needs {needed} GB and .* has {needed - 0.1:.1f} GB free") as refused:
        set_up(backend, sys.executable)
    assert refused.value.exit_code == 8
    assert not backend.folder.exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk._replace(free=int(needed * 1e9 + 1e8)))
    set_up(backend, sys.executable)
    assert backend.ready()


@pytest.mark.parametrize(("system", "needed"), [("linux", 9.0), ("win32", 4.0), ("darwin", 4.0)])
def test_without_an_index_it_is_that_of_what_pypi_has(system: str, needed: float):
    assert environments.disk_gb(environments.backend_environment(), "", system) == needed


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="PyPI has CUDA for Linux alone")
def test_an_index_out_of_reach_is_not_reckoned_with(
    environment: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys
):
    """Then torch comes from the usual index, which on Linux has the one with CUDA."""
    backend = dataclasses.replace(environment, disk_gb=environments.BACKEND_DISK_GB, torch=True)
    monkeypatch.setenv("SPLANNEQUIN_TORCH_INDEX", "http://127.0.0.1:9/whl/cpu")
    disk = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk._replace(free=int(5e9)))
    with pytest.raises(LauncherError, match="needs 9 GB"):
        set_up(backend, sys.executable)
    assert "cannot be reached: torch comes from the usual index" in capsys.readouterr().out


def test_no_other_environment_has_torch():
    assert environments.backend_environment(testing=True).torch
    assert not any(e.torch for e in (environments.bpy_environment("5.0"), environments.bench_environment()))


def test_every_wheel_has_pinned_requirements():
    for series in blender.BPY_WHEELS:
        lines = (environments.REQUIREMENTS / f"bpy-{series}.txt").read_text().splitlines()
        assert [line for line in lines if line.startswith(f"bpy=={series}.")]
        assert [line for line in lines if line.startswith("numpy==")]


def test_every_requirement_is_pinned_exactly():
    for path in environments.REQUIREMENTS.glob("*.txt"):
        for line in path.read_text().splitlines():
            assert not line.strip() or line.startswith(("#", "-c ")) or line.count("==") == 1, f"{path.name}: {line}"


def test_an_index_that_does_not_answer_is_not_asked_for_every_package(tmp_path: Path):
    assert environments._reachable(tmp_path.as_uri())
    assert not environments._reachable("https://packages.invalid/whl/cpu")
    assert not environments._reachable("http://127.0.0.1:9/simple")


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pip that knows one index, at which nobody listens."""
    for name, value in {"NO_INDEX": "0", "CONFIG_FILE": os.devnull, "FIND_LINKS": "", "EXTRA_INDEX_URL": ""}.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)
    monkeypatch.setenv("PIP_RETRIES", "1")
    monkeypatch.setenv("PIP_INDEX_URL", "http://name:secret@127.0.0.1:9/simple")


def test_an_index_that_cannot_be_reached_is_what_is_wrong(
    environment: Environment, requirements: Path, offline, made, monkeypatch: pytest.MonkeyPatch
):
    made(environment.folder)
    (requirements / "small.txt").write_text("smallthing==1.0\n")
    with pytest.raises(LauncherError) as refused:
        set_up(environment, sys.executable)
    message = str(refused.value)
    assert "127.0.0.1 cannot be reached" in message and "HTTPS_PROXY" in message and "start the same command" in message
    assert "Python 3" not in message and "secret" not in message
    assert refused.value.exit_code == 9

    monkeypatch.setenv("PIP_INDEX_URL", "https://packages.invalid/simple")
    monkeypatch.setenv("HTTPS_PROXY", "http://127.0.0.1:9")
    with pytest.raises(LauncherError, match="the proxy on the way to packages.invalid cannot be used"):
        set_up(environment, sys.executable)


@pytest.mark.parametrize("home", ["file", "file/below", "n" * 300])
def test_a_home_that_cannot_be_is_one_sentence(environment: Environment, tmp_path: Path, home: str):
    (tmp_path / "file").touch()
    placed = dataclasses.replace(environment, folder=tmp_path / home / ".venv")
    with pytest.raises(LauncherError) as refused:
        set_up(placed, sys.executable)
    message = str(refused.value)
    assert "cannot be set up in" in message and "SPLANNEQUIN_HOME" in message and "Log:" not in message
    assert refused.value.exit_code == 9
