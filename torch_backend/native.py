"""C++ snippets that Warp compiles at first use (seconds, cached on disk) and that Python threads run in parallel.

A launch runs on the calling thread and releases the GIL, so workers are Python threads. A snippet accesses its
parameter block as `P` and gets its next unit of work from `take()`, an atomic counter. No two units write to the same
memory, so results do not depend on the number of threads. `PRELUDE` defines 16-lane float vectors.

The environment variable OMP_WAIT_POLICY=passive should be set before torch is imported, as `cli.main` does. Otherwise
spinning OpenMP threads occupy the cores.
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
"""Private function of torch for the raw handle of a card's current stream, as torch's compiler uses it; or None."""
_CPU = torch.device("cpu")
_recorded = threading.local()
"""Recorded launches of each thread, by kernel, device and threads per block."""

PRELUDE = kernel_text(Path(__file__).with_name("kernels") / "prelude.cpp")
POINTER, INTEGER = (ctypes.c_uint64, "float*"), (ctypes.c_int64, "long long")
"""Types of a parameter block's fields: (ctypes type, C type)."""


PROCESSOR_VARIABLE = "SPLANNEQUIN_MARCH"
"""Environment variable: processor to compile kernels for, as Clang names it (x86-64-v3). Default: this machine's."""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_threads() -> int:
    """Default number of worker threads: the cores that this process may use, but at most 16, and at most
    OMP_NUM_THREADS, which torch obeys as well."""
    setting = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores(), 16, int(setting) if setting.isdecimal() else 16))


_WORTH_A_THREAD = 460_000
_LOOK_SECONDS = 1.0
"""Interval in seconds at which a caller checks whether its helpers have ended, in case a notification is lost."""


@contextlib.contextmanager
def torch_threads(values: int) -> Generator[None]:
    """Limits torch's operators to as many threads as pay off for tensors of `values` numbers. Does not raise their
    current number.

    Torch's threads sleep between two operators (OMP_WAIT_POLICY). For small tensors, waking them takes longer than they
    save (docs/decisions.md, "Processor, cards, Blender"). Compiled snippets use separate threads.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, round(values / _WORTH_A_THREAD))))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _without_notice() -> Generator[None]:
    """Holds back what C code writes to the standard error. Then prints all of it but Warp's notice of a missing GPU."""
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
    """The module warp, initialised once, without output on the terminal.

    JobError if Warp's compilers cannot read its folders (`compiler_folders`).
    """
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    usual = os.environ.get("WARP_CACHE_PATH") or os.environ.get("LOCALAPPDATA") or Path.home()
    folders = compiler_folders(Path(wp.__file__).parent, wp.config.version, os.environ, Path(usual))
    if folders.kernels is not None:
        wp.config.kernel_cache_dir = str(folders.kernels)
    wp.config.use_precompiled_headers = wp.config.use_precompiled_headers and folders.precompiled
    processor = os.environ.get(PROCESSOR_VARIABLE)
    if processor:  # Warp's cache distinguishes kernels by the flags
        wp.config.cpu_compiler_flags = f"-target-cpu {processor}"
    with _without_notice():
        wp.init()
    if folders.headers is not None:
        cast(Any, warp_build).warp_home = str(folders.headers)  # Warp 1.19 has no setting for it
    return wp


@contextlib.contextmanager
def compiling(folder: Path | None = None) -> Generator[None]:
    """Raises JobError if a kernel cannot be compiled during the block because of the disk (`kernel_refusal`).

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
    """`warp.func_native`: decorator that gives a function without a body the C++ body `text`."""
    return cast(Any, wp).func_native(text)


def build(name: str, text: str) -> Launch:
    """Compiles C++ `text` as a separate module, or loads it from Warp's cache."""
    initialised_warp()

    def run(block: wp.uint64, stage: wp.int32, worker: wp.int32): ...

    run.__name__ = run.__qualname__ = name
    native = func_native(text)(run)

    def entry(block: wp.uint64, stage: wp.int32, worker: wp.int32):
        native(block, stage, worker)

    module = f"{__name__}.{name}"
    kernel = wp.Kernel(entry, key=name, module=wp.get_module(module), options={"enable_backward": False})
    identifier = cast(Any, wp.get_module(module)).get_module_identifier(1)  # for blocks of one thread, as on a CPU
    folder = Path(str(wp.config.kernel_cache_dir)) / identifier
    with compiling(folder):
        wp.load_module(module, device="cpu")

    def launch(block: int, stage: int, worker: int) -> None:
        _relaunch(kernel, 1, [block, stage, worker], _CPU, None, None)

    return launch


