"""A simulated CUDA device for machines without one: CPU tensors that report the device `cuda:0`.

The tensors follow torch's rules on mixing devices. Synchronisations of the host are counted, and so are the bytes on
the device, up to a limit. The rasteriser's kernels run on Warp's fibers, the others on Warp's cpu device. Import this
file before torch, in a separate process (the compiled `guard.cpp` must be found first; the patches are permanent). It
does not simulate the scratch memory of kernels (such as a sort), other streams, or durations.
"""

from __future__ import annotations

import collections
import contextlib
import ctypes
import os
import sys
import weakref
from collections.abc import Callable, Iterator
from typing import Any

ctypes.CDLL(os.environ["PRETEND_CARD"])

import torch  # noqa: E402
from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402
from torch.utils._pytree import tree_flatten, tree_map  # noqa: E402

CUDA = torch.device("cuda:0")
_BLOCK = 512
"""Granularity of torch's allocator in bytes."""
_SYNCHRONISING = {
    "_local_scalar_dense", "nonzero", "masked_select", "unique_dim", "_unique2", "unique_consecutive", "equal",
    "repeat_interleave",
}  # fmt: skip
"""Operators whose result, or its size, the host must wait for."""
_INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}
_NOTHING = {"empty", "empty_strided", "empty_like", "new_empty", "new_empty_strided", "detach", "lift_fresh", "set_"}
"""Operators that launch no kernel, in addition to views."""
_COPIES = {"copy_", "_to_copy", "copy", "_copy_from"}
_LENIENT = {
    "where", "lerp", "lerp_", "fill_", "masked_fill", "masked_fill_", "index_fill", "clamp", "clamp_min", "clamp_max",
}  # fmt: skip
"""Operators that accept a 0-dim tensor of the host, as pointwise operators do."""


class Mismatch(RuntimeError):
    """Tensors of two devices in one operator."""


