"""Set-up of an environment: done once, resumed after an interruption, refused with a message."""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from launcher import blender, environments, main
from launcher.environments import Environment, set_up
from launcher.errors import LauncherError


def value_of(environment: Environment) -> str:
    code = "import smallthing; print(smallthing.value)"
    return subprocess.run([environment.python, "-c", code], capture_output=True, text=True).stdout.strip()


def site_packages(environment: Environment) -> Path:
    return next(environment.folder.rglob("smallthing.py")).parent


def test_set_up_once_then_nothing_is_started(
    bare_environment: Environment, monkeypatch: pytest.MonkeyPatch, hostile, tmp_path: Path
):
    # modules in folders where a child process could run
    trap = hostile(tmp_path / "clips", tmp_path / "home", tmp_path)
    # A venv without an interpreter is created again.
    bare_environment.state.mkdir(parents=True)
    (bare_environment.folder / "pyvenv.cfg").touch()
    assert not bare_environment.ready()
    assert set_up(bare_environment, sys.executable) > 0
    assert bare_environment.ready()
    assert not trap.exists(), trap.read_text()
    assert value_of(bare_environment) == "1"

    monkeypatch.setattr(subprocess, "Popen", None)  # any child process would now fail
    assert set_up(bare_environment, "no such python") == 0


def test_changed_requirements_are_installed(installed: Environment, write_lock, write_wheel):
    write_lock("small", write_wheel("smallthing", "2.0", "value = 2"))
    assert not installed.ready()
    set_up(installed, sys.executable)
    assert value_of(installed) == "2"


def test_a_superset_of_the_requirements_is_ready_for_the_subset(installed: Environment, write_lock, write_wheel):
    write_lock("more", write_wheel("otherthing", "1.0", ""))
    more = dataclasses.replace(installed, requirements=("small", "more"))
    assert not more.ready()
    set_up(more, sys.executable)
    assert more.ready() and installed.ready()


def test_nothing_is_installed_that_the_lock_does_not_name(installed: Environment, write_lock, write_wheel):
    write_wheel("hanger_on", "1.0", "")
    write_lock("more", write_wheel("otherthing", "1.0", "", needs="hanger-on"))
    more = dataclasses.replace(installed, requirements=("more",), probe="import smallthing, otherthing")
    set_up(more, sys.executable)
    assert more.ready() and not list(site_packages(installed).glob("hanger_on*"))


def test_a_file_with_another_hash_is_not_installed(environment: Environment, write_wheel, tmp_path: Path):
    """The package index, or a folder of wheels, has another file under the same name and version."""
    write_wheel("smallthing", "1.0", "value = 'of somebody else'")
    for wheels in (None, tmp_path):
        with pytest.raises(LauncherError, match="smallthing .*SHA-256 differs") as refused:
            set_up(environment, sys.executable, wheels)
        assert refused.value.exit_code == 9 and not environment.ready()
    assert not list(environment.folder.rglob("smallthing*"))


def test_a_requirement_without_a_hash_is_not_installed(environment: Environment, requirements: Path):
    (requirements / "small.lock").write_text("smallthing==1.0\n")
    with pytest.raises(LauncherError, match="installing packages"):
        set_up(environment, sys.executable)
    assert not list(environment.folder.rglob("smallthing*"))


def test_wheel_folder_uses_no_index(
    environment: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, write_lock, write_wheel
):
    monkeypatch.delenv("PIP_NO_INDEX")
    monkeypatch.delenv("PIP_FIND_LINKS")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")  # nobody listens there
    (tmp_path / "whéels 1").mkdir()
    for wheel in tmp_path.glob("*.whl"):
        wheel.rename(tmp_path / "whéels 1" / wheel.name)
    set_up(environment, sys.executable, tmp_path / "whéels 1")
    assert value_of(environment) == "1" and environment.ready()

    write_lock("small", write_wheel("smallthing", "2.0", "value = 2"))
    with pytest.raises(LauncherError, match="has no wheel of smallthing==2.0") as refused:
        set_up(environment, sys.executable, tmp_path / "whéels 1")
    assert refused.value.exit_code == 9
    assert main.main(["setup", "--wheels", str(tmp_path / "absent"), "--output", str(tmp_path / "o")]) == 2


