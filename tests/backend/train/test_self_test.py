"""The GPU self-test, here on Warp's cpu device (fibers): its findings, and their caching.

tests/backend/card/test_card.py runs it on a simulated GPU, also with kernels that fail to launch.
"""

import dataclasses
import json
import os
import sys
from pathlib import Path

import pytest
import torch

from torch_backend.contract import JobError
from torch_backend.deformation import planes_cuda
from torch_backend.train import adam, choose_device, device, self_test
from torch_backend.train.self_test import SelfTest, card_verdict, run_self_test


@pytest.fixture
def cards(nvidia_smi):
    if sys.platform == "win32":
        pytest.skip("the stand-in of nvidia-smi is a shell script")
    return nvidia_smi


@pytest.fixture
def changed_adam(monkeypatch):
    """changed_adam(old, new): replaces a part of the source of Adam's kernel."""

    def change(old: str, new: str) -> None:
        source = adam._source
        assert old in source("adam.cu")
        monkeypatch.setattr(
            adam, "_source", lambda name: source(name).replace(old, new) if name == "adam.cu" else source(name)
        )
        adam._kernel.cache_clear()

    yield change
    monkeypatch.undo()
    adam._kernel.cache_clear()


def test_kernels_that_compute_something_else_are_found(changed_adam, monkeypatch):
    monkeypatch.setattr(self_test, "_frame", lambda device: [])  # tested on a simulated GPU
    changed_adam("r[1] * (g[i] - m[i])", "1.02f * r[1] * (g[i] - m[i])")
    found = run_self_test(torch.device("cpu"))
    assert len(found.checks) == 5 and found.lasting
    assert [c.what for c in found.checks if not c.error <= c.bound] == ["a step of Adam"]
    assert found.problem.startswith("a step of Adam comes out wrong on it")


@pytest.mark.parametrize(
    ("kernel", "old", "new", "wrong"),
    [
        ("plane_samples", "at.weight[3] * e.c[c]", "0.f", "the field comes out wrong on it"),
        ("plane_points", "sx[k] = at[k].dx", "sx[k] = at[k].dy", "the gradient of its points comes out wrong on it"),
        ("plane_penalty", "const float gap", "constfloat gap", "a kernel does not build or run on it ("),
    ],
)
def test_torch_replaces_wrong_field_kernels(kernel, old, new, wrong, monkeypatch, quiet, capfd):
    source = planes_cuda.source
    assert old in source(kernel, 16)

    def changed_source(name: str, channels: int) -> str:
        return source(name, channels).replace(old, new) if name == kernel else source(name, channels)

    for name in ("_frame", "_loss", "_adam"):
        monkeypatch.setattr(self_test, name, lambda where: [])
    monkeypatch.setattr(planes_cuda, "source", changed_source)
    monkeypatch.setattr(planes_cuda, "refused", "")
    planes_cuda.kernels.cache_clear()
    try:
        found = run_self_test(torch.device("cpu"))
    finally:
        monkeypatch.setattr(planes_cuda, "source", source)
        planes_cuda.kernels.cache_clear()
    assert found.problem == "" and found.planes.startswith(wrong) and found.lasting
    monkeypatch.setattr(device, "cuda_refusal", lambda: "")
    monkeypatch.setattr(device, "card_verdict", lambda: found)
    report = quiet()
    assert choose_device("auto", report, "Training").type == "cuda" and device.decide_device("auto")[1] is None
    ((_, sentence, advice),) = report.events
    assert sentence.startswith("Training computes motion with PyTorch's own operators") and found.planes in sentence
    assert "doctor --gpu" in advice
    plane = torch.ones(1, 16, 3, 3).contiguous(memory_format=torch.channels_last)
    assert not planes_cuda.supports([plane])
    monkeypatch.setattr(device, "card_verdict", SelfTest)
    assert choose_device("auto", report, "Training").type == "cuda" and len(report.events) == 1
    assert planes_cuda.supports([plane])
    capfd.readouterr()


def test_a_kernel_that_does_not_build_is_a_sentence(changed_adam, monkeypatch, capfd):
    monkeypatch.setattr(self_test, "_frame", lambda device: [])
    changed_adam("float odd", "flaot odd")
    found = run_self_test(torch.device("cpu"))
    assert found.problem.startswith("a kernel does not build or run on it (") and "\n" not in found.problem
    capfd.readouterr()


def test_a_card_is_tested_once_and_again_after_an_update(tmp_path: Path, cards):
    calls = []

    def test(key: str) -> SelfTest:
        calls.append(key)
        return SelfTest(key=key, problem="it is broken", checks=[self_test.Check("a frame", 0.5, 0.01)])

    cards("NVIDIA GeForce RTX 4070, 580.65.06, 8.9")
    assert [card_verdict(tmp_path, test).problem for _ in range(3)] == ["it is broken"] * 3
    assert len(calls) == 2, "what fails is tested again, and not a third time"
    kept = json.loads((tmp_path / "splannequin-card.json").read_text())
    assert kept["checks"] == [{"what": "a frame", "error": 0.5, "bound": 0.01}]
    cards("NVIDIA GeForce RTX 4070, 590.10.01, 8.9")
    card_verdict(tmp_path, test)
    assert len(calls) == 4 and calls[1] != calls[2]
    (tmp_path / "splannequin-card.json").write_text("[]")  # a damaged file counts as missing
    assert card_verdict(tmp_path, test).problem == "it is broken" and len(calls) == 6


