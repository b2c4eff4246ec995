"""Records training steps on a GPU as CUDA graphs, and replays them with other inputs.

A step of a small run consists of a few hundred kernels of microseconds; the CPU takes six times as long to launch them
as the GPU to run them (docs/benchmarks.md, "GPU"). Between two events of a run (growth, the gate, a repair), all steps
of one kind run the same operations on tensors at the same addresses. From the second step on they are replayed.

Launched and replayed steps run the same code, `Trainer.carry_out`. A step is launched

- if its kind has not been seen, so that first uses compile and allocate outside of a recording;
- if it reads values back from the GPU;
- if little GPU memory is free, since a recording holds as much memory as a step;
- for some steps after a skipped step, so that the gradients of a failing step can be inspected.
"""

from __future__ import annotations

import contextlib
import gc
import weakref
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from ..native import warp_stream
from ..raster.hit_lists import listed, outgrown, report_demands
from .adam import FusedAdam, StepTable
from .memory import free_bytes
from .soundness import INSPECT_EVERY, Soundness
from .step_facts import StepFacts, StepKind

refused = ""
"""Why the self-test forbids recorded steps (set by `device`, for the whole process); empty if they are allowed."""
_SPARE = 1.5
"""Free memory that a recording needs, as a multiple of a step's peak memory."""
# Number of recordings that may run out of memory before recording is switched off.
_TRIES = 4


class RecordedRun(Protocol):
    """A run whose steps are recorded; `Trainer` implements it."""

    soundness: Soundness
    """Record of failed steps and repairs."""
    optimizer: FusedAdam
    """Optimiser of all trained parameters."""
    width: int
    """Width of the images in pixels."""
    height: int
    """Height of the images in pixels."""

    def carry_out(self, kind: StepKind, facts: StepFacts, frame: int) -> Tensor:
        """Runs one step and returns its photometric loss (0-dim)."""
        ...

    def layout(self) -> tuple[object, ...]:
        """The objects that steps read and write. While they are unchanged, recorded steps stay valid."""
        ...