def test_only_torch_uses_the_torch_index(
    with_torch: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, write_lock, write_wheel
):
    """No other package is installed from that index, whatever its version."""
    index = tmp_path / "whl" / "cpu"
    theirs = write_wheel("torch", "2.13.0+cpu", "build = 'cpu'")
    write_lock("torch-cpu", theirs)
    for wheel in (theirs, write_wheel("smallthing", "9.0", "value = 9")):
        folder = index / wheel.name.split("-")[0]
        folder.mkdir(parents=True)
        wheel.rename(folder / wheel.name)
        (folder / "index.html").write_text(f'<a href="{wheel.name}">{wheel.name}</a>')
    monkeypatch.setattr(environments, "CPU_INDEX", index.as_uri())
    monkeypatch.setattr(environments, "torch_lock", lambda index, python: "torch-cpu.lock")
    monkeypatch.setenv("SPLANNEQUIN_TORCH_INDEX", index.as_uri())
    monkeypatch.setenv("PIP_NO_INDEX", "0")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_RETRIES", "0")
    set_up(with_torch, sys.executable)
    assert with_torch.ready() and value_of(with_torch) == "1"
    assert (site_packages(with_torch) / "torch.py").read_text() == "build = 'cpu'"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere PyPI's build is the one without CUDA")
def test_the_build_of_an_index_out_of_reach_is_taken_where_pip_finds_it(
    with_torch: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, write_lock, write_wheel
):
    """pip is configured with a folder that has the build, as here and in CI. A file with another hash is refused."""
    monkeypatch.delenv("SPLANNEQUIN_TORCH_INDEX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))  # no NVIDIA driver
    monkeypatch.setattr(environments, "_reachable", lambda _: False)
    wheel = write_wheel("torch", "2.13.0+cpu", "build = 'cpu'")
    write_lock("torch-cpu", wheel)
    set_up(with_torch, sys.executable)
    assert (site_packages(with_torch) / "torch.py").read_text() == "build = 'cpu'"

    shutil.rmtree(next(site_packages(with_torch).glob("torch-*")))
    write_wheel("torch", "2.13.0+cpu", "build = 'of somebody else'")
    with pytest.raises(LauncherError, match=r"torch.* SHA-256 differs"):
        set_up(with_torch, sys.executable)


def test_cuda_libraries_come_only_with_a_torch_that_asks_for_them(with_torch: Environment, write_lock, write_wheel):
    set_up(with_torch, sys.executable)
    packages = site_packages(with_torch)
    assert not list(packages.glob("nvidia_small*"))
    write_lock("torch", write_wheel("torch", "2.14.0", "", needs='nvidia-small==1.0; platform_system == "Linux"'))
    set_up(with_torch, sys.executable)
    assert list(packages.glob("nvidia_small*"))


def damage(packages: Path, how: str) -> None:
    info = packages / "smallthing-1.0.dist-info"
    if how == "removed":
        shutil.rmtree(info)
        (packages / "smallthing.py").unlink()
    elif how == "file removed":
        (packages / "smallthing.py").unlink()
    elif how == "exchanged":
        info.rename(packages / "smallthing-0.9.dist-info")
        (packages / "smallthing.py").write_text("value = 9\n")
    elif how == "cut off":
        (packages / "smallthing.py").write_text("")
    elif how == "record forged":
        (packages / "smallthing.py").write_text("value = 7")
        record = (info / "RECORD").read_text().splitlines(keepends=True)
        (info / "RECORD").write_text("".join(line for line in record if not line.startswith("smallthing.py")))


def test_a_package_that_was_changed_is_noticed_and_repaired(installed: Environment, capsys):
    module = site_packages(installed) / "smallthing.py"
    whole = module.read_bytes()
    for how in ("file removed", "cut off", "removed", "exchanged", "record forged"):
        damage(site_packages(installed), how)
        assert installed.changed() == ["smallthing"] and not installed.ready(), how
        if how in ("file removed", "cut off"):  # the others are harder to repair
            module.write_bytes(whole)
            continue
        capsys.readouterr()
        set_up(installed, sys.executable)
        assert installed.ready() and value_of(installed) == "1", how
        assert "smallthing" in capsys.readouterr().out


def test_what_somebody_installs_besides_is_no_change(installed: Environment, write_wheel, tmp_path: Path):
    wheel = write_wheel("otherthing", "1.0", "")
    subprocess.run([installed.python, "-m", "pip", "install", "-q", str(wheel)], check=True)
    assert installed.ready()


def test_an_interrupted_set_up_is_not_believed_and_is_completed(installed: Environment):
    packages = site_packages(installed)
    # State after a kill during pip: the marker, a package with missing files, no RECORD.
    installed.begun.touch()
    (packages / "smallthing-1.0.dist-info" / "RECORD").unlink()
    (packages / "smallthing.py").unlink()
    assert not installed.ready()
    set_up(installed, sys.executable)
    assert installed.ready()
    assert value_of(installed) == "1"


def test_manually_created_environment_is_adopted(environment: Environment):
    environment.state.rmdir()
    kept = environment.folder / "kept"
    kept.touch()
    set_up(environment, sys.executable)
    assert environment.ready() and kept.exists()


def test_foreign_folder_is_not_changed(bare_environment: Environment):
    bare_environment.folder.mkdir(parents=True)
    precious = bare_environment.folder / "precious.txt"
    precious.touch()
    with pytest.raises(LauncherError, match="move it, or set SPLANNEQUIN_HOME") as refused:
        set_up(bare_environment, sys.executable)
    assert precious.exists()
    assert refused.value.exit_code == 9


def test_a_package_that_cannot_be_had_names_step_log_and_remedy(environment: Environment, requirements: Path):
    (requirements / "small.lock").write_text(f"there-is-no-such-package==1.0 --hash=sha256:{'0' * 64}\n")
    with pytest.raises(LauncherError) as refused:
        set_up(environment, sys.executable)
    message = str(refused.value)
    assert "installing packages" in message
    assert "there-is-no-such-package" in message
    assert "package index" in message
    assert str(environment.log) in message
    assert "there-is-no-such-package" in environment.log.read_text()
    assert not environment.ready()


def test_a_package_that_does_not_import_is_not_ready(environment: Environment, write_lock, write_wheel):
    write_lock("small", write_wheel("smallthing", "3.0", "import absent_library"))
    with pytest.raises(LauncherError, match="absent_library"):
        set_up(environment, sys.executable)
    assert not environment.ready()


def test_a_full_disk_is_said_before_anything_is_written(bare_environment: Environment):
    with pytest.raises(LauncherError, match="GB free") as refused:
        set_up(dataclasses.replace(bare_environment, disk_gb=1e9), sys.executable)
    assert refused.value.exit_code == 8
    assert not bare_environment.folder.exists()


@pytest.mark.parametrize(("index", "needed"), [("/whl/cpu", 4), ("/whl/cu130", 9)])
def test_the_disk_that_a_set_up_needs_is_that_of_the_torch_it_will_install(
    with_torch: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, index: str, needed: int
):
    shutil.rmtree(with_torch.folder)
    monkeypatch.setenv("SPLANNEQUIN_TORCH_INDEX", f"file://{tmp_path}{index}")
    disk = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk._replace(free=int(needed * 1e9 - 1e8)))
    with pytest.raises(LauncherError, match=f"needs {needed} GB, but .* has {needed - 0.1:.1f} GB free") as refused:
        set_up(with_torch, sys.executable)
    assert refused.value.exit_code == 8
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk._replace(free=int(needed * 1e9 + 1e8)))
    with pytest.raises(LauncherError, match="no such python") as refused:
        set_up(with_torch, "no such python")
    assert refused.value.exit_code == 9


