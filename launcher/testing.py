"""The command test: runs ruff, pyright, the backend's tests, and the add-on's tests in a bpy wheel."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from torch_backend.shot import write_json

from .blender import get_blender, set_up_wheel
from .children import child_environ, close_input, exit_code_of, say, start_child, stop_children, wait_for_any
from .environments import backend_environment, set_up
from .errors import LauncherError
from .places import ROOT

PARALLEL_LEGS = 2
"""Largest number of legs that run in parallel, if there are as many cores. More legs would slow each other down: a test
uses little more than one core."""
NEWS_SECONDS = 60.0
"""Interval in seconds of progress lines while legs run in parallel, whose output is shown when they end."""


SECOND_HALF = (
    *(f"tests/backend/{name}" for name in ("cameras", "lens", "sfm", "motion", "raster", "footage", "card")),
    "tests/faults",
)
"""Folders with half of the backend's tests by duration: a separate leg in parallel to the other half. None of them
needs the run that the other half trains once."""
OLDER_INSTRUCTIONS = {
    "ATEN_CPU_CAPABILITY": "default",
    "SPLANNEQUIN_MARCH": "x86-64-v3",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENCV_CPU_DISABLE": "AVX2,AVX512-SKX",
}
"""Environment variables that make torch, our kernels, numpy and OpenCV compute as on an older x86 processor, which
changes floats by about 1e-7. On other processors only torch's variable has an effect."""
SENSITIVE = (
    "tests/backend/freeze/views", "tests/backend/freeze/composite/test_compositor.py",
    "tests/backend/freeze/composite/test_honest.py", "tests/backend/freeze/composite/test_overscan.py",
    "tests/backend/freeze/composite/test_state.py", "tests/backend/raster",
)  # fmt: skip
"""Tests of `test --instructions`: of code whose decisions depend on floats, and of the kernels."""
ADDON_TESTS = ("tests/addon", "tests/addon_free")
"""Tests that run in Blender. Those in tests/addon_free do not need it, so the backend's leg runs them too."""


class Leg:
    """One part of the tests: its command and its result."""

    def __init__(
        self, name: str, command: list[str], report: Path | None = None, environ: dict[str, str] | None = None
    ) -> None:
        self.name = name
        self.environ = environ or {}
        """Additional environment variables."""
        self.command = command if report is None else [*command, f"--junitxml={report}"]
        self.report = report
        """pytest's XML report with the counts; None for a checker."""
        self.passed = self.failed = self.skipped = 0
        self.seconds = 0.0

    def run(self, backend_python: str) -> None:
        """Runs the leg with this process's output, then counts: tests from pytest's report, a checker as one test."""
        run_legs([self], backend_python, None)

    def start(self, backend_python: str, log: Path | None, **environ: str) -> subprocess.Popen[bytes]:
        """Starts the leg's process; its output goes to `log`, or to this process's output if `log` is None."""
        if self.report:
            self.report.unlink(missing_ok=True)
        environ = child_environ(SPLANNEQUIN_BACKEND_PYTHON=backend_python, **environ, **self.environ)
        if log is None:
            return start_child(self.command, environ, cwd=ROOT)
        with open(log, "wb") as stream:
            return start_child(self.command, environ, cwd=ROOT, stdout=stream, stderr=subprocess.STDOUT)

    def ended(self, code: int, seconds: float) -> None:
        """Counts the results and prints them."""
        self.seconds = seconds
        if self.report is None:
            self.passed, self.failed = int(code == 0), int(code != 0)
        else:
            self._count(self.report)
            picked = any(word.startswith("-k") for word in self.command)
            if code and not (code == 5 and picked) and not self.failed:  # 5: pytest ran no test
                self.failed = 1
        say(f"=== {self.name}: {self.passed} passed, {self.failed} failed, {self.seconds:.0f} s")

    def _count(self, report: Path) -> None:
        try:
            suites = ElementTree.parse(report).getroot().iter("testsuite")  # noqa: S314  (pytest's own, just written)
        except (OSError, ElementTree.ParseError):
            self.failed = 1
            return
        for suite in suites:
            failed = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
            skipped = int(suite.get("skipped", 0))
            self.passed += int(suite.get("tests", 0)) - failed - skipped
            self.failed += failed
            self.skipped += skipped