class Recording(Protocol):
    """Method of recording work on a device."""

    def watched(self) -> contextlib.AbstractContextManager[None]:
        """Context that measures the peak memory of the work in it."""
        ...

    def fits(self) -> bool:
        """True if there is enough memory to record the measured work."""
        ...

    def record(self, work: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """Records `work` without carrying it out. Returns (function that replays it, tensor that then receives its
        result)."""
        ...

    def drop(self) -> None:
        """Frees the memory of recordings that were dropped."""
        ...


@dataclass
class _Recorded:
    facts: StepFacts
    """Tensors from which the step reads its inputs."""
    table: StepTable
    """Table from which the optimiser reads its inputs."""
    replay: Callable[[], None]
    loss: Tensor
    listed: int
    """Number of hits for which the rasteriser allocated memory."""


class Recorder:
    """Runs the steps of a run, and replays recordings where possible."""

    def __init__(self, run: RecordedRun, device: torch.device, recording: Recording | None = None) -> None:
        """`recording`: recording method (default: CUDA graphs)."""
        # Weak, because the run refers to this recorder: a cycle would keep a finished run's GPU memory until the next
        # garbage collection.
        self.run: RecordedRun = weakref.proxy(run)
        self.device = device
        self.recording = recording or CudaGraphs(device)
        self.replayed = 0
        """Number of replayed steps."""
        self.refused = refused
        """Why recording is switched off; empty if it is on."""
        self._recorded: dict[StepKind, _Recorded] = {}
        self._seen: set[tuple[StepKind, int]] = set()
        self._layout: tuple[object, ...] = ()
        self._demand = 0
        self._gradients = False
        self._short = 0

    def forget(self) -> None:
        """Drops all recordings and frees their memory."""
        self._layout = ()
        if self._recorded:
            # All at once: graphs share the cuBLAS workspace of their stream. Freeing one graph would free it while
            # others still write to it.
            self._recorded.clear()
            self.recording.drop()

    def disable(self) -> bool:
        """Switches recording off after GPU memory ran out. Returns True if this freed the memory of a recording."""
        has_recordings, self.refused = bool(self._recorded), "the graphics card ran out of memory"
        self.forget()
        return has_recordings

    def step(self, kind: StepKind, facts: StepFacts, frame: int) -> Tensor:
        """Runs one step and returns its photometric loss (0-dim), which the next step may overwrite."""
        run, seen = self.run, (kind, self.run.soundness.mended)
        if self.refused:
            return self._launched(kind, facts, frame)
        layout, demand = run.layout(), outgrown(self.device, 1, run.width, run.height)
        outgrew = demand > self._demand  # the rasteriser enlarges its hit list only in a launched step
        if outgrew or not _same(layout, self._layout):
            self.forget()
            self._layout = layout
        if not kind.recordable or run.soundness.troubled:
            return self._launched(kind, facts, frame)
        if outgrew or seen not in self._seen:
            self._demand = max(demand, self._demand)
            self._seen.add(seen)
            with self.recording.watched():
                return self._launched(kind, facts, frame)
        if self._gradients:  # gradients of an earlier launched step, which an inspection would attribute to this step
            run.optimizer.zero_grad(set_to_none=True)
            self._gradients = False
        recorded = self._recorded.get(kind)
        if recorded is not None and recorded.listed < self._listed():  # a render outside of steps enlarged the list
            self.forget()
            self._layout, recorded = layout, None
        recorded = recorded or self._record(kind, facts, frame)
        if recorded is None:
            return self._launched(kind, facts, frame)
        facts.into(recorded.facts)
        run.optimizer.send(recorded.table)
        recorded.replay()
        self.replayed += 1
        if self.replayed % INSPECT_EVERY == 0:
            report_demands(self.device)
        return recorded.loss

    def _listed(self) -> int:
        return listed(self.device, 1, self.run.width, self.run.height)

    def _launched(self, kind: StepKind, facts: StepFacts, frame: int) -> Tensor:
        self._gradients = True
        return self.run.carry_out(kind, facts.on(self.device), frame)

    def _record(self, kind: StepKind, facts: StepFacts, frame: int) -> _Recorded | None:
        """Records a step. None if memory is too small, or if recording fails, which switches recording off."""
        if not self.recording.fits():
            return None
        room = facts.room(self.device)
        facts.into(room)
        try:
            with self.run.optimizer.recording(self.device) as table:
                replay, loss = self.recording.record(lambda: self.run.carry_out(kind, room, frame))
        except torch.OutOfMemoryError:  # the peak memory was underestimated: the next launched step is measured again
            self._seen.clear()
            self._short += 1
            if self._short == _TRIES:
                self.refused = "the graphics card has too little memory for it"
        except Exception as error:  # after any error of a driver or torch, steps can still be launched
            self.refused = (str(error).strip().splitlines() or [type(error).__name__])[0]
        else:
            self.run.optimizer.zero_grad(set_to_none=True)  # memory of the recording, which other recordings overwrite
            recorded = self._recorded[kind] = _Recorded(room, table, replay, loss, self._listed())
            return recorded
        # Outside of the handler, the traceback no longer keeps the unfinished graph and the step's tensors alive.
        self.run.optimizer.zero_grad(set_to_none=True)
        self._recorded.clear()
        self._layout = ()
        self.recording.drop()
        return None


def _same(first: tuple[object, ...], second: tuple[object, ...]) -> bool:
    """True if all items are the same objects or equal integers."""
    pairs = zip(first, second, strict=False)
    return len(first) == len(second) and all(a is b or (isinstance(a, int) and a == b) for a, b in pairs)


class CudaGraphs:
    """`Recording` as CUDA graphs. They share one memory pool, because only one is replayed at a time."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._stream: Any = None
        self._pool: Any = None
        self._took = 0

    @contextlib.contextmanager
    def watched(self) -> Generator[None]:
        """See `Recording.watched`; measures memory allocated by torch."""
        before = torch.cuda.memory_allocated(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        yield
        self._took = torch.cuda.max_memory_allocated(self.device) - before

    def fits(self) -> bool:
        """See `Recording.fits`. Recordings share their memory, so there is room once the first one exists."""
        if self._pool is not None:
            return True
        if free_bytes(self.device) <= _SPARE * self._took:
            return False
        torch.cuda.empty_cache()  # a recording cannot use memory that torch has cached for launched steps
        return True

    def record(self, work: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """See `Recording.record`."""
        self._pool = self._pool or torch.cuda.graph_pool_handle()
        self._stream = self._stream or torch.cuda.Stream(self.device)
        graph, collects = torch.cuda.CUDAGraph(), gc.isenabled()
        gc.disable()  # memory of other streams must not be freed during the capture
        try:
            with torch.cuda.stream(self._stream):
                warp_stream(self.device)
                # In the default mode, CUDA calls of other threads would make the capture fail.
                graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
                try:
                    result = work()
                except BaseException:
                    with contextlib.suppress(RuntimeError):
                        graph.capture_end()
                    raise
                graph.capture_end()
        finally:
            if collects:
                gc.enable()
        return graph.replay, result

    def drop(self) -> None:
        """See `Recording.drop`."""
        self._pool = None
        torch.cuda.empty_cache()
