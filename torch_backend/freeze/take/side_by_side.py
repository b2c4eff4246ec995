"""Renders the frames of a take in several processes where cores and memory allow it.

One process uses only about two cores, because the decisions about a frame run in one thread. Each process
renders consecutive frames, which share source plates. Frames that a process does not finish, because it was killed or
could not start, are rendered by the process that started it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Generator, Set
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch
from torch import Tensor

from ...contract import (
    FreezeParams,
    JobError,
    Reporter,
    child_environment,
    memory,
    python_child,
    read_message,
    write_message,
)
from ...native import cores
from ...shot import Shot
from ..frozen import OutputFrame
from .folder import current_frames, stored_key
from .frames import make_ready, render_frames
from .plan import PlannedTake

THREADS = 2
"""Number of threads per process."""
_FEWEST = 12
"""Smallest number of frames per process: starting takes about 5 s, as long as 12 frames of 640 x 480."""
_BYTES, _BYTES_A_PIXEL = 1.7e9, 130
"""Memory per process, fixed and per pixel: `python -m benchmarks.detail_cost` peaks at 1.6 GB at 640 x 360 and 2.5 GB
at 3840 x 2160."""
_POLL_SECONDS = 0.2

Message = tuple[dict[str, Any], bytes] | None
"""Header and body of a process's message; None at the end of its output."""


def processes_for(frames: int, pixels: int, core_count: int, free_bytes: float) -> int:
    """Number of processes to render `frames` frames of `pixels` pixels each, at least 1."""
    return max(1, min(core_count // THREADS, frames // _FEWEST, int(free_bytes / (_BYTES + _BYTES_A_PIXEL * pixels))))


def render_side_by_side(
    shot: Shot, params: FreezeParams, take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter,
    processes: int | None = None,
) -> dict[int, Tensor]:  # fmt: skip
    """Like `render_frames`, in several processes.

    `processes` None: as many as `processes_for` allows. This process renders alone if the run is on a GPU, or if its
    developed instants are not stored where other processes can read them.
    """
    make_ready(take, frames, done, report)
    missing = [output.frame for output in frames if output.frame not in done]
    spec = take.spec
    if processes is None:
        free_bytes = (memory() or (0.0, 0.0))[1]
        processes = processes_for(len(missing), spec.whole[0] * spec.whole[1], cores(), free_bytes)
    is_stored = all(spec.instants.is_stored(t) for t in spec.instants.keys)
    if processes < 2 or not is_stored or spec.run.stale or spec.run.model.gaussians.open.is_cuda:
        return render_frames(take, frames, done, report)
    parts = [missing[len(missing) * n // processes : len(missing) * (n + 1) // processes] for n in range(processes)]
    request = {
        "shot": str(shot.root.absolute()), "folder": str(take.folder.root.absolute()), "t_star": take.t_star,
        "keys": take.all_keys,
        "params": dataclasses.asdict(params) | {
            name: os.path.abspath(path)
            for name in ("camera_path", "placement", "debug_terms") if (path := getattr(params, name))
        },
    }  # fmt: skip
    shares: dict[int, Tensor] = {}
    with _started([{**request, "frames": part} for part in parts]) as messages:
        _listen(messages, len(parts), len(missing), shares, report)
    failed = [n for n in missing if n not in shares]
    current = current_frames(take, {n: stored_key(take.folder, n, spec) for n in failed})
    remaining = [output for output in frames if output.frame in failed and output.frame not in current]
    return shares | (render_frames(take, remaining, set(), report) if remaining else {})


def _listen(
    messages: queue.SimpleQueue[tuple[int, Message]], running: int, total: int, shares: dict[int, Tensor],
    report: Reporter,
) -> None:  # fmt: skip
    """Waits until `running` processes have ended. Fills `shares`, reports progress, raises any JobError received."""
    done = dict.fromkeys(range(running), 0)
    while running:
        report.check_cancelled()
        try:
            n, message = messages.get(timeout=_POLL_SECONDS)
        except queue.Empty:
            continue
        if message is None:
            running -= 1
            continue
        header, body = message
        if header["kind"] == "error":
            raise JobError(header["message"], header["hint"], header["exit_code"])
        if header["kind"] == "share":
            share = torch.frombuffer(bytearray(body), dtype=torch.float32).reshape(header["size"])
            shares[int(header["frame"])] = share
        else:
            done[n] = int(header["done"])
            report.progress("freezing", sum(done.values()), total, header["message"])


@contextlib.contextmanager
def _started(requests: list[dict[str, Any]]) -> Generator[queue.SimpleQueue[tuple[int, Message]]]:
    """Starts a process of `frame_process.py` for each request, and yields the queue of their messages. At the end of
    the block, all processes are killed."""
    root = Path(__file__).resolve().parents[3]
    environment = child_environment(root) | {"OMP_NUM_THREADS": str(THREADS), "OPENCV_FOR_THREADS_NUM": str(THREADS)}
    messages: queue.SimpleQueue[tuple[int, Message]] = queue.SimpleQueue()
    running: list[subprocess.Popen[bytes]] = []

    def read(n: int, process: subprocess.Popen[bytes]) -> None:
        answers = cast("BinaryIO", process.stdout)
        with contextlib.suppress(ValueError, OSError):  # incomplete message: the process was killed
            while (message := read_message(answers)) is not None:
                messages.put((n, message))
        messages.put((n, None))

    try:
        for n, request in enumerate(requests):
            command = python_child(sys.executable, "torch_backend.freeze.take.frame_process")
            process = subprocess.Popen(
                command["args"], cwd=command["cwd"], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            running.append(process)
            with contextlib.suppress(OSError):  # the process has already ended
                write_message(cast("BinaryIO", process.stdin), request)
            threading.Thread(target=read, args=(n, process), name="frames out", daemon=True).start()
        yield messages
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
            process.wait()
            if process.stdin is not None:
                with contextlib.suppress(OSError):
                    process.stdin.close()
