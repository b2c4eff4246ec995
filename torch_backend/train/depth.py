"""Depth maps of an artist's, fitted to the solve: what a training pulls moving Gaussians to, and a freeze measures by.

runs/NAME/depth.safetensors holds them: inverse depth over the undistorted frames, in 1 / scene units, with each frame's
uncertainty. A run is known by the files, the solve and `DepthConfig`; what is kept beside it is trusted only if it
carries the same key.
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
"""Changes when the same maps would be fitted otherwise."""
_MOST_POINTS = 4000
"""Points of the solve that a frame's fit looks at, of each kind."""
_AHEAD = 1e-3
"""Least depth of a point that counts, scene units; and least share of a pixel that Gaussians cover."""


@dataclass(frozen=True)
class DepthConfig:
    """How depth maps are used."""

    width: int = 480
    """Width in pixels at which fitted maps are kept; less for smaller working frames. Networks work at about 500."""
    every: int = 4
    """Steps from one pull to the next; each counts for all of them. A pull takes nearly as long as a step's picture."""
    weight: float = 0.08
    """Colour difference, display-referred, that each standard deviation of a moving pixel's depth counts for. With 0.02
    in place of 0.08 the error of depth on the tests' tiny world was 1.3 instead of 1.1 % (`every` 1)."""


@dataclass
class FittedDepth:
    """Depth maps of a shot in scene units."""

    frames: list[int]
    """[F] frame numbers of the clip that have a map, ascending."""
    inverse: Tensor
    """float16 [F, h, w] inverse depth over the undistorted frames, 1 / scene units, 0 where it is not known."""
    sigma: list[float]
    """[F] standard deviation of a frame's depth, scene units, or of its inverse: of what the maps are linear in."""
    facts: dict[str, Any]
    """As summary.json has them: `source`, `key`, `linear_in`, `residual`, `frames`, `of_frames`."""
    config: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """What it is used with."""

    def at(self, frame: int) -> Tensor | None:
        """Inverse depth of a frame by its number, and its standard deviation, float32 [2, h, w]; None without a map."""
        if frame not in self.frames:
            return None
        n = self.frames.index(frame)
        inverse, sigma = self.inverse[n].float(), self.sigma[n]
        in_inverse = self.facts["linear_in"] == KINDS[1]
        deviation = torch.full_like(inverse, sigma) if in_inverse else sigma * inverse.square()
        return torch.stack([inverse, deviation.clamp_min(1e-6)])

    def sized(self, frame: int, width: int, height: int) -> Tensor | None:
        """The same, [2, height, width], each pixel from the nearest of the map: nothing is mixed over edges."""
        found = self.at(frame)
        if found is None:
            return None
        return torch.nn.functional.interpolate(found[None], (height, width), mode="nearest-exact")[0]


class DepthTargets:
    """Inverse depth that the pixels of trained frames should have where something moves.

    Args:
        fitted: the maps.
        frames: [I] number of each trained frame.
        movers: bool [I, H, W] what moves in it by the motion mattes.
    """

    def __init__(self, fitted: FittedDepth, frames: list[int], movers: Tensor) -> None:
        self._fitted, self._frames, self._movers = fitted, frames, movers
        self.every, self.weight = fitted.config.every, fitted.config.every * fitted.config.weight

    def at(self, frame: int) -> Tensor | None:
        """Inverse depth of the trained frame at position `frame`, 0 where nothing is asked, and its standard deviation,
        [2, H, W] in 1 / scene units; None if nothing is asked of it."""
        movers = self._movers[frame].cpu()
        found = self._fitted.sized(self._frames[frame], movers.shape[1], movers.shape[0]) if movers.any() else None
        if found is None:
            return None
        found[0] = torch.where(movers, found[0], 0.0)
        return found if bool((found[0] > 0).any()) else None


def depth_pull(state: Mapping[str, Tensor], moves: Tensor | None, viewmat: Tensor, K: Tensor, wanted: Tensor) -> Tensor:
    """How far the Gaussians of a view are from the depth that they should have, 0-dim, see `deviation`.

    The gradient moves means along the camera's axis and does nothing else. Through the rendered depth it would also
    reach opacities and sizes, and a noisy map would fade what it disagrees with: on the tests' tiny world that left an
    error of 5.9 % and cost 2.6 dB, this 0.9 % and 0.5 dB (500 steps, maps of 2 % noise, 11.7 % without maps).

    Args:
        state: parameters at the frame's time, as `DynamicModel.moved` gives them.
        moves: bool [N] which Gaussians are pulled; None: all.
        viewmat: [4, 4] world-to-camera. `K`: [3, 3] pixels of a picture of H x W.
        wanted: [2, H, W] inverse depth, 0 where nothing is asked, and its standard deviation.
    """
    height, width = wanted.shape[1:]
    view = viewmat.detach()
    depth = state["means"] @ view[2, :3] + view[2, 3]
    if moves is not None:
        depth = torch.where(moves, depth, depth.detach())
    means, quats, log_scales, opacities = (
        state[name].detach() for name in ("means", "quats", "log_scales", "opacity_logits")
    )
    inverse = 1.0 / depth.clamp_min(_AHEAD)
    moments = torch.stack([inverse, inverse.square()], dim=1)
    out = rasterize(
        means, quats, log_scales, opacities, moments, viewmats=view[None], Ks=K[None], width=width, height=height
    )
    return deviation(out.colors[0] / out.alphas[0].clamp_min(_AHEAD)[..., None], wanted)