@pytest.mark.parametrize(("system", "needed"), [("linux", 9.0), ("win32", 4.0), ("darwin", 4.0)])
def test_without_an_index_it_is_that_of_what_pypi_has(system: str, needed: float):
    assert environments.disk_gb(environments.backend_environment(), "", system) == needed


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="PyPI has CUDA for Linux alone")
def test_an_index_out_of_reach_is_not_reckoned_with(
    with_torch: Environment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys
):
    """torch is then installed from the usual index, which on Linux has the build with CUDA."""
    shutil.rmtree(with_torch.folder)
    monkeypatch.setenv("SPLANNEQUIN_TORCH_INDEX", "http://127.0.0.1:9/whl/cpu")
    disk = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk._replace(free=int(5e9)))
    with pytest.raises(LauncherError, match="needs 9 GB"):
        set_up(with_torch, sys.executable)
    assert "cannot be reached: torch is installed from the usual index" in capsys.readouterr().out


def test_only_the_backend_environment_has_torch():
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


def pins(path: Path) -> dict[str, str]:
    """Map from name to version of a list of requirements."""
    found = re.findall(r"^([\w.-]+)==(\S+)", path.read_text(), re.M)
    return {environments.package_name(name): version for name, version in found}


def test_every_package_of_a_lock_has_hashes():
    locks = sorted(environments.REQUIREMENTS.glob("*.lock"))
    lists = {p.stem for p in environments.REQUIREMENTS.glob("*.txt")} - {"constraints"}
    assert {p.stem for p in locks} == {*lists, *environments.TORCH_LOCKS}
    for path in locks:
        entry = r"[\w.-]+==\S+( ; [^\\]+)?( \\\n    --hash=sha256:[0-9a-f]{64})+\n"
        text = "".join(line for line in path.read_text().splitlines(keepends=True) if not line.startswith("#"))
        assert re.fullmatch(f"({entry})+", text), f"{path.name} has a line that pip would take on trust"


