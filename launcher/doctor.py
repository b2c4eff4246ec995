"""The command doctor: checks what this machine can do, and advises on what is missing."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch_backend.cards import Card, nvidia_cards, why_unfit, why_unused
from torch_backend.contract import ExitCode, memory, python_child
from torch_backend.shot import write_json

from .blender import BPY_WHEELS, DEMO_WHEELS, choose_wheels, find_blender
from .children import child_environ, say
from .environments import (
    BPY_DISK_GB,
    Environment,
    backend_environment,
    bpy_environment,
    disk_gb,
    home,
    this_machines_index,
)
from .places import LINUX

BLENDER_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libXxf86vm.so.1": "libxxf86vm1",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libGL.so.1": "libgl1",
}
"""Libraries that Blender loads on Linux and that a server may lack: file name and Debian package."""


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's output."""

    what: str
    """Name of the checked item."""
    state: str
    """ok, note (the demo works without it) or missing (the demo needs it)."""
    text: str
    """Result of the check and advice."""


def doctor(output: Path, gpu: bool = False) -> int:
    """Prints what this machine can do and advice on what is missing; returns 9 if the demo cannot run, else 0.

    With `gpu` the card is tested again, and the results are written to gpu.json in `output`.
    """
    backend = backend_environment()
    facts: dict[str, Any] = backend_facts(backend, gpu) if backend.ready() else {}
    findings = [*machine_findings(), *gpu_findings(facts), *backend_findings(backend, facts), *blender_findings()]
    if gpu:
        findings.append(self_test_finding(facts, output))
    for finding in findings:
        say(f"{finding.state:<8} {finding.what:<16} {finding.text}")
    missing = [f for f in findings if f.state == "missing"]
    code = ExitCode.ENVIRONMENT if missing else 0
    lines = {f.what: {"state": f.state, "text": f.text} for f in findings}
    write_json(output / "summary.json", {"command": "doctor", "exit_code": code, "findings": lines, "backend": facts})
    say(f"{len(missing)} thing(s) missing." if missing else "This machine can run the demo.")
    return code


def machine_findings() -> Iterator[Finding]:
    """Findings on Python, system, cores, memory and disk."""
    version = platform.python_version()
    wheels = [s for s in DEMO_WHEELS if BPY_WHEELS[s] == sys.version_info[:2]]
    fits = f"fits bpy {' and '.join(wheels)}" if wheels else "fits no bpy wheel (they need 3.11 or 3.13)"
    yield Finding("python", "ok", f"{version} at {sys.executable}; {fits}")
    if sys.maxsize < 2**32:
        yield Finding("64 bit", "missing", "this Python is 32-bit: install a 64-bit one")
    cores = os.cpu_count() or 1
    yield Finding("cores", "ok" if cores > 1 else "note", f"{cores} on {platform.platform(terse=True)}")
    if (known := memory()) is not None:
        total = known[0] / 1e9
        is_enough = total >= 6
        yield Finding(
            "memory", "ok" if is_enough else "note", f"{total:.1f} GB{'' if is_enough else ': close other programs'}"
        )
    folder = next(p for p in (home(), *home().parents) if os.path.exists(p))
    if not backend_environment().ready() and not (folder.is_dir() and os.access(folder, os.W_OK)):
        yield Finding("home", "missing", f"{folder} cannot be written: set SPLANNEQUIN_HOME to another folder")
    free = shutil.disk_usage(folder).free / 1e9
    backend = backend_environment()
    need = 1.0 if backend.ready() else disk_gb(backend, this_machines_index()) + BPY_DISK_GB
    advice = "" if free >= need else f": {need:.0f} GB are needed, free some or set SPLANNEQUIN_HOME to another disk"
    yield Finding("disk", "ok" if free >= need else "missing", f"{free:.0f} GB free in {folder}{advice}")


def gpu_findings(facts: dict[str, Any]) -> Iterator[Finding]:
    """Findings on NVIDIA cards: whether driver and card fit the pinned Warp and torch, and whether they are used."""
    cards, trouble = nvidia_cards()
    if trouble:
        advice = "restart the machine; if that does not help, reinstall the driver"
        yield Finding("gpu", "note", f"the NVIDIA driver does not answer: {trouble}: {advice}")
    elif not cards:
        yield Finding("gpu", "note", "no NVIDIA card or driver: the CPU is used, nothing is missing")
    yield from map(gpu_finding, cards)
    if any(card.fits for card in cards) and facts.get("trains_on") == "cpu":
        unseen = None if facts.get("torch_device") == "cuda" else why_unused(facts.get("torch_cuda"))
        reason = " ".join(unseen) if unseen else facts.get("cuda_refusal") or "CUDA_VISIBLE_DEVICES hides the card"
        yield Finding("torch on gpu", "note", reason)