def deviation(moments: Tensor, wanted: Tensor) -> Tensor:
    """Mean over all pixels of the Pseudo-Huber loss of how many standard deviations inverse depth is off, 0-dim.

    Args:
        moments: [H, W, 2] mean of the inverse depth of a pixel's Gaussians, and of its square: each of them has to be
            right, not their mean alone.
        wanted: as in `depth_pull`.

    Linear beyond one standard deviation, so that a wrong pixel of the map pulls no more than a right one.
    """
    squared = moments[..., 1] - 2.0 * wanted[0] * moments[..., 0] + wanted[0].square()
    squared = torch.where(wanted[0] > 0, (squared / wanted[1].square()).clamp_min(0.0), 0.0)
    return (torch.sqrt(1.0 + squared) - 1.0).mean()


def depth_key(sequence: DepthSequence, solve: str, config: DepthConfig | None = None) -> str:
    """Identifies fitted maps before they are read: by their files, the solve and what is done with them."""
    return content_key(DEPTH_VERSION, sequence.key, solve, dataclasses.asdict(config or DepthConfig()))


def fitted_depth(
    sequence: DepthSequence, scene: Scene, key: str, folder: Path, report: Reporter, config: DepthConfig | None = None
) -> FittedDepth:
    """The maps of the scene's solved frames, fitted to its points; from the run's `folder` if they are there.

    A new fit is written there. JobError (TRAIN) if no map can be used, or if they do not fit the solve; maps of single
    frames that cannot be used are left out, and said in one sentence.
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
            "Check that it is of this clip and numbered as its frames, or train without it.",
            ExitCode.TRAIN,
        )
    fitted = _fitted(sequence, maps, fit, key, len(frames), config)
    need_disk(folder, fitted.inverse.nbytes, "The depth of the frames")
    tensors = {"inverse": fitted.inverse, "sigma": torch.tensor(fitted.sigma), "frames": torch.tensor(fitted.frames)}
    save_checkpoint(folder / DEPTH_FILE, tensors, {"facts": fitted.facts})
    report.progress("depth", len(frames), len(frames), depth_line({"depth": fitted.facts}))
    return fitted


def load_fitted(folder: Path, key: str, config: DepthConfig | None = None) -> FittedDepth:
    """The maps that lie beside a run. JobError (TRAIN) if they are damaged, missing, or not those of `key`."""
    path = folder / DEPTH_FILE
    try:
        tensors, meta = load_checkpoint(path)
        inverse, frames, sigma = tensors["inverse"], tensors["frames"], tensors["sigma"]
        facts = meta["facts"]
        whole = inverse.dim() == 3 and inverse.dtype == torch.float16 and len(frames) == len(sigma) == len(inverse)
        if not whole or not is_json_object(facts) or facts.get("key") != key:
            raise ValueError("it is of another training")
        return FittedDepth(
            integers(frames), inverse, floats(sigma), facts,
            config or DepthConfig(),
        )  # fmt: skip
    except (JobError, OSError, ValueError, KeyError) as error:
        raise JobError(
            f"The depth of the run's frames, {path}, is missing, damaged or of another training.",
            "Train it again, with the same depth sequence.",
            ExitCode.TRAIN,
        ) from error


def _stored_key(path: Path) -> str:
    """Key of the maps in a file; empty if there is none."""
    facts = read_meta(path).get("facts") if path.is_file() else None
    return str(facts.get("key", "")) if is_json_object(facts) else ""


def _undistorted_maps(
    sequence: DepthSequence, scene: Scene, width: int, height: int, report: Reporter
) -> dict[int, NDArray[np.float32]]:
    """Frame number -> values [height, width] of its map over the undistorted frame, NaN where there are none."""
    lenses = load_plate_lenses(Shot(scene.folder.parent))
    maps: dict[int, NDArray[np.float32]] = {}
    lens: PlateLens | MapLens | None = None
    where = np.zeros((0, 0, 2), np.float32)
    for done, index in enumerate(scene.solved, start=1):
        report.check_cancelled()
        frame = scene.frames[index]
        values = sequence.read(frame)
        report.progress("depth", done, len(scene.solved), f"frame {frame}")
        if values is None:
            continue
        if lenses[frame] is not lens:  # a clip has one, a zoom one per frame
            lens = lenses[frame]
            where = lens.where(width, height)
        h, w = values.shape
        x = np.floor(where[..., 0] * (w / width)).astype(np.int64)
        y = np.floor(where[..., 1] * (h / height)).astype(np.int64)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        maps[frame] = np.where(inside, values[y.clip(0, h - 1), x.clip(0, w - 1)], np.float32(np.nan))
    return maps


def _samples(
    scene: Scene, maps: dict[int, NDArray[np.float32]], width: int, height: int
) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Frame -> (values of its map, depths of the solve's points there): of still surfaces that the nearest key frame
    shows, else sparse points. Some of these are hidden in a frame: the fit is robust."""
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
            points = seen if len(seen) >= LEAST_POINTS else sparse
        view, K = scene.viewmats[index].double().numpy(), Ks[index]
        local = points @ view[:3, :3].T + view[:3, 3]
        local = local[local[:, 2] > _AHEAD]
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
