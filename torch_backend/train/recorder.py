"""Steps on a card as one launch each: recorded once as a CUDA graph, then carried out again on other numbers.

A step of a small run is a few hundred kernels of microseconds, and its host takes six times as long to ask for them as
the card to do them (docs/benchmarks.md, "GPU"). Between two events of a run (growth, the gate, a repair) all steps of
one kind are the same work on tensors at the same places, so from the second on they are replayed.

What is replayed is what a step would have done: `Trainer.carry_out` is one body for both. It is taken launch by launch
where its kind has not been seen (what is compiled or made at first use is then there), where its work asks the card
something, where the card has little memory free (a recording holds as much as a step), and for some steps after one
that was left out, so that its gradients can be looked into.
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
"""Why the card's self-test forbids recorded steps (`device`); each kernel is then launched singly. Process-wide."""
_SPARE = 1.5
"""Free memory that a recording needs, as a multiple of a step's peak."""
_TRIES = 4
"""Attempts without enough free memory after which recording is given up."""


class RecordedRun(Protocol):
    """A run whose steps are recorded; `Trainer` is one."""

    soundness: Soundness
    """What is known of its steps."""
    optimizer: FusedAdam
    """Of everything that is learnt."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    def carry_out(self, kind: StepKind, facts: StepFacts, frame: int) -> Tensor:
        """One step; its photometric loss (0-dim)."""
        ...

    def layout(self) -> tuple[object, ...]:
        """What steps read and write: while all of it is the same, it lies where it lay."""
        ...


class Recording(Protocol):
    """How work on a device is recorded."""

    def watched(self) -> contextlib.AbstractContextManager[None]:
        """Takes measure of the memory that the work in here needs."""
        ...

    def fits(self) -> bool:
        """Is there memory to record the like?"""
        ...

    def record(self, work: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """Does not carry the work out: (what carries it out, from then on, whenever it is called; the tensor that the
        work then leaves its result in)."""
        ...

    def drop(self) -> None:
        """Gives back what recordings that are gone have held."""
        ...


@dataclass
class _Recorded:
    facts: StepFacts
    """Where the step reads them."""
    table: StepTable
    """Where its optimiser does."""
    replay: Callable[[], None]
    loss: Tensor
    listed: int
    """Hits that its rasteriser has room for."""


class Recorder:
    """Carries out the steps of a run, recorded where they can be."""

    def __init__(self, run: RecordedRun, device: torch.device, recording: Recording | None = None) -> None:
        """`recording`: CUDA graphs, unless told otherwise."""
        self.run: RecordedRun = weakref.proxy(run)
        """It holds this recorder; a cycle would keep a finished run on the card until Python looks for cycles."""
        self.device = device
        self.recording = recording or CudaGraphs(device)
        self.replayed = 0
        """Steps that were carried out from a recording."""
        self.refused = refused
        """Why nothing is recorded any more; empty if it is."""
        self._recorded: dict[StepKind, _Recorded] = {}
        self._seen: set[tuple[StepKind, int]] = set()
        self._layout: tuple[object, ...] = ()
        self._wanted = 0
        self._gradients = False
        self._short = 0

    def forget(self) -> None:
        """Drops the recordings, and their memory: all at once, for with one graph goes the cuBLAS workspace of the
        stream that it was recorded on, which others would go on writing to."""
        self._layout = ()
        if self._recorded:
            self._recorded.clear()
            self.recording.drop()

    def give_up(self) -> bool:
        """The card's memory ended: nothing is recorded any more. Was there a recording, whose memory is free now?"""
        held, self.refused = bool(self._recorded), "the memory of the graphics card ended"
        self.forget()
        return held

    def step(self, kind: StepKind, facts: StepFacts, frame: int) -> Tensor:
        """One step of a kind; its photometric loss (0-dim), which the next step may overwrite."""
        run, seen = self.run, (kind, self.run.soundness.mended)
        if self.refused:
            return self._launched(kind, facts, frame)
        layout, wanted = run.layout(), outgrown(self.device, 1, run.width, run.height)
        outgrew = wanted > self._wanted  # a launched call has the rasteriser make its list larger
        if outgrew or not _same(layout, self._layout):
            self.forget()
            self._layout = layout
        if not kind.recordable or run.soundness.troubled:
            return self._launched(kind, facts, frame)
        if outgrew or seen not in self._seen:
            self._wanted = max(wanted, self._wanted)
            self._seen.add(seen)
            with self.recording.watched():
                return self._launched(kind, facts, frame)
        if self._gradients:  # of a step before, which a look would take for this one's
            run.optimizer.zero_grad(set_to_none=True)
            self._gradients = False
        recorded = self._recorded.get(kind)
        if recorded is not None and recorded.listed < self._listed():  # a call that is no step wanted more
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
        """None if there is no room for it; or if it cannot be recorded after all: then nothing is any more."""
        if not self.recording.fits():
            return None
        room = facts.room(self.device)
        facts.into(room)
        try:
            with self.run.optimizer.recording(self.device) as table:
                replay, loss = self.recording.record(lambda: self.run.carry_out(kind, room, frame))
        except torch.OutOfMemoryError:  # there was less room than a step took: the next launched one is measured anew
            self._seen.clear()
            self._short += 1
            if self._short == _TRIES:
                self.refused = "the graphics card has too little memory for it"
        except Exception as error:  # whatever a driver or torch comes up with: the step can be taken without
            self.refused = (str(error).strip().splitlines() or [type(error).__name__])[0]
        else:
            self.run.optimizer.zero_grad(set_to_none=True)  # the recording's own, which others write over
            made = self._recorded[kind] = _Recorded(room, table, replay, loss, self._listed())
            return made
        # Out here the error is gone, and with its frames the graph that was begun and the tensors of its step.
        self.run.optimizer.zero_grad(set_to_none=True)
        self._recorded.clear()
        self._layout = ()
        self.recording.drop()
        return None


def _same(one: tuple[object, ...], two: tuple[object, ...]) -> bool:
    """Are they the same objects, or equal numbers?"""
    pairs = zip(one, two, strict=False)
    return len(one) == len(two) and all(a is b or (isinstance(a, int) and a == b) for a, b in pairs)


class CudaGraphs:
    """`Recording` as CUDA graphs, which share one pool of memory: they are replayed one after the other."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._stream: Any = None
        self._pool: Any = None
        self._took = 0

    @contextlib.contextmanager
    def watched(self) -> Generator[None]:
        """As `Recording` says, of what torch allocates."""
        before = torch.cuda.memory_allocated(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        yield
        self._took = torch.cuda.max_memory_allocated(self.device) - before

    def fits(self) -> bool:
        """As `Recording` says; recordings share what they hold, so one that is there has made room for the next."""
        if self._pool is not None:
            return True
        if free_bytes(self.device) <= _SPARE * self._took:
            return False
        torch.cuda.empty_cache()  # a recording is given nothing of what torch keeps for launched steps
        return True

    def record(self, work: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """As `Recording` says."""
        self._pool = self._pool or torch.cuda.graph_pool_handle()
        self._stream = self._stream or torch.cuda.Stream(self.device)
        graph, collects = torch.cuda.CUDAGraph(), gc.isenabled()
        gc.disable()  # what it would free of another stream cannot be freed meanwhile
        try:
            with torch.cuda.stream(self._stream):
                warp_stream(self.device)
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
        """As `Recording` says."""
        self._pool = None
        torch.cuda.empty_cache()