def self_test_finding(facts: dict[str, Any], output: Path) -> Finding:
    """Result of the card's self-test, whose details are written to gpu.json for a bug report."""
    if "gpu" not in facts:
        reason = facts.get("error") or "the backend is not set up: run `python3 splannequin.py setup`"
        return Finding("self-test", "note", f"not run: {reason}")
    place = output / "gpu.json"
    write_json(place, facts)
    test = facts["gpu"]["test"]
    ended = f"failed: {test['problem']}" if test["problem"] else f"{len(test['checks'])} checks, no problems"
    return Finding("self-test", "note" if test["problem"] else "ok", f"{ended}; the report to send is {place}")


def gpu_finding(card: Card) -> Finding:
    """Finding on one card: whether it fits Warp and torch."""
    unfit = why_unfit(card)
    if unfit is not None:
        return Finding("gpu", "note", " ".join(unfit).strip())
    return Finding("gpu", "ok", f"{card.name}, driver {card.driver}, compute capability {card.compute or 'unknown'}")


def backend_facts(backend: Environment, gpu: bool = False) -> dict[str, Any]:
    """Facts that the backend reports about its environment; with `gpu` it tests the card."""
    command = python_child(backend.python, "torch_backend", "doctor", *(["--gpu"] if gpu else []))
    ran = subprocess.run(
        **command, capture_output=True, text=True, encoding="utf-8", errors="replace", env=child_environ()
    )  # `child_environ` sets the child's output to UTF-8
    try:
        return json.loads(ran.stdout[ran.stdout.index("{") :])
    except ValueError:
        return {"error": (ran.stderr.strip().splitlines() or ["no answer"])[-1]}


def backend_findings(backend: Environment, facts: dict[str, Any]) -> Iterator[Finding]:
    """Findings on the backend: its environment, torch's device and the video encoder."""
    if not facts:
        begun = "not finished" if backend.folder.is_dir() else "not created yet"
        yield Finding(
            "backend", "note", f"{begun}: run `python3 splannequin.py setup` to create it in {backend.folder}"
        )
        return
    if "error" in facts:
        yield Finding("backend", "missing", f"{facts['error']}: remove {backend.folder} and run setup again")
        return
    packages = facts["packages"]
    yield Finding("backend", "ok", f"{backend.folder}, Python {facts['python']}, warp {packages['warp-lang']}")
    device = facts.get("cuda_device") or facts["torch_device"]
    yield Finding("torch", "ok", f"{packages['torch']} sees {device}; training uses the {facts['trains_on']}")
    h264 = facts["h264"]
    yield Finding("H.264", "ok" if h264 else "note", "libx264" if h264 else "no encoder in PyAV: reinstall .venv")


def opens(library: str) -> bool:
    """True if the system can load this shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def blender_findings() -> Iterator[Finding]:
    """Findings on bpy wheels and the libraries that they load, and on a Blender on the PATH."""
    found = find_blender()
    packages = [package for name, package in BLENDER_LIBRARIES.items() if not opens(name)] if LINUX else []
    if packages:
        advice = f"install them (Debian and Ubuntu: apt install {' '.join(packages)})"
        state = "note" if found else "missing"
        yield Finding("libraries", state, f"a bpy wheel needs libraries that are missing: {advice}")
    ready = [s for s in BPY_WHEELS if bpy_environment(s).ready()]
    if ready:
        yield Finding("bpy", "ok", f"wheel(s) {', '.join(ready)} set up")
    wheels = [] if ready else choose_wheels()
    if wheels:
        yield Finding("bpy", "note", f"not created yet: `python3 splannequin.py setup` installs bpy {wheels[0][0]}")
    if found:
        yield Finding("blender", "ok", f"{found[1]} at {found[0]}")
    elif ready or wheels:
        yield Finding("blender", "note", "none on the PATH; the bpy wheel is used")
    else:
        advice = "install Blender 4.2 or newer and put it on the PATH, or use Python 3.11 or 3.13"
        yield Finding("blender", "missing", f"no bpy wheel fits and no `blender` is on the PATH: {advice}")
