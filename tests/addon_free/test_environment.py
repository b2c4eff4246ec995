"""Blender reports the source from which the launcher will fetch PyTorch; the launcher makes the choice."""

import os
from pathlib import Path

import pytest

from launcher import environments
from torch_backend.contract import TORCH_INDEX, brings_cuda

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the stand-ins are shell scripts")

GOOD = "NVIDIA GeForce RTX 3090, 580.65.06, 8.6"
OLD_DRIVER = "NVIDIA GeForce RTX 3090, 535.183.01, 8.6"
OLD_CARD = "Tesla P100-PCIE-16GB, 580.65.06, 6.0"
PYPI_ONLY, BOTH = "pypi.org", "pypi.org, download.pytorch.org"


@pytest.mark.parametrize("variable", [None, "", "https://download.pytorch.org/whl/cu126"])
@pytest.mark.parametrize("card", [None, GOOD, OLD_CARD, OLD_DRIVER])
@pytest.mark.parametrize("system", ["linux", "win32", "darwin"])
def test_launcher_and_add_on_know_one_rule(addon, nvidia_smi, tmp_path, monkeypatch, system, card, variable):
    environment = addon("process.environment")
    if card is None:
        monkeypatch.setenv("PATH", str(tmp_path))
    else:
        nvidia_smi(card)
    monkeypatch.delenv(TORCH_INDEX, raising=False)
    if variable is not None:
        monkeypatch.setenv(TORCH_INDEX, variable)
    taken = environments.this_machines_index(system)
    said = environment.sources(system)
    # Blender cannot wait for NVIDIA's tool; if the tool exists, Blender assumes a suitable GPU.
    doubt = system == "win32" and variable is None and card in (OLD_CARD, OLD_DRIVER)
    assert said == (BOTH if taken or doubt else PYPI_ONLY)
    if doubt:
        assert not brings_cuda(taken, system), "4 GB that such a card cannot use"


@pytest.mark.parametrize("variable", [None, "", "https://somewhere.else/simple"])
def test_the_launcher_is_left_to_choose(addon, tmp_path, monkeypatch, variable):
    """The child process gets a package index only if the user set the variable."""
    environment = addon("process.environment")
    monkeypatch.delenv(TORCH_INDEX, raising=False)
    if variable is not None:
        monkeypatch.setenv(TORCH_INDEX, variable)
    python, environment_file = tmp_path / "python", tmp_path / "told"
    python.write_text(f"#!/bin/sh\nenv > '{environment_file}'\n")
    python.chmod(0o755)
    setup = environment.start(tmp_path / "backend", str(python), Path(__file__).resolve().parents[2])
    assert setup.process.wait() == 0
    heard = [line for line in environment_file.read_text().splitlines() if line.startswith(TORCH_INDEX)]
    assert heard == ([] if variable is None else [f"{TORCH_INDEX}={variable}"])
