"""Frames are written while the next one is rendered: a thread encodes and compresses what the main one has made."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

HELD_BYTES = 400_000_000
"""Frames larger than this are written before the next is rendered: two of 4K at once would not fit many machines."""


class WriteBeside:
    """Writes frame after frame, in their order, one at a time; a `with` block ends when the last is written.

    At most one frame is being written while another is made: `write` waits for the one before. What a write raises
    comes out of the next `write`, of `wait`, or of the block's end unless that is left by another error, a cancel among
    them: then too what was begun is written to its end.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "frames out")
        self._last: Future[None] | None = None

    def write(self, work: Callable[[], None], size: int) -> None:
        """Has `work` done beside what follows; at once if the frame takes more (`size`) than `HELD_BYTES`."""
        self.wait()
        if size > HELD_BYTES:
            work()
        else:
            self._last = self._pool.submit(work)

    def wait(self) -> None:
        """Until all is written. Raises what the last write raised."""
        last, self._last = self._last, None
        if last is not None:
            last.result()

    def __enter__(self) -> WriteBeside:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self.wait()
        finally:
            self._pool.shutdown()
