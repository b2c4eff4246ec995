"""ST-LPIPS, the shift-tolerant learnt distance of pictures (Ghildyal and Liu, ECCV 2022), on AlexNet.

The package stlpips-pytorch supplies the weights. Its code cannot be imported with a CPU-only torch and is not used.
This network is written from the layers' shapes and the paper's description. Blurred subsampling replaces AlexNet's
strides: a binomial 3x3 filter, stride 2, borders reflected by 2 pixels.
"""

from __future__ import annotations

import functools
import importlib.metadata
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

_PACKAGE, _WEIGHTS = "stlpips-pytorch", "weights/vST0.0/alex_shift_tolerant.pth"
_LEAST_SIDE = 32
"""Least side in pixels, below which the last layers are too small for reflected borders."""


def weights_path() -> Path | None:
    """The package's weight file; None without the package."""
    try:
        files = importlib.metadata.files(_PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    found = [Path(str(f.locate())) for f in files if f.as_posix().endswith(_WEIGHTS)]
    return next((path for path in found if path.is_file()), None)


@functools.cache
def _weights(path: Path) -> dict[str, Tensor]:
    return torch.load(path, map_location="cpu", weights_only=True)


@torch.no_grad()
def distance_map(image: Tensor, truth: Tensor) -> Tensor | None:
    """[H, W] distance map of two pictures [H, W, 3] in [0, 1]; None without weights or if a side is below 32 pixels.

    Its mean is the published distance, except for the layers' upsampling.
    """
    path = weights_path()
    if path is None or min(image.shape[:2]) < _LEAST_SIDE:
        return None
    w = _weights(path)
    ours, theirs = _features(image, w), _features(truth, w)
    total = torch.zeros(image.shape[:2])
    for n, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        layer = F.conv2d((a - b).square(), w[f"lin{n}.model.1.weight"])
        total += F.interpolate(layer, image.shape[:2], mode="bilinear", align_corners=False)[0, 0]
    return total


def _features(image: Tensor, w: dict[str, Tensor]) -> list[Tensor]:
    """The five layers of a picture [H, W, 3], each [1, C, h, w] and normalised to unit length along C."""
    x = (image.permute(2, 0, 1)[None] * 2.0 - 1.0 - w["scaling_layer.shift"]) / w["scaling_layer.scale"]
    layers = [F.relu(_halve(_convolve(x, w, "slice1.0", 2), w["net.slice1.1.filt"]))]
    for name, halved in (("slice2.5", "slice2.4"), ("slice3.9", "slice3.8"), ("slice4.11", ""), ("slice5.13", "")):
        x = _halve(F.max_pool2d(layers[-1], 3, 1), w[f"net.{halved}.filt"]) if halved else layers[-1]
        layers.append(F.relu(_convolve(x, w, name, w[f"net.{name}.weight"].shape[-1] // 2)))
    return [v / (v.square().sum(1, keepdim=True).sqrt() + 1e-10) for v in layers]


def _convolve(x: Tensor, w: dict[str, Tensor], name: str, padding: int) -> Tensor:
    return F.conv2d(x, w[f"net.{name}.weight"], w[f"net.{name}.bias"], padding=padding)


def _halve(x: Tensor, taps: Tensor) -> Tensor:
    """Blurs by `taps` [C, 1, 3, 3] and keeps every second pixel."""
    return F.conv2d(F.pad(x, (2, 2, 2, 2), mode="reflect"), taps, stride=2, groups=x.shape[1])
