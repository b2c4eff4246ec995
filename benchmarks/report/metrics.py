"""Distances of a picture from the truth (PSNR, SSIM, ST-LPIPS, FLIP) over regions, and statistics of many figures.

Pictures are display-referred sRGB in [0, 1], [H, W, 3]. Every metric is first a map over pixels, so that a region (such
as points unseen at t*, or movers) is judged by its own pixels. Windows and receptive fields still reach slightly beyond
the region's border. A metric without its package is None, and `missing_metrics` reports it.
"""

# Packages of requirements/bench.txt may be absent; each use handles that case.
# pyright: reportMissingImports=false

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from torch_backend.torch_types import from_numpy

from . import colorvideovdp, stlpips

METRICS = {"psnr_db": True, "ssim": True, "st_lpips": False, "flip": False}
"""Metric of a picture -> True if higher is better."""
WHOLE = "whole"
"""The region of all pixels, in every score."""
LEAST_SHARE = 0.002
"""A region below this share of the picture counts as empty, because the PSNR of a dozen pixels is noise."""
WINDOW, SIGMA = 11, 1.5
"""SSIM's Gaussian window in pixels (Wang et al. 2004); a smaller picture gets a smaller window."""
_MSE_FLOOR = 1e-12
"""Lower limit of the error. It makes identical pictures 120 dB apart, because JSON has no infinity."""


def missing_metrics() -> dict[str, str]:
    """Unavailable metrics, each with the sentence printed in the report."""
    sentences: dict[str, str] = {}
    if stlpips.weights_path() is None:
        sentences["st_lpips"] = "ST-LPIPS was not measured: stlpips-pytorch is not installed (requirements/bench.txt)."
    if importlib.util.find_spec("flip_evaluator") is None:
        sentences["flip"] = "FLIP was not measured: flip-evaluator is not installed (requirements/bench.txt)."
    if not colorvideovdp.available():
        sentences["jod"] = "ColorVideoVDP was not measured: cvvdp is not installed (requirements/bench.txt)."
    return sentences


def score(
    image: Tensor, truth: Tensor, regions: Mapping[str, Tensor] | None = None
) -> dict[str, dict[str, float | int | None]]:
    """Scores a picture against the truth, over the whole and over regions.

    Args:
        image, truth: [H, W, 3] float, display-referred; clamped to [0, 1] like on a display.
        regions: name -> bool [H, W].

    Returns:
        {region: {"pixels": int, metric: float | None}}, including `WHOLE`. A metric is None without its package, if the
        picture is too small for it, or if the region is (nearly) empty.
    """
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image and truth should be [H, W, 3] alike, got {tuple(image.shape)}, {tuple(truth.shape)}")
    maps = error_maps(image, truth)
    whole = torch.ones(image.shape[:2], dtype=torch.bool)
    return {name: _over(maps, mask) for name, mask in {WHOLE: whole, **(regions or {})}.items()}


def psnr_by_region(image: Tensor, truth: Tensor, regions: Mapping[str, Tensor]) -> dict[str, float | None]:
    """PSNR in dB of two pictures [H, W, 3] over the whole and over bool regions [H, W]; None for a nearly empty one."""
    error = {"psnr_db": (image.float().clamp(0.0, 1.0) - truth.float().clamp(0.0, 1.0)).double().square().mean(2)}
    masks = {WHOLE: torch.ones(image.shape[:2], dtype=torch.bool), **regions}
    return {name: _over(error, mask)["psnr_db"] for name, mask in masks.items()}


def error_maps(image: Tensor, truth: Tensor) -> dict[str, Tensor | None]:
    """{metric: map [H, W]} of two pictures [H, W, 3] (psnr_db: the squared error); None for an unavailable metric."""
    image, truth = image.float().clamp(0.0, 1.0), truth.float().clamp(0.0, 1.0)
    return {
        "psnr_db": (image - truth).double().square().mean(2),
        "ssim": ssim_map(image, truth),
        "st_lpips": stlpips.distance_map(image, truth),
        "flip": flip_map(image, truth),
    }


