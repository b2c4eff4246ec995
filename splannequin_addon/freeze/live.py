"""Blender's end of a live session of the backend: requests views and receives frames. No bpy.

The child process draws (torch_backend/live.py). Two threads transfer the bytes, so that the main thread never waits for
a pipe.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ...torch_backend import contract
from ..process import children

# Time that a closed child has to end before it is killed.
_PATIENCE_SECONDS = 10.0


@dataclass
class Frame:
    """A rendered view of the frozen instant."""

    request: contract.LiveView
    """The request that this frame answers."""
    t_star: int
    """Frame number at which time stands still: the requested one, or the nearest trained one."""
    rgba: np.ndarray
    """[H, W, 4] float32, premultiplied, display-referred, first row on top."""
    depth: np.ndarray
    """[H, W] float32, along the camera's axis in solve units."""


@dataclass
class Session:
    """A child process that draws one run of one shot. Created by `open_session`."""

    shot: Path
    """Shot folder."""
    run: str
    """Name of the run."""
    facts: dict[str, Any] = field(default_factory=dict[str, Any])
    """The child's `ready` message (torch_backend/live.py); empty while the child loads."""
    frames: dict[int, Frame] = field(default_factory=dict[int, Frame])
    """View number -> its newest frame."""
    failure: tuple[str, str] | None = None
    """(sentence, hint) about the error that ended the session, or None."""
    drawn: int = 0
    """Number of frames received."""
    _process: subprocess.Popen[bytes] | None = None
    _requests: dict[int, contract.LiveView] = field(default_factory=dict[int, contract.LiveView])
    _to_send: dict[int, contract.LiveView] = field(default_factory=dict[int, contract.LiveView])
    _sent: dict[int, contract.LiveView] = field(default_factory=dict[int, contract.LiveView])
    _change: threading.Condition = field(default_factory=threading.Condition)
    _closed: bool = False
    _seq: int = 0

    @property
    def open(self) -> bool:
        """True while the session draws, or is about to."""
        return not self._closed and self.failure is None

    def begin(self, process: subprocess.Popen[bytes], log: Path) -> None:
        """Starts the threads that talk to the child. The child's messages about its end are in the file `log`."""
        self._process = process
        # Blender's data is not thread-safe: these threads access only this module's plain data.
        threading.Thread(target=self._send, name="splannequin live out", daemon=True).start()
        threading.Thread(target=self._read, args=(log,), name="splannequin live in", daemon=True).start()

    def ask(self, view: contract.LiveView) -> None:
        """Requests a view without waiting, and sets its `seq`. A newer request replaces an older one for the same
        view."""
        with self._change:
            self._seq += 1
            view.seq = self._seq
            self._requests[view.view] = self._to_send[view.view] = self._sent[view.seq] = view
            self._change.notify()

    def wanted(self, view: int) -> contract.LiveView | None:
        """The last request for a view, or None."""
        return self._requests.get(view)

    def busy(self, view: int) -> bool:
        """True while the last request for a view has no answer."""
        with self._change:
            return any(request.view == view for request in self._sent.values())

    def instants(self) -> set[int]:
        """Frame numbers at which time stands still in the newest frames."""
        with self._change:  # the reader thread adds frames
            return {frame.t_star for frame in self.frames.values()}

    def close(self) -> None:
        """Ends the child and returns at once. The child exits, and frees its memory, when it sees the end of its
        input."""
        with self._change:
            self._closed = True
            self._change.notify()

    def _send(self) -> None:
        process = self._process
        if process is None or process.stdin is None:
            return
        requests = cast("BinaryIO", process.stdin)
        try:
            while True:
                with self._change:
                    self._change.wait_for(lambda: self._closed or self._to_send or self.failure)
                    if self._closed or self.failure:
                        break
                    views, self._to_send = list(self._to_send.values()), {}
                for view in views:
                    contract.write_message(requests, {"kind": "view", **dataclasses.asdict(view)})
        except (OSError, ValueError):
            pass  # the reader sees the end of the child's output and reports the cause
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(_PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()

    def _read(self, log: Path) -> None:
        process = self._process
        if process is None or process.stdout is None:
            return
        answers = cast("BinaryIO", process.stdout)
        try:
            while (message := contract.read_message(answers)) is not None:
                self._take_in(*message)
        except (OSError, ValueError, KeyError, TypeError) as error:
            self._fail(f"The live session stopped unexpectedly: {error}.", f"Start it again. Its log is {log}.")
        process.stdout.close()
        code = process.wait()
        if not self._closed and self.failure is None:
            words = last_line(log)
            log_line = f" Last line of its log: {words}" if words else ""
            self._fail(f"The live session ended unexpectedly (exit code {code}).{log_line}", "Start it again.")

    def _take_in(self, header: dict[str, Any], body: bytes) -> None:
        if header["kind"] == "ready":
            self.facts = header
        elif header["kind"] == "error" and "seq" not in header:
            self._fail(header["message"], header["hint"])
        elif header["kind"] == "error":
            self._answered(header["seq"])  # this view cannot be drawn, but the next one may
        elif header["kind"] == "frame":
            request = self._answered(header["seq"])
            w, h = header["width"], header["height"]
            values = np.frombuffer(body, np.float32)
            rgba, depth = values[: 4 * w * h].reshape(h, w, 4), values[4 * w * h :].reshape(h, w)
            with self._change:
                self.frames[request.view] = Frame(request, header["t_star"], rgba, depth)
            self.drawn += 1

    def _answered(self, seq: int) -> contract.LiveView:
        """The answered request. Removes it, and older requests for the same view, from the waiting ones."""
        with self._change:
            request = self._sent.pop(seq)
            for older in [s for s, v in self._sent.items() if v.view == request.view and s < seq]:
                del self._sent[older]
        return request

    def _fail(self, message: str, hint: str) -> None:
        with self._change:
            self.failure = (message, hint)
            self._change.notify()


def open_session(shot: Path, run: str, python: str, package_root: Path) -> Session:
    """Starts a child for a run of a shot. Raises JobError if its Python cannot be started, or if the log's folder is a
    link.

    Args:
        python: interpreter of the backend's environment.
        package_root: folder that contains `torch_backend`.
    """
    session = Session(shot, run)
    log = contract.ShotFolder(shot).live_log
    contract.ShotFolder(shot).own(log.parent)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        if contract.is_link(log):  # otherwise the target of the link would be emptied
            contract.remove_link(log)
        with open(log, "wb") as errors:
            placed = contract.python_child(python, "torch_backend", "live", str(shot.absolute()), "--run", run)
            piped: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors}
            child = children.start(placed, package_root, outlives=False, **piped)
    except OSError as error:
        raise contract.JobError(
            f"The live session could not be started: {error.strerror or error}.",
            "Check the backend's Python in the add-on's preferences.",
            contract.ExitCode.ENVIRONMENT,
        ) from error
    session.begin(child, log)
    return session


def last_line(log: Path) -> str:
    """Last non-empty line of a session's log, at most 200 characters."""
    try:
        with contract.open_regular(log) as source:
            source.seek(max(0, os.fstat(source.fileno()).st_size - contract.LONGEST_LINE))
            text = source.read(contract.LONGEST_LINE).decode("utf-8", "replace")
        lines = [line for line in text.splitlines() if line.strip()]
    except (OSError, ValueError):
        return ""
    return lines[-1].strip()[:200] if lines else ""
