"""Folders that a compiler can open under any profile name, and that Warp really compiles in."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from torch_backend.compiler_folders import CompilerFolders, compiler_folders
from torch_backend.contract import JobError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def warp_of(tmp_path: Path):
    """warp_of(name): creates a package of that name with a header."""

    def make(name: str) -> Path:
        package = tmp_path / name / "warp"
        (package / "native").mkdir(parents=True)
        (package / "native" / "builtin.h").write_text("// here")
        return package

    return make


def environ(tmp_path: Path) -> dict[str, str]:
    return {"PROGRAMDATA": str(tmp_path / "all users"), "USERPROFILE": "C:\\Users\\Jörg"}


def test_ascii_paths_and_other_systems_are_unchanged(warp_of, tmp_path: Path):
    plain, odd = warp_of("plain"), warp_of("Jörg")
    assert compiler_folders(plain, "1.0", environ(tmp_path), tmp_path, windows=True).headers is None
    assert compiler_folders(plain, "1.0", environ(tmp_path), tmp_path, windows=True).kernels is None
    assert compiler_folders(odd, "1.0", environ(tmp_path), odd, windows=False) == CompilerFolders()


def test_an_umlaut_moves_headers_and_kernels_once(warp_of, tmp_path: Path):
    odd = warp_of("Jörg")
    found = compiler_folders(odd, "1.0", environ(tmp_path), odd.parent / "cache", windows=True)
    for folder in (found.headers, found.kernels):
        assert folder is not None and str(folder).isascii() and tmp_path / "all users" in folder.parents
    assert (found.headers / "native" / "builtin.h").read_text() == "// here"
    (found.headers / "native" / "builtin.h").write_text("// the copy")
    again = compiler_folders(odd, "1.0", environ(tmp_path), odd.parent / "cache", windows=True)
    assert again == found and (found.headers / "native" / "builtin.h").read_text() == "// the copy"
    newer = compiler_folders(odd, "1.1", environ(tmp_path), odd.parent / "cache", windows=True)
    assert newer.headers != found.headers, "headers are of one version"
    only_cache = compiler_folders(warp_of("plain"), "1.0", environ(tmp_path), odd, windows=True)
    assert only_cache.headers is None and only_cache.kernels == found.kernels


def test_interrupted_copy_is_repeated(warp_of, tmp_path: Path):
    odd = warp_of("Jörg")
    first = compiler_folders(odd, "1.0", environ(tmp_path), odd, windows=True).headers
    os.rename(first / "native", first / "native.part")
    (first / "native.part" / "half a file").write_text("")
    again = compiler_folders(odd, "1.0", environ(tmp_path), odd, windows=True).headers
    assert [path.name for path in (again / "native").iterdir()] == ["builtin.h"]


@pytest.mark.skipif(os.name == "nt", reason="owner and modes as POSIX has them")
@pytest.mark.parametrize("whose", ["another user's", "open to all", "a link", "a file"])
def test_a_folder_that_another_user_may_have_filled_is_not_taken(warp_of, tmp_path: Path, whose: str):
    """Compiled code is loaded, so whoever can write there can run code as this user."""
    odd = warp_of("Jörg")
    places = {**environ(tmp_path), "PUBLIC": str(tmp_path / "public")}
    first = compiler_folders(odd, "1.0", places, odd, windows=True).kernels
    assert first is not None and first.parent.stat().st_mode & 0o777 == 0o700
    shutil.rmtree(first.parent)
    if whose == "a link":
        (tmp_path / "trap").mkdir()
        first.parent.symlink_to(tmp_path / "trap")
    elif whose == "a file":
        first.parent.touch()
    else:
        first.parent.mkdir()
        if whose == "open to all":
            first.parent.chmod(0o777)
        elif os.geteuid():
            pytest.skip("only root gives folders away")
        else:
            os.chown(first.parent, 12345, 12345)
    taken = compiler_folders(odd, "1.0", places, odd, windows=True).kernels
    assert taken is not None and tmp_path / "public" in taken.parents
    del places["PUBLIC"]
    with pytest.raises(JobError, match="the compiler cannot open"):
        compiler_folders(odd, "1.0", places, odd, windows=True)


def test_missing_ascii_folder_gives_a_readable_error(warp_of, tmp_path: Path):
    odd = warp_of("Jörg")
    for places in ({}, {"PROGRAMDATA": str(tmp_path / "Jörg")}, {"PUBLIC": "not absolute"}):
        with pytest.raises(JobError, match="the compiler cannot open .*Jörg") as refused:
            compiler_folders(odd, "1.0", places, odd, windows=True)
        assert "PROGRAMDATA" in refused.value.hint


SCRIPT = """
import sys
from pathlib import Path
import warp
import torch_backend.native as native
from torch_backend.compiler_folders import CompilerFolders
moved = CompilerFolders(Path(sys.argv[1]), Path(sys.argv[2]), False)
native.compiler_folders = lambda *told: moved
seen = native.build("moved", "*(int*)block = PROBE;")
import ctypes
number = ctypes.c_int(0)
seen(ctypes.addressof(number), 0, 0)
print(number.value, native.initialised_warp().config.kernel_cache_dir)
"""


def test_warp_compiles_from_moved_headers_into_a_moved_cache(tmp_path: Path):
    home = tmp_path / "headers"
    folders = compiler_folders(Path(wp.__file__).parent, "x", {}, tmp_path, windows=False)
    assert folders.headers is None
    home.mkdir()
    native = home / "native"
    shutil.copytree(Path(wp.__file__).parent / "native", native)
    with open(native / "builtin.h", "a", encoding="utf-8") as header:
        header.write("\n#define PROBE 77\n")
    command = [sys.executable, "-P", "-c", SCRIPT, str(tmp_path / "kernels"), str(home)]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    number, cache = done.stdout.split(maxsplit=1)
    assert number == "77" and Path(cache.strip()).parent == tmp_path / "kernels"
