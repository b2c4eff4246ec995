"""Fixtures for tests on a simulated CUDA device: a shim that needs a C++ compiler, and processes that preload it."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[2]


@pytest.fixture(scope="session")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the compiled shim. Skips the test if the shim cannot be compiled or PyTorch has real CUDA support."""
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if sys.platform != "linux":
        pytest.skip("the pretended card is a shared library for Linux")
    if compiler is None:
        pytest.skip("the pretended card needs a C++ compiler (c++, g++ or clang++), and there is none")
    if torch.version.cuda is not None or torch.version.hip is not None:
        pytest.skip("the pretended card needs a PyTorch without CUDA: this one would ask a driver")
    folder, home = tmp_path_factory.mktemp("card"), Path(torch.__path__[0])
    command = [compiler, "-shared", "-fPIC", "-O0", "-w", "-std=c++20", str(FOLDER / "guard.cpp"), "-o", "guard.so"]
    command += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}", f"-I{home / 'include'}"]
    command += [f"-L{home / 'lib'}", "-ltorch_cpu", "-lc10", f"-Wl,-rpath,{home / 'lib'}"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if "error" in line] or ["it gave no reason"]
        pytest.skip(f"the pretended card does not compile here ({compiler}): {said[0]}")
    return folder / "guard.so"


WALKS = (
    "steps auto/support/poses hexplane/paper mlp/support control_points/support",
    "recorded hexplane",
    "launches hexplane",
    "resume static",
    "step_bytes static hexplane control_points",
    "memory_ends hexplane 0.6",
    "memory_ends static 0.85",
    "bad_frames",
    "self_test",
    "station",
)
"""Walks that run together in one process, because importing torch takes half the time of a walk."""


@pytest.fixture(scope="session")
def walk(card: Path) -> Callable[[str], Any]:
    """walk(words): result of a walk of `walks.py`; the words are one of `WALKS` or its beginning."""
    environ = {**os.environ, "PRETEND_CARD": str(card), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", str(FOLDER / "walks.py"), *WALKS]
    done = subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    results = json.loads(done.stdout.splitlines()[-1])

    def of(words: str) -> Any:
        (found,) = (results[name] for name in WALKS if f"{name} ".startswith(f"{words} "))
        assert "broke" not in found, found["broke"]
        return found

    return of
