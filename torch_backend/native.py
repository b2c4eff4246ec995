"""C++ snippets of the training step, compiled by Warp at first use and run by Python threads over units of work.

A launch runs on the calling thread and releases the GIL. Each snippet sees its parameter block as `P` and hands itself
units by `take()`, an atomic counter; what a unit writes belongs to it alone, so results do not depend on the number of
threads. `PRELUDE` gives 16-lane float vectors.
"""

import ctypes
import functools
import threading
from typing import Any

import torch

from .raster import cpu
from .raster.settings import default_threads

PRELUDE = r"""
typedef float F __attribute__((ext_vector_type(16)));
#define FN(...) [&](__VA_ARGS__) __attribute__((always_inline))
auto load = FN(const float* p) -> F { F v; __builtin_memcpy(&v, p, 64); return v; };
auto store = FN(float* p, F v) -> void { __builtin_memcpy(p, &v, 64); };
auto take = FN() -> long long { return __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED); };
"""
POINTER, INTEGER = (ctypes.c_uint64, "float*"), (ctypes.c_int64, "long long")
"""Kinds of a block's fields: (ctypes, C)."""


class Snippet:
    """One compiled body. `fields` are those of its parameter block in order, name -> kind; `counter` is added."""

    def __init__(self, name: str, fields: dict[str, tuple[Any, str]], source: str) -> None:
        self.name, self._launch, self._lock = name, None, threading.Lock()
        fields = {**fields, "counter": INTEGER}
        self._block = type("Block", (ctypes.Structure,), {"_fields_": [(n, kind) for n, (kind, _) in fields.items()]})
        struct = " ".join(f"{text} {n};" for n, (_, text) in fields.items())
        self._source = f"struct Block {{ {struct} }};\nBlock& P = *(Block*)block;\n{PRELUDE}{source}"

    def warm_up(self) -> None:
        """Compile, or load from the cache; threads that ask at once wait for one compilation."""
        with self._lock:
            if self._launch is None:
                self._launch = self._build()

    def run(self, threads: int | None = None, stage: int = 0, **values: Any) -> None:
        """Runs the body on `threads` workers (default: all cores) with the block's fields as given."""
        if self._launch is None:
            self.warm_up()
        block: Any = self._block(**values)
        cpu._workers(self._launch, block, stage, threads or default_threads())  # type: ignore[arg-type]

    def _build(self) -> Any:
        wp = cpu._import_warp()

        def body(block: wp.uint64, stage: wp.int32, worker: wp.int32): ...

        body.__name__ = body.__qualname__ = self.name
        native = wp.func_native(self._source)(body)

        def entry(block: wp.uint64, stage: wp.int32, worker: wp.int32):
            native(block, stage, worker)

        module = f"{__name__}.{self.name}"
        kernel = wp.Kernel(entry, key=self.name, module=wp.get_module(module), options={"enable_backward": False})
        wp.load_module(module, device="cpu")

        def launch(block: int, stage: int, worker: int) -> None:
            wp.launch(kernel, dim=1, inputs=[block, stage, worker], device="cpu")

        return launch


@functools.cache
def _stream(device: str, handle: int) -> Any:
    wp = cpu._import_warp()
    return wp.Stream(wp.get_device(device), cuda_stream=handle)


def warp_stream(device: torch.device) -> Any:
    """Warp's name for torch's current stream of a CUDA device; kept for good, as torch keeps its streams."""
    current = torch.cuda.current_stream(device)
    return _stream(f"cuda:{current.device_index}", current.cuda_stream)


def launch_on(kernel: Any, dim: Any, inputs: list[Any], device: torch.device) -> None:
    """Launches a Warp kernel where a torch tensor's `device` is; on CUDA behind torch's work, on its current stream."""
    wp = cpu._import_warp()
    if device.type == "cpu":
        wp.launch(kernel, dim=dim, inputs=inputs, device="cpu")
        return
    # Warp leaves its device current; the caller's may be another one.
    with torch.cuda.device(device):
        wp.launch(kernel, dim=dim, inputs=inputs, stream=warp_stream(device))
