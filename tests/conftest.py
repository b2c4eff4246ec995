"""Shared by the backend's tests and, inside a bpy wheel, the add-on's: only imports standard library and pytest."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import pytest

if importlib.util.find_spec("hypothesis"):
    from hypothesis import settings

    # Tests must not depend on the machine's speed, and every run tries the same examples.
    settings.register_profile("splannequin", deadline=None, derandomize=True, max_examples=50)
    settings.load_profile("splannequin")

OURS = ("torch_backend", "launcher", "benchmarks")
HOSTILE = (*OURS, "pycolmap", "numpy", "torch", "json", "venv", "pip", "ensurepip", "site")
CUSTOM = ("sitecustomize", "usercustomize")


@pytest.fixture(autouse=True)
def as_it_was_scheduled():
    """Fail a test that leaves the process with real-time scheduling, as SVT-AV1 does as root; later tests would
    starve."""
    yield
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        pytest.fail("the test left this process with another scheduling policy than it had")


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """hostile(folder, ...): writes modules into folders and changes to the first folder.

    Returns the file that the modules write when they are imported.
    """
    marker = tmp_path / "a module of a shot was imported"

    def plant(*folders: Path) -> Path:
        monkeypatch.delenv("PYTHONSAFEPATH", raising=False)  # may be set for the tests; users do not set it
        monkeypatch.setenv("PYTHONPATH", "")
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            source = f"open({str(marker)!r}, 'a').write(__name__ + ' ' + __file__ + chr(10))\n"
            for name in (*HOSTILE, *CUSTOM):
                (folder / f"{name}.py").write_text(source, encoding="utf-8")
            (folder / "torch_backend.py").unlink()
            (folder / "torch_backend").mkdir(exist_ok=True)
            for name in ("__init__", "__main__"):
                (folder / "torch_backend" / f"{name}.py").write_text(source, encoding="utf-8")
        monkeypatch.chdir(folders[0])
        return marker

    return plant


NVIDIA_SMI = """#!/bin/sh
# Stands in for NVIDIA's own tool on a machine without a card: prints what that prints.
case "$*" in
*compute_cap*) {old} cat <<'END'
{with_compute}
END
exit {code};;
*) cat <<'END'
{without_compute}
END
exit {code};;
esac
"""


@pytest.fixture
def nvidia_smi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """nvidia_smi(row, ...): puts a stand-in of NVIDIA's tool on the PATH that lists "name, driver, compute capability".

    `code` is its exit code. With `old`, it does not support the last column.
    """

    def put(*rows: str, code: int = 0, old: bool = False) -> None:
        folder = tmp_path / f"bin {len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        refusal = "echo 'Field \"compute_cap\" is not a valid field to query.'; exit 2;" if old else ""
        source = NVIDIA_SMI.format(
            old=refusal,
            with_compute="\n".join(rows),
            without_compute="\n".join(row.rpartition(",")[0] for row in rows) if old else "\n".join(rows),
            code=code,
        )
        (folder / "nvidia-smi").write_text(source, encoding="utf-8")
        (folder / "nvidia-smi").chmod(0o755)
        monkeypatch.setenv("PATH", os.pathsep.join([str(folder), os.environ["PATH"]]))
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)

    return put
