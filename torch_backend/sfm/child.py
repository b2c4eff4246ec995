"""Runs the COLMAP worker as a child process: reads its progress, cancels it, and reports its log's end if it dies."""

from __future__ import annotations

import json
import queue
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from ..contract import ExitCode, JobError, Reporter, child_environment, incomplete, python_child
from ..shot import need_disk

_POLL_SECONDS = 0.2
_LAST_LINES = 3
_FULL_BYTES = 16 << 20
# Lines of COLMAP's log that count images and blocks of pairs. (Reading progress from COLMAP's database instead is not
# safe: a second copy of SQLite in one process breaks the locks of the first copy.)
_COUNT = re.compile(rb"Process(?:ed|ing) \w+ \[(\d+)/(\d+)\]")


def run_worker(request: Path, log: Path, report: Reporter, keep_log: bool = False) -> dict[str, Any]:
    """Runs `worker.py` on a request file and returns its last message ({"result"} or {"failure"}).

    The worker is killed on cancellation and on any other exception in this function. COLMAP's output is written to
    `log`; with `keep_log` it is appended.

    Raises JobError with the end of COLMAP's log if the worker dies: ENVIRONMENT if a package cannot be loaded, DISK if
    the disk is full, else SOLVE.
    """
    environment = child_environment(Path(__file__).resolve().parents[2])
    command = python_child(sys.executable, "torch_backend.sfm.start_worker", str(request.absolute()))
    with open(log, "ab" if keep_log else "wb") as errors:
        start = errors.tell()
        process = subprocess.Popen(
            command["args"],
            cwd=command["cwd"],
            stdin=subprocess.PIPE,  # the worker exits when it closes
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
        )
        try:
            answer = _listen(process, log, start, report)
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe:
                    pipe.close()
    if answer is not None and "lacks" in answer:
        raise incomplete(answer["lacks"])
    if answer is None or code != 0:
        report.check_cancelled()  # the launcher cancels by Ctrl-Break on Windows, which also reaches COLMAP
        need_disk(log.parent, _FULL_BYTES, "The camera solve")
        raise JobError(
            f"The camera solve failed (COLMAP ended with code {code}): {_tail(log, start)}",
            "Try again with a shorter range or a smaller working height. If that does not help, please report it "
            f"with {log}.",
            ExitCode.SOLVE,
        )
    return answer


def _listen(process: subprocess.Popen[bytes], log: Path, start: int, report: Reporter) -> dict[str, Any] | None:
    lines: queue.Queue[bytes | None] = queue.Queue()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, name="solve output", daemon=True).start()
    answer, stage = None, "start"
    with open(log, "rb") as tail:
        tail.seek(start)
        while True:
            report.check_cancelled()
            try:
                line = lines.get(timeout=_POLL_SECONDS)
            except queue.Empty:
                line = b""
            if line is None:
                return answer
            counts = _COUNT.findall(tail.read())
            if counts:
                _report(report, stage, int(counts[-1][0]), int(counts[-1][1]))
            if not line.startswith(b"{"):
                continue
            message = json.loads(line)
            if "stage" in message:
                stage = message["stage"]
                _report(report, stage, message.get("done", 0), message.get("total", 1))
            else:
                answer = message


def _report(report: Reporter, stage: str, done: int, total: int) -> None:
    report.progress(f"solve: {stage}", done, total, f"{done} of {total}" if done else "")


def _tail(log: Path, start: int) -> str:
    text = log.read_bytes()[start:].decode("utf-8", errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith(("F2", "E2")) or "Error" in line] or lines
    return " ".join(errors[-_LAST_LINES:]) or "it left no message."
