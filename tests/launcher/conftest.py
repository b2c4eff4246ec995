"""Real virtual environments, created offline from a wheel that the test writes."""

import base64
import dataclasses
import hashlib
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from launcher import environments


@pytest.fixture(autouse=True)
def ctrl_c() -> Iterator[None]:
    """Ctrl-C reaches children, although a shell's background jobs, such as this pytest, may ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def write_wheel(tmp_path: Path):
    """write_wheel(name, version, source, needs): writes a wheel of one module and returns its path."""

    def write(name: str, version: str, source: str, needs: str = "") -> Path:
        info = f"{name}-{version}.dist-info"
        files = {
            f"{name}.py": source,
            f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
            + (f"Requires-Dist: {needs}\n" if needs else ""),
            f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        }
        rows = []
        for path, content in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(content.encode()).digest()).rstrip(b"=").decode()
            rows.append(f"{path},sha256={digest},{len(content)}\n")
        files[f"{info}/RECORD"] = "".join([*rows, f"{info}/RECORD,,\n"])
        wheel = tmp_path / f"{name}-{version}-py3-none-any.whl"
        with zipfile.ZipFile(wheel, "w") as archive:
            for path, content in files.items():
                archive.writestr(zipfile.ZipInfo(path), content)  # without a date: the same bytes each time
        return wheel

    return write


@pytest.fixture
def requirements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Requirements folder of the test, and a pip that only uses local wheels."""
    folder = tmp_path / "requirements"
    folder.mkdir()
    monkeypatch.setattr(environments, "REQUIREMENTS", folder)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    return folder


@pytest.fixture
def write_lock(requirements: Path):
    """write_lock(name, wheels...): writes a lock of wheels in the test's folder, with their hashes."""

    def write(name: str, *wheels: Path) -> None:
        with open(requirements / f"{name}.lock", "w") as lock:
            for wheel in wheels:
                package, version, *_ = wheel.name.split("-")
                digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
                lock.write(f"{package}=={version} \\\n    --hash=sha256:{digest}\n")

    return write


@pytest.fixture
def bare_environment(tmp_path: Path, write_lock, write_wheel) -> environments.Environment:
    """An environment of one small package, not set up yet."""
    write_lock("small", write_wheel("smallthing", "1.0", "value = 1"))
    return environments.Environment("the test", tmp_path / "home" / ".venv", ("small",), "import smallthing", 0.01)


def start(folder: Path) -> None:
    """Create the virtual environment that a set-up starts with, in a tenth of the time.

    It uses the pip of the current Python. If there is none, the set-up creates the environment again.
    """
    command = [sys.executable, "-P", "-m", "venv", "--without-pip", "--system-site-packages", str(folder)]
    subprocess.run(command, check=True)
    (folder / ".splannequin").mkdir()


@pytest.fixture
def environment(bare_environment: environments.Environment) -> environments.Environment:
    """An environment of one small package, whose set-up was only begun."""
    start(bare_environment.folder)
    return bare_environment


@pytest.fixture(scope="session")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Place of the finished environment that `installed` copies."""
    return tmp_path_factory.mktemp("installed") / ".venv"


@pytest.fixture
def installed(bare_environment: environments.Environment, shelf: Path) -> environments.Environment:
    """A finished environment of one small package."""
    if not shelf.exists():
        start(bare_environment.folder)
        environments.set_up(bare_environment, sys.executable)
        shutil.copytree(bare_environment.folder, shelf, symlinks=True)
    else:
        shutil.copytree(shelf, bare_environment.folder, symlinks=True)
    return bare_environment


@pytest.fixture
def with_torch(environment: environments.Environment, write_lock, write_wheel) -> environments.Environment:
    """That environment with a torch."""
    write_lock("torch", write_wheel("torch", "2.13.0", ""))
    write_lock("torch-cpu")
    write_lock("torch-cu130")
    write_lock("cuda", write_wheel("nvidia_small", "1.0", ""))
    return dataclasses.replace(environment, disk_gb=environments.BACKEND_DISK_GB, torch=True)
