"""Depth maps of the user, fitted to the solve. Training pulls moving Gaussians to them; freezing uses them as well.

runs/NAME/depth.safetensors stores the fitted maps: inverse depth over the undistorted frames, in 1 / scene units, and
the uncertainty of each frame. The key of the maps covers the files, the solve and `DepthConfig`. Stored maps are used
only if their key matches.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..contract import DEPTH_FILE, ExitCode, JobError, Reporter, depth_line
from ..contract.files import is_json_object
from ..footage.depth_maps import DepthSequence
from ..lens.map_lens import MapLens
from ..lens.plate_lens import PlateLens, load_plate_lenses
from ..raster import rasterize
from ..scene import Scene, resize_intrinsics, surface_of
from ..shot import Shot, content_key, need_disk
from ..torch_types import floats, from_numpy, integers
from .checkpoint import load_checkpoint, read_meta, save_checkpoint
from .depth_fit import KINDS, LEAST_POINTS, SequenceFit, fit_sequence

DEPTH_VERSION = 1
"""Version of the fit, part of the key. Increase it when a change alters the fitted maps."""
_MOST_POINTS = 4000
"""Maximum number of the solve's points in a frame's fit, of each kind (surface, sparse)."""
_MIN_DEPTH = 1e-3
"""Least depth of a point in scene units. Also the least alpha by which a pixel's inverse depth is divided."""


@dataclass(frozen=True)
class DepthConfig:
    """Settings of depth supervision."""

    width: int = 480
    """Width in pixels of the fitted maps, at most that of the working frames. Depth networks work at about 500."""
    every: int = 4
    """Interval in steps of the depth loss, whose weight is multiplied by it. It costs nearly as much as a render."""
    weight: float = 0.08
    """Loss per standard deviation of a moving pixel's depth error, as a display-referred colour difference. With 0.02
    instead of 0.08, the depth error on the tests' tiny world was 1.3 instead of 1.1 % (`every` 1)."""


@dataclass
class FittedDepth:
    """Depth maps of a shot in scene units."""

    frames: list[int]
    """[F] frame numbers of the clip that have a map, ascending."""
    inverse: Tensor
    """float16 [F, h, w] inverse depth over the undistorted frames, 1 / scene units; 0 where unknown."""
    sigma: list[float]
    """[F] standard deviation of a frame's depth, or of its inverse depth if the maps are linear in inverse depth."""
    facts: dict[str, Any]
    """Facts for summary.json: `source`, `key`, `linear_in`, `residual`, `frames`, `of_frames`."""
    config: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """Settings of depth supervision."""

    def at(self, frame: int) -> Tensor | None:
        """Inverse depth of frame number `frame` and its standard deviation, float32 [2, h, w]; None without a map."""
        if frame not in self.frames:
            return None
        n = self.frames.index(frame)
        inverse, sigma = self.inverse[n].float(), self.sigma[n]
        in_inverse = self.facts["linear_in"] == KINDS[1]
        deviation = torch.full_like(inverse, sigma) if in_inverse else sigma * inverse.square()
        return torch.stack([inverse, deviation.clamp_min(1e-6)])

    def sized(self, frame: int, width: int, height: int) -> Tensor | None:
        """Result of `at` resized to [2, height, width] by nearest neighbour, which does not mix depths over edges."""
        found = self.at(frame)
        if found is None:
            return None
        return torch.nn.functional.interpolate(found[None], (height, width), mode="nearest-exact")[0]


class DepthTargets:
    """Target inverse depth of the moving pixels of training frames.

    Args:
        fitted: fitted depth maps.
        frames: [I] number of each training frame.
        movers: bool [I, H, W] moving pixels by the motion mattes.
    """

    def __init__(self, fitted: FittedDepth, frames: list[int], movers: Tensor) -> None:
        self._fitted, self._frames, self._movers = fitted, frames, movers
        self.every, self.weight = fitted.config.every, fitted.config.every * fitted.config.weight

    def at(self, frame: int) -> Tensor | None:
        """[2, H, W] target inverse depth (0: no target) and its standard deviation, in 1 / scene units.

        frame: position of the training frame. None if it has no targets.
        """
        movers = self._movers[frame].cpu()
        found = self._fitted.sized(self._frames[frame], movers.shape[1], movers.shape[0]) if movers.any() else None
        if found is None:
            return None
        found[0] = torch.where(movers, found[0], 0.0)
        return found if bool((found[0] > 0).any()) else None


