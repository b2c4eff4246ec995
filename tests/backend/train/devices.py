"""Finds tensors that are created without a device."""

import sys
from pathlib import Path

from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors

import torch_backend

ROOT = Path(torch_backend.__file__).parent
STATIONS = [str(ROOT / name) for name in ("train", "gaussians", "deformation", "supervision", "freeze")]


class NamedDevices(TorchFunctionMode):
    """Records each call in a station that creates a tensor without a device."""

    def __init__(self):
        super().__init__()
        self.found = set()

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in _device_constructors() and kwargs.get("device") is None:
            frame = sys._getframe(1)
            while frame and "/torch/" in frame.f_code.co_filename.replace("\\", "/"):
                frame = frame.f_back
            if frame and frame.f_code.co_filename.startswith(tuple(STATIONS)):
                self.found.add(f"{frame.f_code.co_filename}:{frame.f_lineno} {func.__name__}")
        return func(*args, **kwargs)