class _Task:
    """One launch of a kernel. Lists record which workers began and ended, because an interrupt cannot leave an append
    half done."""

    def __init__(self, run: Launch, address: int, stage: int, workers: int) -> None:
        self._run, self._address, self._stage = run, address, stage
        self._pending = deque(range(workers))
        self._entered: list[None] = []
        self._exited: list[None] = []
        self._finished: SimpleQueue[None] = SimpleQueue()
        self.errors: list[BaseException] = []
        """Exceptions of workers that failed."""

    def help(self) -> None:
        """Runs one pending worker, if any is left, on a thread of the crew."""
        self._entered.append(None)
        try:
            self._take(self._pending.pop)
        finally:
            self._exited.append(None)
            self._finished.put(None)

    def carry_out(self, crew: "_Crew", helpers: int) -> None:
        """Carries out the launch on the calling thread: requests helpers, runs pending workers, then waits for the
        helpers. Returns only when no thread works on the block, even after a Ctrl-C.

        Python checks for a Ctrl-C when a function begins and when a loop repeats. The request for helpers and the
        waiting loop (`_finish`) are therefore inside `try`.
        """
        while True:
            try:
                if helpers:
                    count, helpers = helpers, 0
                    crew.submit(self, count)
                self._finish()
                return
            except BaseException as raised:  # Ctrl-C: raised again once no thread uses the block
                self.errors.append(raised)

    def _finish(self) -> None:
        while True:
            while self._take(self._pending.popleft):
                pass
            exited = len(
                self._exited
            )  # read before `_entered`: the loop then waits for a helper that enters in between
            if exited == len(self._entered):
                return
            with contextlib.suppress(Empty):
                self._finished.get(timeout=_LOOK_SECONDS)

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
    """Pool of helper threads. A launch through a pool of futures takes several times as long."""

    def __init__(self) -> None:
        self._lock, self._threads = threading.Lock(), 0
        self._queue: SimpleQueue[_Task] = SimpleQueue()

    def submit(self, task: _Task, helpers: int) -> None:
        """Requests `helpers` threads for a launch, or as many as the system allows."""
        if self._threads < helpers:
            with self._lock:
                while self._threads < helpers:
                    try:
                        threading.Thread(target=self._work, name=f"native-{self._threads}", daemon=True).start()
                    except RuntimeError:
                        break
                    self._threads += 1
        for _ in range(min(helpers, self._threads)):  # without a thread to take it, a request would stay in the queue
            self._queue.put(task)

    def _work(self) -> None:
        while True:
            self._queue.get().help()


_crew = _Crew()


def _new_crew() -> None:
    global _crew
    _crew = _Crew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_crew)  # threads do not survive a fork


def run_workers(run: Launch, block: Any, stage: int, workers: int) -> None:
    """Runs one stage of a block (a ctypes structure with a field `counter`), split among `workers` workers. They run
    on the calling thread and on the helper threads that start in time. No worker may wait for another."""
    block.counter = 0
    address = ctypes.addressof(block)
    if workers == 1:
        run(address, stage, 0)
        return
    task = _Task(run, address, stage, workers)
    task.carry_out(_crew, workers - 1)
    if task.errors:
        raise task.errors[0]


class Snippet:
    """One compiled snippet. `fields`: name -> type of each field of its parameter block, in order; not `counter`."""

    def __init__(self, name: str, fields: dict[str, tuple[Any, str]], source: str) -> None:
        self.name, self._lock = name, threading.Lock()
        self._launch: Launch | None = None
        fields = {**fields, "counter": INTEGER}
        self._block = type("Block", (ctypes.Structure,), {"_fields_": [(n, kind) for n, (kind, _) in fields.items()]})
        struct = " ".join(f"{text} {n};" for n, (_, text) in fields.items())
        self._source = f"struct Block {{ {struct} }};\nBlock& P = *(Block*)block;\n{PRELUDE}{source}"

    def warm_up(self) -> None:
        """Compiles the snippet, or loads it from the cache. Threads that call this at once wait for one compilation."""
        with self._lock:
            if self._launch is None:
                self._launch = build(self.name, self._source)

    def run(self, threads: int | None = None, stage: int = 0, **values: Any) -> None:
        """Runs the snippet on `threads` workers (default: `default_threads()`); `values`: the fields of its block."""
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
    """Warp stream of torch's current stream on a CUDA device. It is cached for good, as torch keeps its streams too."""
    device_index: Any = device.index  # None for plain "cuda"
    index: int = torch.cuda.current_device() if device_index is None else device_index
    if _raw_stream is not None:
        return _stream(f"cuda:{index}", _raw_stream(index))
    return _stream(f"cuda:{index}", torch.cuda.current_stream(device).cuda_stream)


def launch_on(
    kernel: Any, dim: int, inputs: list[Any], device: torch.device, block: int | None = None, stream: Any = None
) -> None:
    """Launches a Warp kernel on a torch device; on CUDA in torch's current stream, after the work that is queued there.

    A plain Warp launch examines kernel, module and arguments each time, which takes the host longer than the card needs
    for a small kernel. Each thread therefore records a launch once, and later changes only its arguments and threads.

    Args:
        dim: number of threads.
        inputs: numbers, or ctypes structures in the layout of a Warp structure.
        block: threads per block (default: Warp's).
        stream: result of `warp_stream(device)`, for callers with several launches.
    """
    if not dim:
        return
    if stream is None and device.type == "cuda":
        stream = warp_stream(device)
    with current_card(device):
        _relaunch(kernel, dim, inputs, device, block, stream)


def current_card(device: torch.device) -> AbstractContextManager[Any]:
    """Context in which `device` is the current card. It restores the caller's card, which a Warp launch would change.
    Does nothing on a machine with one card, where the switch would take longer than the launch."""
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