def run_legs(legs: Sequence[Leg], backend_python: str, logs: Path | None, parallel: int = 1) -> None:
    """Runs legs in order, up to `parallel` in parallel. On Ctrl-C all are stopped, and KeyboardInterrupt is raised.

    Args:
        legs: each receives its result.
        backend_python: the backend's interpreter, for the add-on's tests.
        logs: folder for the output of parallel legs, one file each, printed when the leg ends. A single leg prints
            directly.
        at_once: largest number of parallel legs, each of which uses its share of the cores.
    """
    waiting = list(legs)
    together = logs is not None and parallel > 1 and len(legs) > 1
    share = {"OMP_NUM_THREADS": str(max(1, cores() // parallel))} if together else {}
    running: dict[subprocess.Popen[bytes], tuple[Leg, Path | None, float]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < (parallel if together else 1):
                leg = waiting.pop(0)
                log = logs / f"{re.sub(r'[^a-z0-9.]+', '-', leg.name.lower())}.log" if together and logs else None
                say(
                    f"\n=== {leg.name}"
                    + (f" (runs in parallel; its output follows when it ends: {log})" if log else "")
                )
                running[leg.start(backend_python, log, **share)] = (leg, log, time.monotonic())
            child = wait_for_any(list(running), NEWS_SECONDS)
            if child is None:
                if together:
                    say("  " + ", ".join(f"{leg.name} {progress(log)}" for leg, log, _ in running.values()))
                continue
            leg, log, since = running.pop(child)
            close_input(child)
            if log is not None:
                say(f"\n=== {leg.name}: what it printed\n{log.read_text(encoding='utf-8', errors='replace')}")
            leg.ended(exit_code_of(child.returncode), time.monotonic() - since)
    except KeyboardInterrupt:
        say("\nCancelling; Ctrl-C again stops at once.")
        raise KeyboardInterrupt("the children have said so") from None
    finally:
        stop_children(list(running))


def progress(log: Path | None) -> str:
    """Progress of a leg from its log: pytest's last "[ 34%]"."""
    shares = re.findall(r"\[ *(\d+%)\]", log.read_text(encoding="utf-8", errors="replace")) if log else []
    return shares[-1] if shares else "running"


def cores() -> int:
    """Number of cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def run_tests(pytest_args: Sequence[str], series: Sequence[str], output: Path) -> int:
    """Runs ruff, pyright, the backend's tests and the add-on's in a bpy wheel; the last line is `N passed, N failed`.

    Args:
        pytest_args: arguments for pytest; paths among them select tests.
        series: bpy wheels for the add-on's tests; then only these tests run. Empty: all tests, in a wheel that fits.
        output: folder for summary, reports and logs.
    """
    paths = [a for a in pytest_args if not a.startswith("-") and (ROOT / a.split("::")[0]).exists()]
    extra = [a for a in pytest_args if a not in paths]
    if not paths:
        paths = [*ADDON_TESTS] if series else ["tests", *ADDON_TESTS]
    addon_paths = [p for p in paths if Path(p).as_posix().startswith("tests/addon")]
    backend_paths = [p for p in paths if p not in addon_paths]
    backend = backend_environment(testing=True)
    set_up(backend, sys.executable)
    legs: list[Leg] = []
    pytest = [backend.python, "-P", "-m", "pytest"]
    half = SECOND_HALF if not pytest_args and not series else ()
    if half:  # the longest leg first, so that no core is idle at the end
        legs.append(Leg("backend, one half", [*pytest, *half], output / "junit-backend-half.xml"))
    if backend_paths:
        ignored = [f"--ignore={path}" for path in ("tests/addon", *half)]
        legs.append(Leg("backend", [*pytest, *ignored, *backend_paths, *extra], output / "junit-backend.xml"))
    if addon_paths:
        blenders = [set_up_wheel(one, True)[0] for one in series] or [get_blender(testing=True)[0]]
        for blender in blenders:
            if not blender.is_wheel:
                raise LauncherError("The add-on's tests need a bpy wheel: use Python 3.11 or 3.13.")
            command = [*blender.command, "-P", "-m", "pytest", *addon_paths, *extra]
            report = output / f"junit-{blender.label.replace(' ', '-')}.xml"
            legs.append(Leg(f"add-on in {blender.label}", command, report))
    if not pytest_args and not series:
        legs += checkers(backend.python)
    output.mkdir(parents=True, exist_ok=True)
    run_legs(legs, backend.python, output, min(PARALLEL_LEGS, cores()))
    return _close_tests(legs, output)


def run_sensitive_tests(pytest_args: Sequence[str], output: Path) -> int:
    """Runs the tests of `SENSITIVE` with an older instruction set than this processor's; output as `run_tests`."""
    backend = backend_environment(testing=True)
    set_up(backend, sys.executable)
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    environ = {name: value for name, value in OLDER_INSTRUCTIONS.items() if x86 or name == "ATEN_CPU_CAPABILITY"}
    legs: list[Leg] = []
    for name in ("raster", "freeze"):
        paths = [path for path in SENSITIVE if path.startswith(f"tests/backend/{name}")]
        command = [backend.python, "-P", "-m", "pytest", *paths, *pytest_args]
        legs.append(Leg(f"{name}, other instructions", command, output / f"junit-{name}.xml", environ))
    output.mkdir(parents=True, exist_ok=True)
    run_legs(legs, backend.python, output, min(PARALLEL_LEGS, cores()))
    return _close_tests(legs, output)


def checkers(python: str) -> list[Leg]:
    """Legs of ruff and pyright from the environment of `python`."""
    project = ["--project", str(ROOT), "--pythonpath", python]
    return [
        Leg("ruff", [python, "-P", "-m", "ruff", "check", str(ROOT)]),
        Leg("ruff format", [python, "-P", "-m", "ruff", "format", "--check", str(ROOT)]),
        Leg("pyright", [python, "-P", "-m", "pyright", *project]),
    ]


def _close_tests(legs: Sequence[Leg], output: Path) -> int:
    passed, failed = sum(leg.passed for leg in legs), sum(leg.failed for leg in legs)
    code = 1 if failed or not passed else 0
    summary = {
        "command": "test",
        "exit_code": code,
        "passed": passed,
        "failed": failed,
        "skipped": sum(leg.skipped for leg in legs),
        "wall_seconds_by_stage": {leg.name: round(leg.seconds, 2) for leg in legs},
    }
    write_json(output / "summary.json", summary)
    for leg in legs:
        if leg.failed:
            say(f"failed: {leg.name}")
    say(f"{passed} passed, {failed} failed")
    return code
