"""`package`: a complete release or none, reproducible from the same commit, and one sentence per error."""

import hashlib
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from launcher.blender import bpy_environment, choose_wheels
from launcher.errors import LauncherError
from launcher.release import LOCKS, SBOM, SUMS
from launcher.sbom import LICENCES, bill_of_materials, read_lock
from torch_backend import __version__
from torch_backend.contract import package_name

ROOT = Path(__file__).resolve().parents[2]
NAME = f"splannequin-{__version__}"
UNPACKED = ("docs", "examples", "benchmarks", "tests")
"""Folders that the zip leaves out, and that the command does not need."""


def git(folder: Path, *words: str) -> bytes:
    name = ("-c", "user.name=test", "-c", "user.email=test@example.com", "-c", "commit.gpgsign=false")
    return subprocess.run(["git", "-C", str(folder), *name, *words], check=True, capture_output=True).stdout


@pytest.fixture(scope="session")
def _checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no Git checkout to build from")
    folder = tmp_path_factory.mktemp("checkout")
    names = git(ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard").decode().split("\0")
    for name in names:
        if name and name.split("/")[0] not in UNPACKED and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    git(folder, "init", "-q")
    commit(folder)
    return folder


@pytest.fixture
def checkout(_checkout: Path, tmp_path: Path) -> Path:
    """New Git repository with a copy of this repository's files."""
    return Path(shutil.copytree(_checkout, tmp_path / "checkout"))


def commit(folder: Path) -> None:
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "a release", "--date=2026-11-30T12:00:00Z")


@pytest.fixture
def blender_program(tmp_path: Path):
    """blender_program(commands): writes a program that runs shell commands, then the tool of an installed bpy wheel.

    It accepts the arguments of `blender --background --factory-startup --command extension ...`.
    """
    ready = [series for series, _ in choose_wheels() if bpy_environment(series).ready()]
    if not ready or os.name == "nt":
        pytest.skip("no bpy wheel is set up by the launcher, or no shell")
    folder = bpy_environment(ready[0]).folder
    tool = next(folder.glob("lib/python*/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))

    def write(commands: str = "") -> Path:
        path = tmp_path / "blender"
        path.write_text(
            f'#!/bin/sh\nif [ "$1" = --version ]; then echo "Blender 5.0.1"; exit; fi\nshift 4\n{commands}\n'
            f'exec "{folder / "bin" / "python"}" -P "{tool}" "$@"\n'
        )
        path.chmod(0o755)
        return path

    return write


def package(checkout: Path, output: Path, *arguments: str | Path, umask: int = -1) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(checkout / "splannequin.py"), "package", "--output", output, *arguments]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, umask=umask)


def contents(folder: Path) -> dict[str, str]:
    """Map from every file below a folder to its SHA-256."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def results(output: Path) -> set[str]:
    """Contents of a folder without the command's own notes."""
    return {path.name for path in output.iterdir()} - {"summary.json", "blender.log", ".package.lock"}


def test_a_package_is_whole_and_the_same_from_the_same_commit(checkout: Path, blender_program, tmp_path: Path):
    (checkout / "output").mkdir()
    (checkout / "output" / "left_out.py").touch()
    (checkout / "launcher" / "left_out.pyc").touch()
    first = package(checkout, tmp_path / "first", "--blender", blender_program(), umask=0o077)
    assert first.returncode == 0, first.stderr
    again = Path(shutil.copytree(checkout, tmp_path / "again"))
    for file in (again / "launcher").iterdir():
        os.utime(file, (0, 0))
    assert package(again, tmp_path / "second", "--blender", blender_program()).returncode == 0
    folder = tmp_path / "first" / NAME
    found = contents(folder)
    assert results(tmp_path / "first") == {NAME}
    assert found.keys() == {f"{NAME}.zip", "index.json", "index.html", SBOM, SUMS}
    sums = dict(line.split("  ")[::-1] for line in (folder / SUMS).read_text().splitlines())
    assert sums == {name: digest for name, digest in found.items() if name != SUMS}
    listed = json.loads((folder / "index.json").read_text())["data"]
    assert [one["archive_hash"] for one in listed] == [f"sha256:{found[f'{NAME}.zip']}"]
    bill = json.loads((folder / SBOM).read_text())
    assert bill["metadata"]["component"]["hashes"][0]["content"] == found[f"{NAME}.zip"]
    with zipfile.ZipFile(folder / f"{NAME}.zip") as archive:
        names = archive.namelist()
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert manifest["version"] == __version__ and "launcher/release.py" in names
    assert not [name for name in names if "left_out" in name]
    second = contents(tmp_path / "second" / NAME)
    varying = {"index.html", SUMS}  # Blender writes the minute into the page
    assert {k: v for k, v in found.items() if k not in varying} == {k: v for k, v in second.items() if k not in varying}


def test_what_is_not_committed_is_no_release(checkout: Path, blender_program, tmp_path: Path):
    (checkout / "launcher" / "new.py").touch()
    done = package(checkout, tmp_path / "out", "--blender", blender_program())
    assert done.returncode == 0 and "This is not a release: 1 files differ" in done.stdout
    assert results(tmp_path / "out") == {f"{NAME}-uncommitted"}


KILL = 'if [ "$1" = server-generate ]; then kill -9 $PPID; exit 1; fi'
SILENT = 'if [ "$1" = server-generate ]; then exit 0; fi'
BROKEN = 'if [ "$1" = validate ]; then echo "Error: it is broken" >&2; exit 1; fi'