def depth_pull(state: Mapping[str, Tensor], moves: Tensor | None, viewmat: Tensor, K: Tensor, target: Tensor) -> Tensor:
    """Depth loss of one view, 0-dim; see `deviation`.

    Its gradient only moves means along the camera's axis.

    Args:
        state: parameters at the frame's time, as returned by `DynamicModel.moved`.
        moves: bool [N] Gaussians that receive the gradient; None: all.
        viewmat: [4, 4] world-to-camera matrix. `K`: [3, 3] intrinsics for an image of H x W pixels.
        target: [2, H, W] target inverse depth (0: no target) and its standard deviation.
    """
    height, width = target.shape[1:]
    view = viewmat.detach()
    depth = state["means"] @ view[2, :3] + view[2, 3]
    if moves is not None:
        depth = torch.where(moves, depth, depth.detach())
    # A gradient to opacities and sizes would fade Gaussians that disagree with a noisy map: depth error 5.9 % and -2.6
    # dB on the tests' tiny world, against 0.9 % and -0.5 dB (500 steps, 2 % noise; 11.7 % without maps).
    means, quats, log_scales, opacities = (
        state[name].detach() for name in ("means", "quats", "log_scales", "opacity_logits")
    )
    inverse = 1.0 / depth.clamp_min(_MIN_DEPTH)
    moments = torch.stack([inverse, inverse.square()], dim=1)
    out = rasterize(
        means, quats, log_scales, opacities, moments, viewmats=view[None], Ks=K[None], width=width, height=height
    )
    return deviation(out.colors[0] / out.alphas[0].clamp_min(_MIN_DEPTH)[..., None], target)


def deviation(moments: Tensor, target: Tensor) -> Tensor:
    """Pseudo-Huber loss of the inverse depth error in standard deviations, averaged over all pixels; 0-dim.

    Args:
        moments: [H, W, 2] first and second moment of the inverse depth of each pixel's Gaussians. The second moment
            makes the loss penalise the error of each Gaussian, not only of their mean.
        target: as in `depth_pull`.
    """
    squared = moments[..., 1] - 2.0 * target[0] * moments[..., 0] + target[0].square()
    squared = torch.where(target[0] > 0, (squared / target[1].square()).clamp_min(0.0), 0.0)
    # Linear beyond one standard deviation: outliers of the map have a bounded gradient.
    return (torch.sqrt(1.0 + squared) - 1.0).mean()


def depth_key(sequence: DepthSequence, solve: str, config: DepthConfig | None = None) -> str:
    """Key of fitted maps by their files, the solve and the settings. The files need not be read."""
    return content_key(DEPTH_VERSION, sequence.key, solve, dataclasses.asdict(config or DepthConfig()))


def fitted_depth(
    sequence: DepthSequence, scene: Scene, key: str, folder: Path, report: Reporter, config: DepthConfig | None = None
) -> FittedDepth:
    """Depth maps of the solved frames, fitted to the scene's points. Fitted maps are stored in the run's `folder`.

    JobError (TRAIN) if no map is usable, or if the maps do not fit the solve. Unusable maps of single frames are
    skipped with one warning.
    """
    if _stored_key(folder / DEPTH_FILE) == key:
        return load_fitted(folder, key, config)
    config = config or DepthConfig()
    frames = [scene.frames[i] for i in scene.solved]
    width = min(config.width, scene.width)
    height = max(8, round(scene.height * width / scene.width))
    maps = _undistorted_maps(sequence, scene, width, height, report)
    refused = sequence.refused_words(len(frames))
    if not maps:
        raise JobError(
            refused, "A depth sequence has a picture for each frame: EXR floats, or 16-bit PNG or TIFF.", ExitCode.TRAIN
        )
    if refused:
        report.warning(refused, "These frames are trained without depth.")
    fit = fit_sequence(_samples(scene, maps, width, height))
    if fit is None:
        raise JobError(
            f"The depth sequence {sequence.source} cannot be fitted: the solve has too few points where it has depth.",
            "Train without it.",
            ExitCode.TRAIN,
        )
    if not fit.fits:
        raise JobError(
            f"The depth sequence {sequence.source} does not fit the solve: at the best scale and shift points are off "
            f"by {100 * fit.residual:.0f} %, and {100 * fit.unexplained:.0f} % of what it shows is not in the solve.",
            "Check that it is for this clip and numbered like its frames, or train without it.",
            ExitCode.TRAIN,
        )
    fitted = _fitted(sequence, maps, fit, key, len(frames), config)
    need_disk(folder, fitted.inverse.nbytes, "The depth of the frames")
    tensors = {"inverse": fitted.inverse, "sigma": torch.tensor(fitted.sigma), "frames": torch.tensor(fitted.frames)}
    save_checkpoint(folder / DEPTH_FILE, tensors, {"facts": fitted.facts})
    report.progress("depth", len(frames), len(frames), depth_line({"depth": fitted.facts}))
    return fitted