def test_locks_match_requested_versions():
    """Fails after an edit of a list without a run of tools/lock_requirements.py."""
    folder = environments.REQUIREMENTS
    constraints = pins(folder / "constraints.txt")
    for path in folder.glob("*.txt"):
        if path.stem != "constraints":
            locks = [path.stem, *(("torch", "cuda") if path.stem == "backend" else ())]
            got = {name: version for lock in locks for name, version in pins(folder / f"{lock}.lock").items()}
            requested = pins(path)
            assert requested.items() <= got.items(), f"{path.name}: run tools/lock_requirements.py"
            agreed = {name: version for name, version in constraints.items() if name in got and name not in requested}
            assert agreed.items() <= got.items(), f"{path.name}: run tools/lock_requirements.py"
    # These are installed in one environment.
    together = [pins(folder / f"{lock}.lock") for lock in ("backend", "torch", "cuda", "test", "bench")]
    for name in set().union(*together):
        assert len({lock[name] for lock in together if name in lock}) == 1, name


def test_torch_of_this_version_is_known_by_its_hash_but_for_one_wheel():
    lock, cpu, cuda = environments.torch_lock, environments.CPU_INDEX, environments.CUDA_INDEX
    assert re.fullmatch(r"torch==[\d.]+", environments._torch_pin())
    for build in ("cpu", "cu130"):
        assert pins(environments.REQUIREMENTS / f"torch-{build}.lock") == {
            "torch": f"{environments._torch_pin().partition('==')[2]}+{build}"
        }
    for python in ((3, 11), (3, 12), (3, 13), (3, 14)):
        assert lock(cpu, python, "linux", "x86_64") == lock(cpu, python, "linux", "aarch64") == "torch-cpu.lock"
        assert lock(cuda, python, "win32", "AMD64") == ("torch-cu130.lock" if python != (3, 11) else "")
        assert not lock("https://download.pytorch.org/whl/cu126", python, "linux", "x86_64")
        assert not lock("https://somewhere.else/simple", python)


def test_unreachable_index_is_not_retried_for_every_package(tmp_path: Path):
    assert environments._reachable(tmp_path.as_uri())
    assert not environments._reachable("https://packages.invalid/whl/cpu")
    assert not environments._reachable("http://127.0.0.1:9/simple")


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pip with one index, at which nobody listens."""
    for name, value in {"NO_INDEX": "0", "CONFIG_FILE": os.devnull, "FIND_LINKS": "", "EXTRA_INDEX_URL": ""}.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)
    monkeypatch.setenv("PIP_RETRIES", "1")
    monkeypatch.setenv("PIP_INDEX_URL", "http://name:secret@127.0.0.1:9/simple")


def test_an_index_that_cannot_be_reached_is_what_is_wrong(
    environment: Environment, requirements: Path, offline, monkeypatch: pytest.MonkeyPatch
):
    (requirements / "small.lock").write_text(f"smallthing==1.0 --hash=sha256:{'0' * 64}\n")
    with pytest.raises(LauncherError) as refused:
        set_up(environment, sys.executable)
    message = str(refused.value)
    assert "127.0.0.1 cannot be reached" in message and "HTTPS_PROXY" in message and "run the same command" in message
    assert "Python 3" not in message and "secret" not in message
    assert refused.value.exit_code == 9

    monkeypatch.setenv("PIP_INDEX_URL", "https://packages.invalid/simple")
    monkeypatch.setenv("HTTPS_PROXY", "http://127.0.0.1:9")
    with pytest.raises(LauncherError, match="the proxy for packages.invalid cannot be used"):
        set_up(environment, sys.executable)


@pytest.mark.parametrize("home", ["file", "file/below", "n" * 300])
def test_a_home_that_cannot_be_is_one_sentence(bare_environment: Environment, tmp_path: Path, home: str):
    (tmp_path / "file").touch()
    placed = dataclasses.replace(bare_environment, folder=tmp_path / home / ".venv")
    with pytest.raises(LauncherError) as refused:
        set_up(placed, sys.executable)
    message = str(refused.value)
    assert "cannot be set up in" in message and "SPLANNEQUIN_HOME" in message and "Log:" not in message
    assert refused.value.exit_code == 9
