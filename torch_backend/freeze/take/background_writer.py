"""Writes frames in a background thread while the next frame is rendered."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

MAX_BACKGROUND_BYTES = 400_000_000
"""Size above which a frame is written before the next is rendered: two 4K frames would not fit in memory."""


class BackgroundWriter:
    """Context manager that writes frames in order, one at a time; the block ends after the last write.

    At most one frame is written while another is rendered: `write` waits for the previous write. An error of a write is
    raised by the next `write`, by `wait`, or at the end of the block. If the block ends by another error (a cancel
    included), a write in progress is still completed, but its error is dropped.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "frames out")
        self._last: Future[None] | None = None

    def write(self, work: Callable[[], None], size: int) -> None:
        """Runs `work` in the background, or at once if `size` in bytes exceeds `MAX_BACKGROUND_BYTES`."""
        self.wait()
        if size > MAX_BACKGROUND_BYTES:
            work()
        else:
            self._last = self._pool.submit(work)

    def wait(self) -> None:
        """Waits until everything is written. Raises the error of the last write."""
        last, self._last = self._last, None
        if last is not None:
            last.result()

    def __enter__(self) -> BackgroundWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self.wait()
        finally:
            self._pool.shutdown()