def test_what_may_be_otherwise_the_next_time_is_not_kept(tmp_path: Path):
    def full(key: str) -> SelfTest:
        return SelfTest(key=key, problem="its memory is taken by other programs", lasting=False)

    assert card_verdict(tmp_path, full).problem and not list(tmp_path.iterdir())
    assert card_verdict(tmp_path, lambda key: SelfTest(key=key)).problem == ""
    assert card_verdict(tmp_path, full).problem == "", "it was sound, and is not asked again"


def test_a_failure_that_is_not_confirmed_speaks_against_no_card(tmp_path: Path):
    """The first of two tests fails by a temporary fault: the GPU is used, now and later."""
    answers = ["a kernel does not build or run on it (unspecified launch failure)", ""]
    found = card_verdict(tmp_path, lambda key: SelfTest(key=key, problem=answers.pop(0)))
    assert found.problem == "" and not answers
    assert card_verdict(tmp_path, lambda key: SelfTest(key=key, problem="not asked again")).problem == ""


@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize(("name", "kept"), [("SIGKILL", False), ("SIGTERM", False), ("SIGSEGV", True), ("", False)])
def test_a_test_that_was_killed_is_tried_again_by_the_next_job(tmp_path: Path, monkeypatch, name, kept):
    """A real child process that is killed, or exits with code 1: only a GPU whose test crashes twice is rejected."""
    ends = f"os.kill(os.getpid(), signal.{name})" if name else "sys.exit('there is no disk')"
    child = tmp_path / "child.py"
    child.write_text(f"import os, signal, sys\nopen({str(tmp_path / 'asked')!r}, 'a').write('x')\n{ends}\n")
    monkeypatch.setattr(self_test, "python_child", lambda *_: {"args": [sys.executable, str(child)], "cwd": tmp_path})
    found = card_verdict(tmp_path)
    assert found.problem.startswith("the process that tested it ended with code")
    assert (tmp_path / "splannequin-card.json").is_file() == kept
    calls = len((tmp_path / "asked").read_text())
    assert calls == (2 if kept else 1)
    assert card_verdict(tmp_path, lambda key: SelfTest(key=key)).problem == (found.problem if kept else "")


def test_a_disk_that_is_full_while_kernels_compile_speaks_against_no_card(monkeypatch):
    def full(device):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(self_test, "_frame", full)
    found = run_self_test(torch.device("cpu"))
    assert found.problem.startswith("it could not be tested (") and not found.lasting


def test_a_card_that_does_not_answer_is_waited_for_once(monkeypatch, quiet):
    calls = []
    monkeypatch.setattr(device, "cuda_refusal", lambda: "")

    def silent() -> SelfTest:
        calls.append(1)
        return SelfTest(problem="it did not answer within 240 s")

    monkeypatch.setattr(device, "card_verdict", silent)
    report = quiet()
    assert choose_device("auto", report, "Freezing").type == "cpu" and len(calls) == 1
    ((_, sentence, advice),) = report.events
    assert sentence.startswith("Freezing uses the processor, not the graphics card: ") and "240 s" in sentence
    assert "doctor --gpu" in advice
    assert choose_device("cpu", report, "Freezing").type == "cpu" and len(report.events) == len(calls) == 1


def test_a_card_that_fails_is_not_used_and_said(monkeypatch):
    monkeypatch.setattr(device, "cuda_refusal", lambda: "")
    wrong = "a frame comes out wrong on it (2e-01 off, 1e-02 is allowed)"
    monkeypatch.setattr(device, "card_verdict", lambda: SelfTest(problem=wrong))
    assert choose_device("auto").type == "cpu"
    sentence, advice = device.decide_device("auto")[1]
    assert sentence.startswith("The graphics card failed its self-test: a frame comes out wrong")
    assert "doctor --gpu" in advice
    with pytest.raises(JobError, match="failed its self-test") as refused:
        choose_device("cuda")
    assert "--device cpu" in refused.value.hint
    monkeypatch.setattr(device, "card_verdict", SelfTest)
    assert (
        choose_device("auto").type == choose_device("cuda").type == "cuda" and device.decide_device("auto")[1] is None
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_a_test_in_another_process_comes_back(tmp_path: Path):
    found = self_test.run_in_child("of this key")
    assert found.key == "of this key" and not found.lasting
    assert found.problem == device.cuda_refusal()
    self_test.keep(dataclasses.replace(found, lasting=True), tmp_path, confirmed=True)
    assert self_test._kept(tmp_path / "splannequin-card.json") == dataclasses.replace(found, lasting=True)