def _over(maps: Mapping[str, Tensor | None], mask: Tensor) -> dict[str, float | int | None]:
    """The figure of each map over a mask [H, W]."""
    count = int(mask.sum())
    row: dict[str, float | int | None] = {"pixels": count}
    enough = count >= max(1, LEAST_SHARE * mask.numel())
    for name, values in maps.items():
        mean = float(values[mask].double().mean()) if values is not None and enough else None
        row[name] = psnr_of(mean) if name == "psnr_db" and mean is not None else mean
    return row


def psnr_of(mse: float) -> float:
    """PSNR in dB of a mean squared error of values in [0, 1]; at most 120."""
    return -10.0 * math.log10(max(mse, _MSE_FLOOR))


def ssim_map(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM of every pixel, mean over channels: [H, W] from [H, W, C]; data_range 1, windows renormalised at borders.

    The window is `WINDOW` wide, or the largest odd width that fits the shorter side.
    """
    side = min(image.shape[:2])
    width = min(WINDOW, side if side % 2 else side - 1)
    rows, columns = (_blur_matrix(size, width) for size in image.shape[:2])
    x, y = image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)

    def blur(v: Tensor) -> Tensor:
        return rows @ v @ columns.T

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    values = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return values.mean(0)


def _blur_matrix(size: int, width: int) -> Tensor:
    """[size, size] float64 matrix whose rows are Gaussian windows, clipped at the border, each summing to 1."""
    at = torch.arange(size, dtype=torch.float64)
    distance = at[:, None] - at[None, :]
    weights = torch.exp(-0.5 * (distance / SIGMA).square()) * (distance.abs() <= width // 2)
    return weights / weights.sum(1, keepdim=True)


def flip_map(image: Tensor, truth: Tensor) -> Tensor | None:
    """[H, W] LDR-FLIP at the package's viewing distance (67 pixels per degree); None without the package."""
    if importlib.util.find_spec("flip_evaluator") is None:
        return None
    flip_evaluator: Any = importlib.import_module("flip_evaluator")

    reference, test = (np.ascontiguousarray(v.cpu().numpy(), dtype=np.float32) for v in (truth, image))
    values, _, _ = flip_evaluator.evaluate(reference, test, "LDR", inputsRGB=True, applyMagma=False, parameters={})
    return from_numpy(np.array(values, dtype=np.float32)).reshape(image.shape[:2])


def best_share_psnr(image: Tensor, truth: Tensor, share: float = 0.9) -> float:
    """PSNR in dB over the best `share` of the pixels, which excludes the worst errors, usually due to movers."""
    errors = (image.clamp(0.0, 1.0) - truth.clamp(0.0, 1.0)).double().square().mean(2).flatten()
    return psnr_of(float(errors.sort().values[: max(1, math.floor(share * len(errors)))].mean()))


def gradient_energy(image: Tensor, mask: Tensor | None = None) -> float:
    """Mean squared gradient (forward differences) of Rec. 709 luma over pixels [H, W], a measure of sharpness."""
    luma = image.clamp(0.0, 1.0).double() @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    energy = F.pad(luma[:, 1:] - luma[:, :-1], (0, 1)).square() + F.pad(luma[1:] - luma[:-1], (0, 0, 0, 1)).square()
    return float(energy.mean() if mask is None else energy[mask].mean())


def gradient_magnitude(image: Tensor, mask: Tensor | None = None) -> float:
    """Mean gradient magnitude (forward differences) of Rec. 709 luma over pixels [H, W]; grain counts as detail."""
    luma = image.clamp(0.0, 1.0).double() @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    x, y = F.pad(luma[:, 1:] - luma[:, :-1], (0, 1)), F.pad(luma[1:] - luma[:-1], (0, 0, 0, 1))
    length = (x.square() + y.square()).sqrt()
    return float(length.mean() if mask is None else length[mask].mean())


# ------------------------------------------------------------------------------------------------- many figures


@dataclass
class Summary:
    """A table row as in the paper: the mean, and means of the worst shares of the frames."""

    count: int
    """Number of frames."""
    mean: float
    """Mean of all frames."""
    bottom_75: float
    """Mean of the worst 75 % of the frames, rounded up to whole frames; likewise the next two."""
    bottom_50: float
    bottom_25: float
    worst: float
    """Value of the worst frame."""


def known_mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are not None; None without such values."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def summarise(values: Sequence[float | None], more_is_better: bool = True) -> Summary | None:
    """Summary of the values that are not None; None without such values."""
    known = sorted((v for v in values if v is not None), reverse=not more_is_better)
    if not known:
        return None

    def bottom(share: float) -> float:
        return float(np.mean(known[: max(1, math.ceil(share * len(known)))]))

    return Summary(len(known), bottom(1.0), bottom(0.75), bottom(0.5), bottom(0.25), known[0])


Key = tuple[str, str, int, int, int]
"""(scene, cameras, seed, t*, pose) at which two methods are compared."""

_UNITS = (("runs", 3), ("freezes", 4), ("frames", 5))
"""Candidate units of independence, each with the number of leading parts of `Key` that identify it."""
_LEAST_UNITS = 4


@dataclass
class Paired:
    """Comparison of method a with method b on the frames that both have."""

    mean: float
    """Mean difference a - b over frames."""
    se: float | None
    """Standard error of that mean, from the spread over independent units; None with fewer than two."""
    unit: str
    """Unit taken as independent: runs (scene, cameras and seed), freezes (also t*) or frames."""
    units: int
    """Number of these units."""
    frames: int
    """Number of compared frames."""
    frame_se: float | None
    """Standard error if all frames were independent. It is too small, because frames of one run are correlated."""
    verdict: str
    """win or loss if a is better or worse by more than twice `se` and there are at least four units; else undecided."""


def paired(a: Mapping[Key, float | None], b: Mapping[Key, float | None], more_is_better: bool = True) -> Paired | None:
    """Compares two methods frame by frame. None if no frame has both.

    Frames of one run fail together. So the error is computed over runs if there are at least four, else over freezes if
    at least four, else over frames. Means of units are weighted by their number of frames.
    """
    differences = {k: float(x) - float(y) for k, x in a.items() if x is not None and (y := b.get(k)) is not None}
    if not differences:
        return None
    values = np.array(list(differences.values()))
    unit, groups = "frames", list(differences)
    for name, parts in _UNITS:
        groups = [key[:parts] for key in differences]
        unit = name
        if len(set(groups)) >= _LEAST_UNITS:
            break
    index = {group: i for i, group in enumerate(dict.fromkeys(groups))}
    which = np.array([index[group] for group in groups])
    se, frame_se = _clustered_error(values, which), _clustered_error(values, np.arange(len(values)))
    gain = float(values.mean()) * (1 if more_is_better else -1)
    open_still = se is None or len(index) < _LEAST_UNITS or abs(gain) <= 2.0 * se
    verdict = "undecided" if open_still else "win" if gain > 0 else "loss"
    return Paired(float(values.mean()), se, unit, len(index), len(values), frame_se, verdict)


def _clustered_error(values: np.ndarray, which: np.ndarray) -> float | None:
    """Standard error of the mean of `values` [V], with errors correlated within clusters `which` [V] of 0..G-1."""
    count = int(which.max()) + 1
    if count < 2:
        return None
    sums = np.bincount(which, weights=values - values.mean())
    return float(np.sqrt(count / (count - 1) * np.square(sums).sum()) / len(values))


def pareto_front(cost: Sequence[float], gain: Sequence[float]) -> list[int]:
    """Indices of the undominated points, ordered by cost.

    A point dominates another with less or equal cost and more or equal gain, one of them strictly.
    """
    front: list[int] = []
    for i in sorted(range(len(cost)), key=lambda i: (cost[i], -gain[i])):
        if not front or gain[i] > gain[front[-1]]:
            front.append(i)
    return front