class Card:
    """Counters and state of the simulated device."""

    def __init__(self) -> None:
        self.waits: collections.Counter[str] = collections.Counter()
        """Map from operator and place in the backend to the number of synchronisations."""
        self.launched: collections.Counter[str] = collections.Counter()
        """Map from each of the backend's own kernels to its number of launches."""
        self.operators = 0
        """Number of torch operators that worked on the device; each launches at least one kernel."""
        self.limit = 8 << 30
        """Memory of the device in bytes."""
        self.live = self.peak = 0
        """Bytes in use now, and their maximum."""
        self._references: dict[int, list[int]] = {}
        self.tape: Tape | None = None
        """Active recording, or None."""
        self.before_launch: Callable[[str], None] = lambda name: None
        """Called with the name of each rasteriser kernel; may raise."""

    def waited(self, what: str) -> None:
        self.waits[f"{what} at {_place()}"] += 1

    def take(self, storage: torch.UntypedStorage) -> int:
        """Count a tensor of this storage. Raises torch.OutOfMemoryError if it is new and exceeds the free memory."""
        key = storage.data_ptr()
        if not key:
            return 0
        if key not in self._references:
            size = -(-storage.nbytes() // _BLOCK) * _BLOCK
            if self.live + size > self.limit:
                raise torch.OutOfMemoryError(f"CUDA out of memory. Tried to allocate {size} bytes at {_place()}.")
            self._references[key] = [0, size]
            self.live += size
            self.peak = max(self.peak, self.live)
        self._references[key][0] += 1
        return key

    def drop(self, key: int) -> None:
        entry = self._references.get(key)
        if entry is None:
            return
        entry[0] -= 1
        if not entry[0]:
            self.live -= self._references.pop(key)[1]


class Tape:
    """Simulated `train.recorder.Recording`: work is recorded without being executed, and replayed later.

    Values of the host do not reach a replay, except through tensors that existed at recording. Operations that a CUDA
    graph refuses raise RuntimeError.
    """

    def __init__(self, device: torch.device) -> None:
        self.steps: list[Callable[[], Any]] = []
        self.kept: list[Any] = []
        """All created tensors, kept alive because kernels only know their addresses."""

    def watched(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def fits(self) -> bool:
        return True

    def drop(self) -> None:
        pass

    def record(self, work: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
        tape = CARD.tape = Tape(CUDA)
        try:
            result = work()
        finally:
            CARD.tape = None

        def replay() -> None:
            for step in tape.steps:
                step()

        return replay, result

    def run(self, func: Any, name: str, args: Any, kwargs: Any, real: tuple[Any, Any]) -> Any:
        """Record an operator on device tensors; execute it only as far as the size of its result requires."""
        if func._schema.is_mutable:
            if name == "copy_" and not isinstance(args[1], Pretended):
                raise RuntimeError(f"operation not permitted when stream is capturing: {func} at {_place()}")
            self.kept.append((args, kwargs))
            self.steps.append(lambda: func(*real[0], **real[1]))
            return None
        out = func(*real[0], **real[1])
        self.kept.append((args, kwargs, out))
        if not func.is_view and name not in _NOTHING:

            def again() -> None:
                new = func(*real[0], **real[1])
                for target, value in zip(tree_flatten(out)[0], tree_flatten(new)[0], strict=True):
                    target.copy_(value)

            self.steps.append(again)
        return out

    def launch(self, inputs: list[Any], run: Callable[[list[Any]], None]) -> None:
        """Record a launch. Structures are copied, because the host goes on to write into them."""
        copied = [type(i).from_buffer_copy(i) if isinstance(i, ctypes.Structure) else i for i in inputs]
        self.steps.append(lambda: run(copied))


CARD = Card()


def _place() -> str:
    """The two innermost functions of the backend on the call stack."""
    frame, found = sys._getframe(2), []
    while frame and len(found) < 2:
        name = frame.f_code.co_filename.replace("\\", "/")
        if "/torch_backend/" in name:
            found.append(f"{name.split('/torch_backend/')[-1]}:{frame.f_code.co_name}")
        frame = frame.f_back
    return " < ".join(found)


def _release(storage_key: list[int]) -> None:
    CARD.drop(storage_key[0])


class Pretended(torch.Tensor):
    """A tensor that reports to be on the simulated device."""

    _real: torch.Tensor
    _storage_key: list[int]
    """Result of `CARD.take` for the storage."""

    @staticmethod
    def __new__(cls, real: torch.Tensor) -> Pretended:
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, real.shape, strides=real.stride(), storage_offset=real.storage_offset(), dtype=real.dtype,
            layout=real.layout, device=CUDA, requires_grad=False,
        )  # fmt: skip
        tensor._real, tensor._storage_key = real, [CARD.take(real.untyped_storage())]
        weakref.finalize(tensor, _release, tensor._storage_key)
        return tensor

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    def data_ptr(self) -> int:
        return self._real.data_ptr()

    def tolist(self) -> Any:
        CARD.waited("tolist")
        return self._real.tolist()

    def __repr__(self, **_: Any) -> str:
        return f"Pretended({self._real!r})"

    @property
    def data(self) -> Any:
        return self.detach()

    @data.setter
    def data(self, value: Any) -> None:
        if not isinstance(value, Pretended) or value.shape != self.shape:
            raise Mismatch("data of another device or shape")
        key = CARD.take(value._real.untyped_storage())
        CARD.drop(self._storage_key[0])
        self._real, self._storage_key[0] = value._real, key


def _real(value: Any) -> Any:
    return value._real if isinstance(value, Pretended) else value


def _on_card(value: Any) -> Any:
    return Pretended(value) if isinstance(value, torch.Tensor) and not isinstance(value, Pretended) else value


def _check(func: Any, name: str, tensors: list[Any]) -> None:
    """Raise Mismatch where torch refuses tensors of two devices."""
    ours = [t for t in tensors if isinstance(t, Pretended)]
    host_tensors = [t for t in tensors if not isinstance(t, Pretended)]
    if not ours or not host_tensors or name in _COPIES or name in _INDEXED:
        return
    lenient = torch.Tag.pointwise in func.tags or name in _LENIENT
    written = name.endswith("_") and not isinstance(tensors[0], Pretended)
    if written or not lenient or any(t.dim() > 0 for t in host_tensors):
        shapes = [(tuple(t.shape), "cuda" if isinstance(t, Pretended) else "cpu") for t in tensors]
        raise Mismatch(f"{func} of {shapes} at {_place()}")


def _check_index(func: Any, name: str, args: Any) -> None:
    """Check the devices of index operators. Indices may be on the host, but those and boolean indices synchronise."""
    values, indices = args[0], [i for i in args[1] if isinstance(i, torch.Tensor)]
    if not isinstance(values, Pretended) and any(isinstance(i, Pretended) for i in indices):
        raise Mismatch(f"{func}: cpu indexed by cuda at {_place()}")
    for index in indices:
        if isinstance(values, Pretended) and not isinstance(index, Pretended):
            CARD.waited("index from the host")
        if index.dtype in (torch.bool, torch.uint8):
            CARD.waited("flags as an index")
    is_mixed = "put" in name and isinstance(values, Pretended) != isinstance(args[2], Pretended)
    if is_mixed and (not isinstance(values, Pretended) or args[2].dim() > 0):
        raise Mismatch(f"{func}: values of another device at {_place()}")


def _count_waits(name: str, args: Any, kwargs: dict[str, Any], to_card: bool, touches: bool) -> None:
    if name == "copy_":
        waits = not kwargs.get("non_blocking", args[2] if len(args) > 2 else False)
        if waits and isinstance(args[0], Pretended) != isinstance(args[1], Pretended):
            CARD.waited("copy_")
    elif name == "_to_copy":
        from_card = isinstance(args[0], Pretended)
        leaves = from_card and kwargs.get("device") is not None and torch.device(kwargs["device"]).type == "cpu"
        if leaves or (not from_card and to_card and not kwargs.get("non_blocking", False)):
            CARD.waited("to cpu" if leaves else "to cuda")
    elif name in _SYNCHRONISING and touches:
        CARD.waited(name)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Execute an operator on the real tensors."""
    name = func._schema.name.split("::")[-1]
    tensors = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, torch.Tensor)]
    touches = any(isinstance(t, Pretended) for t in tensors)
    device = kwargs.get("device")
    to_card = device is not None and torch.device(device).type == "cuda"
    to_host = device is not None and torch.device(device).type == "cpu"
    _check(func, name, tensors)
    if name in _INDEXED and touches:
        _check_index(func, name, args)
    _count_waits(name, args, kwargs, to_card, touches)
    CARD.operators += (touches or to_card) and not func.is_view and name not in _NOTHING
    host_kwargs = {**kwargs, "device": torch.device("cpu")} if to_card else dict(kwargs)
    host_kwargs.pop("pin_memory", None)
    if name == "_to_copy":
        host_kwargs.pop("device", None)  # between two host tensors the result is always a copy
    real = tree_map(_real, args), tree_map(_real, host_kwargs)
    if CARD.tape is not None and (touches or to_card):
        leaves = name == "_to_copy" and (to_host or not touches)
        if leaves or name in _SYNCHRONISING:
            raise RuntimeError(f"operation not permitted when stream is capturing: {func} at {_place()}")
        out = CARD.tape.run(func, name, args, kwargs, real)
    else:
        out = func(*real[0], **real[1])
    stays = isinstance(args[0], Pretended) if name == "copy_" else to_card or (touches and not to_host)
    if name == "_local_scalar_dense" or not stays:
        return out
    if func._schema.is_mutable and name.endswith("_"):
        return args[0]
    if func._schema.is_mutable and "out" in kwargs:
        return kwargs["out"]
    if func._schema.is_mutable and not func._schema.returns:
        return None
    return tree_map(_on_card, out)


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


@contextlib.contextmanager
def pretended_card() -> Iterator[Card]:
    """Simulate one NVIDIA GPU with `CARD.limit` bytes for the block."""
    import torch_backend.deformation.planes_cuda as planes_cuda
    import torch_backend.native as native
    import torch_backend.raster.cuda as cuda
    import torch_backend.raster.ssim_cuda as ssim_cuda
    import torch_backend.train.adam as adam
    import torch_backend.train.device as chosen
    import torch_backend.train.recorder as recorder
    import torch_backend.train.self_test as self_test

    saved: list[tuple[Any, str, Any]] = []

    def patch(where: Any, name: str, value: Any) -> None:
        saved.append((where, name, getattr(where, name)))
        setattr(where, name, value)

    host, real_launch = torch.device("cpu"), native.launch_on

    def launch_on(kernel: Any, dim: int, inputs: list[Any], device: torch.device) -> None:
        CARD.launched[kernel.key] += device.type == "cuda"
        if CARD.tape is not None:
            CARD.tape.launch(inputs, lambda copied: real_launch(kernel, dim, copied, host))
        else:
            real_launch(kernel, dim, inputs, host)

    def launch(self: Any, name: str, args: Any, threads: int, channels: int = 0) -> None:
        if threads:
            CARD.before_launch(name)
            CARD.launched[name] += 1
            dim = -(-threads // cuda.source.BLOCK) * cuda.source.BLOCK

            def go(inputs: list[Any]) -> None:
                with cuda._Fibers(self.wp):
                    real_launch(cuda.build(name, channels), dim, inputs, host, cuda.source.BLOCK)

            if CARD.tape is not None:
                CARD.tape.launch([args], go)
            else:
                go([args])

    plain = torch.tensor
    patch(torch, "tensor", lambda *values, pin_memory=False, **options: plain(*values, **options))
    patch(torch.Tensor, "pin_memory", lambda self, *_: self)
    patch(torch.cuda, "_lazy_init", lambda: None)
    patch(torch.cuda, "is_available", lambda: True)
    patch(torch.cuda, "is_current_stream_capturing", lambda: CARD.tape is not None)
    patch(torch.cuda, "device", lambda device: contextlib.nullcontext())
    patch(torch.cuda, "mem_get_info", lambda device=None: (CARD.limit - CARD.live, CARD.limit))
    patch(torch.cuda, "empty_cache", lambda: None)
    patch(torch.cuda, "memory_reserved", lambda device=None: CARD.live)
    patch(torch.cuda, "memory_allocated", lambda device=None: CARD.live)
    patch(torch.cuda, "synchronize", lambda device=None: None)
    for module in (recorder, self_test):
        patch(module, "CudaGraphs", Tape)
    patch(chosen, "cuda_refusal", lambda: "")
    patch(chosen, "card_verdict", self_test.SelfTest)  # a separate process would not have the simulated device
    for module in (native, ssim_cuda, adam, planes_cuda):
        patch(module, "launch_on", launch_on)
    patch(cuda, "warp_stream", lambda device: None)
    patch(cuda._Launcher, "__call__", launch)
    patch(cuda, "_refusal", lambda device: None)
    overwritten = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with _Mode():
            yield CARD
    finally:
        torch._C._set_only_lift_cpu_tensors(False)
        torch.__future__.set_overwrite_module_params_on_conversion(overwritten)
        for where, name, value in reversed(saved):
            setattr(where, name, value)