def test_a_package_that_comes_to_nothing_leaves_the_one_before(checkout: Path, blender_program, tmp_path: Path):
    output = tmp_path / "out"
    assert package(checkout, output, "--blender", blender_program()).returncode == 0
    before = contents(output / NAME)
    for commands in (SILENT, BROKEN, KILL):
        failed = package(checkout, output, "--blender", blender_program(commands))
        assert failed.returncode != 0 and contents(output / NAME) == before
        if commands != KILL:
            assert failed.stderr.startswith("Error: Blender 5.0.1 cannot ") and failed.stderr.count("\n") == 1
            assert results(output) == {NAME}
    shutil.rmtree(output / NAME)
    for commands in (BROKEN, KILL):
        assert package(checkout, output, "--blender", blender_program(commands)).returncode != 0
        assert NAME not in results(output)
    assert package(checkout, output, "--blender", blender_program()).returncode == 0
    assert results(output) == {NAME} and contents(output / NAME).keys() == before.keys()


@pytest.mark.parametrize("megabytes", [1, 5, 7, 9])
def test_a_full_disk_is_one_sentence_and_no_package(checkout: Path, blender_program, tmp_path: Path, megabytes: int):
    """The disk fills during copying, during Blender's packing, during writing of the zip, or is just large enough."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "none", str(disk)]
    if sys.platform != "linux" or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting needs Linux and root")
    try:
        done = package(checkout, disk / "out", "--blender", blender_program())
        print(done.stdout, done.stderr, subprocess.run(["df", "-k", str(disk)], capture_output=True).stdout)
        if done.returncode:
            assert done.returncode == 8 and done.stderr.count("\n") == 1, done.stderr
            assert results(disk / "out") == set()
        else:
            assert len(contents(disk / "out" / NAME)) == 5
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.mark.parametrize("says", [None, "nothing that a Blender says", "Blender 3.6.9"])
def test_a_wrong_blender_is_one_sentence(tmp_path: Path, says: str | None):
    program = tmp_path / "blender"
    if says is not None:
        program.write_text(f"#!/bin/sh\necho '{says}'\n")
        program.chmod(0o755)
    done = package(ROOT, tmp_path / "out", "--blender", program)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and str(program) in done.stderr
    assert results(tmp_path / "out") == set()


@pytest.mark.parametrize("name", ["requirements/cuda.lock", "requirements/licences.toml", "blender_manifest.toml"])
def test_a_damaged_file_is_one_sentence(checkout: Path, blender_program, tmp_path: Path, name: str):
    (checkout / name).write_bytes((checkout / name).read_bytes()[:500])
    done = package(checkout, tmp_path / "out", "--blender", blender_program())
    assert done.returncode != 0 and done.stderr.count("\n") == 1 and name in done.stderr
    assert results(tmp_path / "out") == set()


def test_a_folder_that_is_no_checkout_is_one_sentence(checkout: Path, blender_program, tmp_path: Path):
    shutil.rmtree(checkout / ".git")
    done = package(checkout, tmp_path / "out", "--blender", blender_program())
    assert done.returncode != 0 and done.stderr.count("\n") == 1 and str(checkout) in done.stderr


HASH = "    --hash=sha256:" + "a" * 64


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# only a comment\n",
        f"{HASH}\n",
        "one==1 \\\n",
        "one==1\n",
        f"one==1 \\\n{HASH} \\\n",
        f"one==1 \\\n{HASH[:-1]}\n",
        f"one==1 \\\n{HASH}\n\0\0\0\0",
        f"one==1 \\\n{HASH} \\\ntwo==2 \\\n{HASH}\n",
        f"one>=1 \\\n{HASH}\n",
    ],
)
def test_a_lock_that_was_cut_or_changed_is_refused(tmp_path: Path, text: str):
    (tmp_path / "some.lock").write_text(text)
    with pytest.raises(LauncherError, match=r"some\.lock is damaged: "):
        read_lock(tmp_path / "some.lock")


def bill() -> dict:
    product = {"id": "splannequin", "version": "1", "name": "Splannequin", "licence": "GPL-3.0-or-later"}
    return bill_of_materials(ROOT / "requirements", LOCKS, product, "0" * 64, "2026-11-30T12:00:00Z")


def test_the_bill_lists_every_package_and_hash_of_the_locks():
    listed: dict[str, set[str]] = {}
    for lock in LOCKS:
        name = ""
        for line in (ROOT / "requirements" / f"{lock}.lock").read_text().splitlines():
            if pin := re.match(r"([\w.-]+)==([^\s;]+)", line):
                name = f"{package_name(pin[1])} {pin[2]}"
            elif digest := re.search(r"sha256:(\w+)", line):
                listed.setdefault(name, set()).add(digest[1])
    found = {
        f"{one['name']} {one['version']}": {h["content"] for h in one["externalReferences"][0]["hashes"]}
        for one in bill()["components"]
    }
    assert found == listed and len(found) > 40
    unlisted = {path.stem for path in (ROOT / "requirements").glob("*.lock")} - set(LOCKS)
    assert unlisted == {"test", "test-bpy", "bench"}


def test_licences_are_those_that_the_installed_packages_declare():
    """Compared with the packages of the backend's environment that declare an SPDX licence expression."""
    table = tomllib.loads((ROOT / "requirements" / LICENCES).read_text())
    assert table.keys() == {one["name"] for one in bill()["components"]}
    declared = {
        package_name(one.metadata["Name"]): one.metadata["License-Expression"]
        for one in importlib.metadata.distributions()
        if one.metadata["License-Expression"]
    }
    known = table.keys() & declared.keys()
    assert not {name: declared[name] for name in known if declared[name] != table[name]}
    if "torch" in declared:
        assert len(known) > 5
