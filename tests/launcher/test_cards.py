"""The launcher's use of NVIDIA's tool; a script stands in that prints the real tool's output."""

import os
import shutil
from pathlib import Path

import pytest

from launcher import doctor, environments
from torch_backend.cards import Card, nvidia_cards, why_unused
from torch_backend.contract import CPU_INDEX, CUDA_INDEX

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the stand-in is a shell script")

GOOD = "NVIDIA GeForce RTX 3090, 580.65.06, 8.6"
OLD_DRIVER = "NVIDIA GeForce RTX 3090, 535.183.01, 8.6"
OLD_CARD = "Tesla P100-PCIE-16GB, 580.65.06, 6.0"
ON_CPU = {"torch_device": "cpu", "trains_on": "cpu", "cuda_refusal": "PyTorch sees no NVIDIA GPU."}
CUDA, CPU_BUILD = {**ON_CPU, "torch_cuda": "13.0"}, {**ON_CPU, "torch_cuda": None}


def findings(facts: dict) -> dict[str, str]:
    return {finding.what: finding.text for finding in doctor.gpu_findings(facts)}


@pytest.mark.parametrize("facts", [CUDA, CPU_BUILD, {}])
def test_an_old_driver_is_what_is_wrong(nvidia_smi, facts: dict):
    nvidia_smi(OLD_DRIVER)
    found = findings(facts)
    assert "driver 535.183.01, and R580 or newer is needed" in found["gpu"] and "Update" in found["gpu"]
    assert "torch on gpu" not in found, "torch is not to blame"


def test_a_driver_that_does_not_know_the_compute_capability_is_old(nvidia_smi):
    nvidia_smi("GeForce GTX 1080 Ti, 470.57.02, 6.1", old=True)
    assert nvidia_cards() == ([Card("GeForce GTX 1080 Ti", "470.57.02", "")], "")
    assert "driver 470.57.02" in findings(CUDA)["gpu"]


def test_an_old_card_is_what_is_wrong(nvidia_smi):
    nvidia_smi(OLD_CARD)
    found = findings(CPU_BUILD)
    assert "compute capability 6.0, and 7.5" in found["gpu"] and "driver" not in found["gpu"]
    assert "torch on gpu" not in found


def test_torch_without_cuda_is_what_is_wrong(nvidia_smi):
    nvidia_smi(OLD_CARD, GOOD)
    found = findings(CPU_BUILD)
    assert "without CUDA" in found["torch on gpu"] and "set it up again" in found["torch on gpu"]


def test_a_torch_with_cuda_that_sees_no_card_is_not_said_to_be_without(nvidia_smi):
    nvidia_smi(GOOD)
    assert "does not see NVIDIA GeForce RTX 3090, although" in findings(CUDA)["torch on gpu"]
    used = {"torch_device": "cuda", "trains_on": "cuda", "torch_cuda": "13.0", "cuda_refusal": ""}
    assert list(findings(used)) == ["gpu"]
    warp = {**used, "trains_on": "cpu", "cuda_refusal": "PyTorch sees the NVIDIA GPU, but Warp does not."}
    assert findings(warp)["torch on gpu"] == warp["cuda_refusal"]


def test_a_driver_that_does_not_answer(nvidia_smi):
    nvidia_smi("Failed to initialize NVML: Driver/library version mismatch", code=18)
    assert "version mismatch" in findings(CUDA)["gpu"] and "restart" in findings(CUDA)["gpu"]


def test_a_driver_that_speaks_in_another_code_page(nvidia_smi, tmp_path: Path):
    nvidia_smi("x", code=18)
    tool = Path(shutil.which("nvidia-smi") or "")
    tool.write_bytes(b"#!/bin/sh\nprintf 'Der Treiber antwortet nicht: \\374berlastet\\n'; exit 18\n")
    assert "Der Treiber antwortet nicht" in findings(CUDA)["gpu"]


def test_no_card_is_nothing_to_mend(nvidia_smi, tmp_path: Path, monkeypatch):
    nvidia_smi("No devices were found", code=6)
    assert "nothing is missing" in findings(CUDA)["gpu"]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "nothing is missing" in findings(CUDA)["gpu"]
    assert why_unused(None) is None


def test_a_card_that_somebody_hid_is_not_missed(nvidia_smi, monkeypatch):
    nvidia_smi(GOOD)
    assert why_unused(None) is not None
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert why_unused(None) is None


def test_torch_comes_with_cuda_where_a_card_can_use_it(nvidia_smi, tmp_path: Path, monkeypatch):
    monkeypatch.delenv("SPLANNEQUIN_TORCH_INDEX", raising=False)
    for row, index in ((OLD_DRIVER, ""), (OLD_CARD, ""), (GOOD, CUDA_INDEX)):
        nvidia_smi(row)
        assert environments.this_machines_index("win32") == index
        assert environments.this_machines_index("linux") == environments.this_machines_index("darwin") == "", (
            "PyPI's has CUDA"
        )
    monkeypatch.setenv("PATH", str(tmp_path))
    assert environments.this_machines_index("linux") == CPU_INDEX, "no driver: 4 GB less"
    assert environments.this_machines_index("win32") == environments.this_machines_index("darwin") == "", (
        "PyPI's has none"
    )
    monkeypatch.setenv("SPLANNEQUIN_TORCH_INDEX", "")
    assert environments.this_machines_index("linux") == "", "somebody's wish"
