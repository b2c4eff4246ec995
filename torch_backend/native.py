"""C++ snippets: compiled by Warp at first use (seconds, cached on disk), run by Python threads over units of work.

A launch runs on the calling thread and releases the GIL, so workers are Python threads. A snippet sees its parameter
block as `P` and hands itself units by `take()`, an atomic counter; what a unit writes belongs to it alone, so results
do not depend on the number of threads. `PRELUDE` gives 16-lane float vectors.

The environment variable OMP_WAIT_POLICY=passive should be set before torch is imported (`cli.main` does): spinning
OpenMP threads would take the cores.
"""

import contextlib
import ctypes
import functools
import importlib
import os
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, cast

import torch
import warp as wp
from warp._src import build as warp_build

from .compiler_folders import compiler_folders, kernel_refusal, need_room
from .kernel_text import kernel_text

Launch = Callable[[int, int, int], None]
"""A compiled snippet, called as f(address of the block, stage, worker)."""
_raw_stream: Any = getattr(importlib.import_module("torch._C"), "_cuda_getCurrentRawStream", None)
"""The handle of torch's current stream of a card, without an object around it: what torch's own compiler asks."""
_CPU = torch.device("cpu")
_recorded = threading.local()
"""A thread's launches, by kernel, device and threads of a block."""

PRELUDE = kernel_text(Path(__file__).with_name("kernels") / "prelude.cpp")
POINTER, INTEGER = (ctypes.c_uint64, "float*"), (ctypes.c_int64, "long long")
"""Kinds of a block's fields: (ctypes, C)."""


PROCESSOR_VARIABLE = "SPLANNEQUIN_MARCH"
"""Environment variable: compile kernels for this processor (as Clang names it: x86-64-v3) instead of this one."""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_threads() -> int:
    """Number of worker threads used unless told otherwise: all cores that this process may use, at most 16, or as many
    as OMP_NUM_THREADS names, which torch obeys as well."""
    setting = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores(), 16, int(setting) if setting.isdecimal() else 16))


_WORTH_A_THREAD = 460_000
_LOOK_SECONDS = 1.0
"""A caller looks so often whether its workers have ended, if nothing tells it: nobody may wait for a word for ever."""


