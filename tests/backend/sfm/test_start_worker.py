"""A package that COLMAP's process cannot load means an incomplete environment, not a failed solve."""

import json

import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.sfm.child import run_worker

BROKEN = {
    "missing": (b"import a_package_that_is_not_there", "No module named 'a_package_that_is_not_there'"),
    "without its library": (
        b"raise ImportError('libx.so.1: cannot open shared object file')",
        "libx.so.1: cannot open",
    ),
    "of another numpy": (
        b"raise ImportError('\\n\\nREAD THIS!\\n\\nOriginal error was: no.\\n')",
        "Original error was: no",
    ),
    "half written": (b"\0" * 4096, "null bytes"),
    "changed": (b"raise OSError(126, 'The specified module could not be found')", "could not be found"),
}


def answer(tmp_path, tools, monkeypatch, package):
    """Error of a child process that imports a pycolmap module with this content."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "pycolmap.py").write_bytes(package)
    (tmp_path / "request.json").write_text(json.dumps({"images": str(tmp_path)}))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))
    with pytest.raises(JobError) as error:
        run_worker(tmp_path / "request.json", tmp_path / "log.txt", tools.recorder())
    return error.value


@pytest.mark.parametrize("name", BROKEN)
def test_a_package_that_is_missing_or_broken_is_no_solve_that_broke(tmp_path, tools, monkeypatch, name):
    package, words = BROKEN[name]
    error = answer(tmp_path, tools, monkeypatch, package)
    assert error.exit_code == ExitCode.ENVIRONMENT
    assert error.message.startswith("The backend's environment is incomplete: ") and words in error.message
    assert error.message.count("\n") == 0 and not error.message.endswith("..")
    assert "Press Repair" in error.hint and "report" not in error.hint
    assert "Traceback" in (tmp_path / "log.txt").read_text(), "what a sentence leaves out is in the log"


def test_what_we_did_wrong_ourselves_is_not_the_environment(tmp_path, tools, monkeypatch):
    error = answer(tmp_path, tools, monkeypatch, b"from torch_backend.sfm import worker, no_such_module")
    assert error.exit_code == ExitCode.SOLVE and "no_such_module" in error.message


def test_memory_that_ends_while_packages_load_is_not_the_environment(tmp_path, tools, monkeypatch):
    error = answer(tmp_path, tools, monkeypatch, b"raise MemoryError")
    assert error.exit_code == ExitCode.SOLVE and "MemoryError" in error.message