def load_fitted(folder: Path, key: str, config: DepthConfig | None = None) -> FittedDepth:
    """Loads the fitted maps in a run's folder. JobError (TRAIN) if they are missing, damaged or not those of `key`."""
    path = folder / DEPTH_FILE
    try:
        tensors, meta = load_checkpoint(path)
        inverse, frames, sigma = tensors["inverse"], tensors["frames"], tensors["sigma"]
        facts = meta["facts"]
        is_valid = inverse.dim() == 3 and inverse.dtype == torch.float16 and len(frames) == len(sigma) == len(inverse)
        if not is_valid or not is_json_object(facts) or facts.get("key") != key:
            raise ValueError("it belongs to another training")
        return FittedDepth(
            integers(frames), inverse, floats(sigma), facts,
            config or DepthConfig(),
        )  # fmt: skip
    except (JobError, OSError, ValueError, KeyError) as error:
        raise JobError(
            f"The depth of the run's frames, {path}, is missing, damaged or from another training.",
            "Train it again, with the same depth sequence.",
            ExitCode.TRAIN,
        ) from error


def _stored_key(path: Path) -> str:
    """Key of the maps in a file; empty if the file is missing or damaged."""
    facts = read_meta(path).get("facts") if path.is_file() else None
    return str(facts.get("key", "")) if is_json_object(facts) else ""


def _undistorted_maps(
    sequence: DepthSequence, scene: Scene, width: int, height: int, report: Reporter
) -> dict[int, NDArray[np.float32]]:
    """Frame number -> map [height, width] resampled to the undistorted frame; NaN outside the map."""
    lenses = load_plate_lenses(Shot(scene.folder.parent))
    maps: dict[int, NDArray[np.float32]] = {}
    lens: PlateLens | MapLens | None = None
    source_pixels = np.zeros((0, 0, 2), np.float32)
    for done, index in enumerate(scene.solved, start=1):
        report.check_cancelled()
        frame = scene.frames[index]
        values = sequence.read(frame)
        report.progress("depth", done, len(scene.solved), f"frame {frame}")
        if values is None:
            continue
        if lenses[frame] is not lens:  # a clip has one lens, a zoom has one per frame
            lens = lenses[frame]
            source_pixels = lens.where(width, height)
        h, w = values.shape
        x = np.floor(source_pixels[..., 0] * (w / width)).astype(np.int64)
        y = np.floor(source_pixels[..., 1] * (h / height)).astype(np.int64)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        maps[frame] = np.where(inside, values[y.clip(0, h - 1), x.clip(0, w - 1)], np.float32(np.nan))
    return maps


def _samples(
    scene: Scene, maps: dict[int, NDArray[np.float32]], width: int, height: int
) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Frame -> (map values, depths) at the solve's points.

    Uses points of still surfaces seen in the nearest key frame, or the sparse points if there are too few.
    """
    surface, _, of_frame = surface_of(scene)
    keys = np.array(of_frame, np.int64)
    places = np.unique(keys)
    sparse, still = _thinned(scene.points.double().numpy()), surface.double().numpy()
    Ks = resize_intrinsics(scene.Ks, scene.width, scene.height, width, height).double().numpy()
    samples: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    for index in scene.solved:
        frame = scene.frames[index]
        if frame not in maps:
            continue
        points = sparse
        if len(places):
            seen = _thinned(still[keys == places[np.abs(places - frame).argmin()]])
            points = seen if len(seen) >= LEAST_POINTS else sparse  # some are occluded; the fit is robust
        view, K = scene.viewmats[index].double().numpy(), Ks[index]
        local = points @ view[:3, :3].T + view[:3, 3]
        local = local[local[:, 2] > _MIN_DEPTH]
        depth = local[:, 2]
        x = np.floor(local[:, 0] / depth * K[0, 0] + K[0, 2])
        y = np.floor(local[:, 1] / depth * K[1, 1] + K[1, 2])
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        values = maps[frame][y[inside].astype(np.int64), x[inside].astype(np.int64)].astype(np.float64)
        known = np.isfinite(values)
        samples[frame] = values[known], depth[inside][known]
    return samples


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points[:: max(1, -(-len(points) // _MOST_POINTS))]


def _fitted(
    sequence: DepthSequence, maps: dict[int, NDArray[np.float32]], fit: SequenceFit, key: str, of_frames: int,
    config: DepthConfig,
) -> FittedDepth:  # fmt: skip
    frames = sorted(maps)
    # The largest float16 is 65,504.
    inverse = [np.minimum(fit.frames[n].inverse_of(maps[n], fit.kind), 6e4).astype(np.float16) for n in frames]
    facts = {
        "source": str(sequence.source),
        "key": key,
        "linear_in": fit.kind,
        "residual": round(fit.residual, 5),
        "frames": len(frames),
        "of_frames": of_frames,
    }
    sigma = [fit.frames[frame].sigma for frame in frames]
    return FittedDepth(frames, from_numpy(np.stack(inverse)), sigma, facts, config)
