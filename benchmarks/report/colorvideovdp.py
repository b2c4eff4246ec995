"""ColorVideoVDP (Mantiuk et al. 2024) of frame sequences, from the package cvvdp.

The package imports torchvision for one Gaussian blur, and a model hub for a learnt variant that is not used. Neither is
installed with a CPU-only torch. So this module skips the package's `__init__` and substitutes the blur during import.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
import types
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

DISPLAY = "standard_4k"
"""The package's default display: 30 inch, 3840x2160, 200 cd/m2, viewed from 0.75 m."""


def available() -> bool:
    """True if the package and its imports are installed."""
    return all(importlib.util.find_spec(name) for name in ("pycvvdp", "tqdm", "ffmpeg", "imageio", "scipy"))


@torch.no_grad()
def sequence_jod(frames: Tensor, truth: Tensor, fps: float) -> float | None:
    """Quality of a sequence in just-objectionable differences (10 is identical); None without the package.

    Args:
        frames, truth: [F, H, W, 3] display-referred in [0, 1]; one frame is judged as a still picture.
        fps: frames per second of the sequence.
    """
    if not available():
        return None
    arrays = [v.clamp(0.0, 1.0).float().permute(3, 0, 1, 2).contiguous().cpu().numpy() for v in (frames, truth)]
    if len(frames) == 1:
        jod, _ = _metric().predict(arrays[0][:, 0], arrays[1][:, 0], dim_order="CHW")
    else:
        jod, _ = _metric().predict(*arrays, dim_order="CFHW", frames_per_second=fps)
    return float(jod)


@functools.cache
def _metric() -> Any:
    """The metric on the CPU."""
    spec = importlib.util.find_spec("pycvvdp")
    if spec is None or spec.submodule_search_locations is None:
        raise ImportError("cvvdp is not installed")
    package = types.ModuleType("pycvvdp")
    package.__spec__, package.__path__ = spec, list(spec.submodule_search_locations)
    vision, transforms = types.ModuleType("torchvision"), types.ModuleType("torchvision.transforms")
    transforms.GaussianBlur = vision.GaussianBlur = _GaussianBlur  # type: ignore[attr-defined]
    lent = {"pycvvdp": package, "torchvision": vision, "torchvision.transforms": transforms}
    before = {name: sys.modules.get(name) for name in lent if name != "pycvvdp"}
    paths = list(sys.path)
    sys.modules.update(lent)
    try:
        module = importlib.import_module("pycvvdp.cvvdp_metric")
        return module.cvvdp(display_name=DISPLAY, device=torch.device("cpu"), quiet=True)
    finally:
        sys.path[:] = paths  # the package adds its own folder
        for name, value in before.items():
            sys.modules.pop(name)
            if value is not None:
                sys.modules[name] = value


class _GaussianBlur(torch.nn.Module):
    """Separable Gaussian blur of [..., H, W] with reflected borders: kernel size in pixels (odd) and sigma."""

    def __init__(self, kernel_size: int, sigma: float) -> None:
        super().__init__()
        at = torch.arange(kernel_size) - (kernel_size - 1) / 2
        weights = torch.exp(-0.5 * (at / sigma).square())
        self.weights = weights / weights.sum()

    def forward(self, x: Tensor) -> Tensor:
        """The blurred tensor, of the same shape."""
        half, weights = len(self.weights) // 2, self.weights.to(x)
        planes = F.pad(x.reshape(-1, 1, *x.shape[-2:]), (half,) * 4, mode="reflect")
        return F.conv2d(F.conv2d(planes, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1)).reshape(x.shape)