@contextlib.contextmanager
def torch_threads(values: int) -> Generator[None]:
    """Meanwhile torch's own operators, on tensors of so many numbers, run on as many threads as are worth waking, and
    on no more than they had.

    Between two operators torch's threads sleep (OMP_WAIT_POLICY): where each works on little, waking them takes longer
    than they save (docs/decisions.md, "Processor, cards, Blender"). Compiled snippets have threads of their own.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, round(values / _WORTH_A_THREAD))))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _without_notice() -> Generator[None]:
    """Hold back what C code writes to standard error meanwhile; pass on all but Warp's notice of a missing GPU."""
    try:
        saved = os.dup(2)
    except OSError:  # a detached process may have no standard error at all
        yield
        return
    with tempfile.TemporaryFile() as notice:
        os.dup2(notice.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            notice.seek(0)
            lines = notice.read().decode(errors="replace").splitlines(keepends=True)
            if sys.stderr is not None:
                sys.stderr.writelines(line for line in lines if "CUDA driver" not in line)


@functools.cache
def initialised_warp() -> Any:
    """The module warp, initialised once without a word on the terminal.

    JobError where its compilers cannot read the folders that it is in (`compiler_folders`).
    """
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    usual = os.environ.get("WARP_CACHE_PATH") or os.environ.get("LOCALAPPDATA") or Path.home()
    folders = compiler_folders(Path(wp.__file__).parent, wp.config.version, os.environ, Path(usual))
    if folders.kernels is not None:
        wp.config.kernel_cache_dir = str(folders.kernels)
    wp.config.use_precompiled_headers = wp.config.use_precompiled_headers and folders.precompiled
    processor = os.environ.get(PROCESSOR_VARIABLE)
    if processor:  # its kernels lie beside the others: Warp's cache tells them apart by the flags
        wp.config.cpu_compiler_flags = f"-target-cpu {processor}"
    with _without_notice():
        wp.init()
    if folders.headers is not None:
        cast(Any, warp_build).warp_home = str(folders.headers)  # Warp 1.19 has no setting for it
    return wp


@contextlib.contextmanager
def compiling(folder: Path | None = None) -> Generator[None]:
    """JobError, in a sentence, if a kernel cannot be compiled meanwhile because there is no room for it.

    `folder`: where the compiled kernel is stored. LLVM ends the process if it cannot write, so free space is checked
    first.
    """
    try:
        if folder is not None and not any(folder.glob("*.o")):
            need_room(folder.parent)
        yield
    except Exception as error:
        refusal = kernel_refusal(Path(str(wp.config.kernel_cache_dir)), error)
        if refusal is None:
            raise
        raise refusal from error


def func_native(text: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """`warp.func_native`: gives a function without a body, called as it says, the body `text`."""
    return cast(Any, wp).func_native(text)


def build(name: str, text: str) -> Launch:
    """Compile C++ `text` as a module of its own, or load it from Warp's cache."""
    initialised_warp()

    def run(block: wp.uint64, stage: wp.int32, worker: wp.int32): ...

    run.__name__ = run.__qualname__ = name
    native = func_native(text)(run)

    def entry(block: wp.uint64, stage: wp.int32, worker: wp.int32):
        native(block, stage, worker)

    module = f"{__name__}.{name}"
    kernel = wp.Kernel(entry, key=name, module=wp.get_module(module), options={"enable_backward": False})
    identifier = cast(Any, wp.get_module(module)).get_module_identifier(1)  # of blocks of one thread, as on a processor
    folder = Path(str(wp.config.kernel_cache_dir)) / identifier
    with compiling(folder):
        wp.load_module(module, device="cpu")

    def launch(block: int, stage: int, worker: int) -> None:
        _relaunch(kernel, 1, [block, stage, worker], _CPU, None, None)

    return launch


class _Ask:
    """One launch of a kernel: lists record which workers began and ended, since no interrupt leaves an append half
    done."""

    def __init__(self, run: Launch, address: int, stage: int, workers: int) -> None:
        self._run, self._address, self._stage = run, address, stage
        self._pending = deque(range(workers))
        self._entered: list[None] = []
        self._left: list[None] = []
        self._told: SimpleQueue[None] = SimpleQueue()
        self.errors: list[BaseException] = []
        """Exceptions of workers that failed."""

    def help(self) -> None:
        """Runs one pending worker on a thread of the crew, if there is one left."""
        self._entered.append(None)
        try:
            self._take(self._pending.pop)
        finally:
            self._left.append(None)
            self._told.put(None)

    def carry_out(self, crew: "_Crew", helpers: int) -> None:
        """Runs on the calling thread: asks for helpers, carries out all pending workers, then waits for the helpers.
        Returns only when no thread works on the block, also after a Ctrl-C.

        Helpers are asked in here, and the loop that waits is another function's: Python looks for a Ctrl-C as a
        function begins and as a loop turns, and that has to be within `try`.
        """
        while True:
            try:
                if helpers:
                    wanted, helpers = helpers, 0
                    crew.ask(self, wanted)
                self._finish()
                return
            except BaseException as raised:  # Ctrl-C: raised once the block is nobody's
                self.errors.append(raised)

    def _finish(self) -> None:
        while True:
            while self._take(self._pending.popleft):
                pass
            left = len(self._left)  # read before `_entered`, so that a helper that enters meanwhile is waited for
            if left == len(self._entered):
                return
            with contextlib.suppress(Empty):
                self._told.get(timeout=_LOOK_SECONDS)

    def _take(self, pop: Callable[[], int]) -> bool:
        try:
            worker = pop()
        except IndexError:
            return False
        try:
            self._run(self._address, self._stage, worker)
        except BaseException as raised:  # raised again by the caller
            self.errors.append(raised)
        return True


class _Crew:
    """Threads that carry out what they are asked to. A pool of futures takes several times as long."""

    def __init__(self) -> None:
        self._lock, self._threads = threading.Lock(), 0
        self._asked: SimpleQueue[_Ask] = SimpleQueue()

    def ask(self, ask: _Ask, helpers: int) -> None:
        """Has so many threads help, or as many as the system lets us have."""
        if self._threads < helpers:
            with self._lock:
                while self._threads < helpers:
                    try:
                        threading.Thread(target=self._work, name=f"native-{self._threads}", daemon=True).start()
                    except RuntimeError:
                        break
                    self._threads += 1
        for _ in range(min(helpers, self._threads)):  # without a thread to take it, a request would stay in the queue
            self._asked.put(ask)

    def _work(self) -> None:
        while True:
            self._asked.get().help()


_crew = _Crew()


def _new_crew() -> None:
    global _crew
    _crew = _Crew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_crew)  # threads do not survive a fork


def run_workers(run: Launch, block: Any, stage: int, workers: int) -> None:
    """Run one stage of a block (a ctypes structure with a field `counter`) as so many workers, on as many threads as
    come in time, the caller's among them: a stage must not have one worker wait for another."""
    block.counter = 0
    address = ctypes.addressof(block)
    if workers == 1:
        run(address, stage, 0)
        return
    ask = _Ask(run, address, stage, workers)
    ask.carry_out(_crew, workers - 1)
    if ask.errors:
        raise ask.errors[0]


class Snippet:
    """One compiled body. `fields` are those of its parameter block in order, name -> kind; `counter` is added."""

    def __init__(self, name: str, fields: dict[str, tuple[Any, str]], source: str) -> None:
        self.name, self._lock = name, threading.Lock()
        self._launch: Launch | None = None
        fields = {**fields, "counter": INTEGER}
        self._block = type("Block", (ctypes.Structure,), {"_fields_": [(n, kind) for n, (kind, _) in fields.items()]})
        struct = " ".join(f"{text} {n};" for n, (_, text) in fields.items())
        self._source = f"struct Block {{ {struct} }};\nBlock& P = *(Block*)block;\n{PRELUDE}{source}"

    def warm_up(self) -> None:
        """Compile, or load from the cache; threads that ask at once wait for one compilation."""
        with self._lock:
            if self._launch is None:
                self._launch = build(self.name, self._source)

    def run(self, threads: int | None = None, stage: int = 0, **values: Any) -> None:
        """Runs the body on `threads` workers (default: all cores) with the block's fields as given."""
        if self._launch is None:
            self.warm_up()
        block: Any = self._block(**values)
        assert self._launch is not None
        run_workers(self._launch, block, stage, threads or default_threads())


@functools.cache
def _stream(device: str, handle: int) -> Any:
    initialised_warp()
    return wp.Stream(wp.get_device(device), cuda_stream=handle)


def warp_stream(device: torch.device) -> Any:
    """Warp's name for torch's current stream of a CUDA device; kept for good, as torch keeps its streams."""
    device_index: Any = device.index  # None for plain "cuda"
    index: int = torch.cuda.current_device() if device_index is None else device_index
    if _raw_stream is not None:
        return _stream(f"cuda:{index}", _raw_stream(index))
    return _stream(f"cuda:{index}", torch.cuda.current_stream(device).cuda_stream)


def launch_on(
    kernel: Any, dim: int, inputs: list[Any], device: torch.device, block: int | None = None, stream: Any = None
) -> None:
    """Launches a Warp kernel where a torch tensor's `device` is; on CUDA behind torch's work, on its current stream.

    Warp looks at kernel, module and arguments anew in each launch, which takes the host longer than a small kernel
    takes a card. So a thread has it recorded once, and from then on says only what is other.

    Args:
        dim: threads.
        inputs: numbers, or ctypes structures in the layout of a Warp structure.
        block: threads of a block (default: Warp's).
        stream: result of `warp_stream(device)`, for callers with several launches.
    """
    if not dim:
        return
    if stream is None and device.type == "cuda":
        stream = warp_stream(device)
    with current_card(device):
        _relaunch(kernel, dim, inputs, device, block, stream)


def current_card(device: torch.device) -> AbstractContextManager[Any]:
    """Makes a card the current one, for Warp leaves its device current, and the caller's may be another one. Nothing
    on a machine without a second card: to ask takes longer than to launch."""
    return torch.cuda.device(device) if device.type == "cuda" and _cards() > 1 else contextlib.nullcontext()


@functools.cache
def _cards() -> int:
    return torch.cuda.device_count()


def _relaunch(kernel: Any, dim: int, inputs: list[Any], device: torch.device, block: int | None, stream: Any) -> None:
    known: dict[Any, Any] = _recorded.__dict__
    key = kernel, device, block
    command = known.get(key)
    if command is None:
        blank = [arg.type() for arg in kernel.adj.args]
        with compiling():
            command = known[key] = initialised_warp().launch(
                kernel, dim=dim, inputs=blank, block_dim=block, record_cmd=True, record_tape=False, stream=stream,
                device=None if stream else "cpu",
            )  # fmt: skip
    if command.bounds.size != dim:
        command.set_dim(dim)
    for index, value in enumerate(inputs):
        command.set_param_at_index_from_ctype(index, value)
    command.launch(stream)
