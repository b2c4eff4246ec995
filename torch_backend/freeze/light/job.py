"""The light job: renders a take's frozen scene from a point to takes/NAME/panorama/KEY.exr and KEY.json."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...cameras.placement import Similarity, camera_to_world, path_viewmats, placement_for
from ...cameras.stored import load_cameras
from ...contract import (
    ExitCode,
    JobError,
    LightFacts,
    LightParams,
    Placement,
    Reporter,
    TakeFolder,
    file_digest,
    light_of_take,
    placement_of,
    point_of,
    read_json,
)
from ...footage.display import Display
from ...gaussians.ply import PlyGaussians, read_ply
from ...raster import RasterSettings, rasterize
from ...raster.reference import rotation_matrices, sh_basis
from ...scene import Scene, evenly_spaced, load_scene
from ...shot import Shot, content_key, disk_error, is_disk_full, write_json
from ...torch_types import from_numpy, norm
from ...train import LoadedRun, load_run
from ..exr import linear_spec, write_exr
from ..take.frames import scene_linear
from ..take.splats import refuse_other_solve
from . import sphere

LIGHT_VERSION = 1
"""Version of panoramas. Raise it when older ones must not be used any more."""
_CHANNELS = ("R", "G", "B")


@dataclass
class LightConfig:
    """Parameters of the panorama."""

    width: int = 1024
    """Width in pixels. The height is half of it and must be 32 times a power of two. A pixel is a third of a degree,
    which is visible in mirrors but not on matt surfaces."""
    near: float = 0.02
    """Distance to the point, as a share of the median distance, below which splats are left out. They fade in up to
    twice that distance. Such a splat would cover a large part of the sphere."""
    inside: float = 3.0
    """Distance to the point, in standard deviations of a splat, below which the splat is left out. A projection that is
    linearised at its centre would smear it across a whole face."""
    wide: float = 0.3
    """Largest standard deviation of a splat, as a share of its distance (17 degrees), above which it is left out. It
    would extend over several faces and have a different shape in each."""
    cone: float = 0.34
    """Cosine of the largest angle between a face's axis and a splat that it shows, 70 degrees. Splats at larger angles
    have their centres in other faces, and the linearised projection is not valid for them."""
    cameras: int = 24
    """Largest number of the clip's cameras that are compared to choose the viewing direction of a splat's colour."""


def make_light(
    shot: Shot, params: LightParams, report: Reporter, config: LightConfig | None = None
) -> dict[str, Any]:  # fmt: skip
    """Renders a take's frozen scene from a point into a panorama, unless it already exists.

    The panorama is equirectangular, scene-linear Rec.709, half floats, in the scene's axes, as Blender's Environment
    Texture reads it. Returns {take, key, light: file, position: [x, y, z], filled: share of the sphere that no splat
    covers, made: bool}. JobError if it cannot be rendered; ValueError if position or placement are invalid.
    """
    config = config or LightConfig()
    point = np.array(point_of(params.position))
    folder = TakeFolder(shot.own(shot.take(params.take)))
    if not folder.facts.is_file() or not folder.ply.is_file():
        message = f"{shot.root.name} has no finished take {params.take!r} with splats."
        raise JobError(message, "Freeze it first.", ExitCode.FREEZE)
    refuse_other_solve(shot, read_json(folder.facts))
    placement = placement_for(shot, params.placement)
    digest = file_digest(folder.facts)
    key = content_key(LIGHT_VERSION, digest, file_digest(folder.ply), point.tolist(), placement.to_json(), vars(config))
    facts = light_of_take(folder, key)
    is_new = facts is None
    if facts is None:
        facts = _rendered(shot, folder, key, point, placement, report, config)
    return {
        "take": params.take,
        "key": key,
        "light": str(folder.light(key)),
        "position": facts.position,
        "filled": facts.filled,
        "made": is_new,
    }


def _rendered(
    shot: Shot,
    folder: TakeFolder,
    key: str,
    point: NDArray[np.float64],
    placement: Placement,
    report: Reporter,
    config: LightConfig,
) -> LightFacts:
    """Renders, fills and writes a panorama. JobError if no splat is visible from the point, or if the disk is full."""
    report.progress("making the light", 0, len(sphere.FACES) + 1, "reading splats")
    record, scene = read_json(folder.facts), load_scene(shot)
    left = Similarity.of(placement_of(record))  # placement of the splats in the file
    change = Similarity.of(placement).after(left.inverse())
    cameras = left.points(camera_to_world(path_viewmats(load_cameras(shot)))[:, :3, 3])
    kept = cameras[evenly_spaced(len(cameras), config.cameras)]
    splats = seen_from(read_ply(folder.ply), change.inverse().points(point), kept, config)
    splats.colors = _exposed(shot, record, scene, splats.colors, report)
    seen = render_panorama(splats, change.rotation, scene.display, config, report)
    try:
        light, share = sphere.filled(seen)
    except ValueError:
        raise JobError(
            "No splat of the take is seen from that point.",
            "Choose a point within the area that the clip shows.",
            ExitCode.USAGE,
        ) from None
    facts = LightFacts("", [float(x) for x in point], share, placement.to_json())
    try:
        write_panorama(folder.light(key), light)
        facts.picture = file_digest(folder.light(key))
        write_json(folder.light_facts(key), facts.to_json())
    except OSError as error:
        raise (disk_error(folder.root) if is_disk_full(error) else error) from error
    report.progress("making the light", len(sphere.FACES) + 1, len(sphere.FACES) + 1, f"{share:.0%} filled")
    return facts


# ------------------------------------------------------------------------------------------------- the splats


@dataclass
class SeenSplats:
    """N splats around a point, which is the origin; the unit of length is their median distance."""

    means: Tensor
    """[N, 3] float32."""
    quats: Tensor
    """[N, 4] float32, wxyz."""
    log_scales: Tensor
    """[N, 3] float32."""
    opacity_logits: Tensor
    """[N] float32."""
    colors: Tensor
    """[N, 3] float32, display-referred, 0 or above."""


def seen_from(
    splats: PlyGaussians, point: NDArray[np.float64], cameras: NDArray[np.float64], config: LightConfig
) -> SeenSplats:
    """Splats relative to a point [3], with the colours seen by the clip's cameras at [C, 3]; all in one space.

    Each splat gets its colour for the camera whose viewing direction is nearest to the point's. Splats that would smear
    are left out, see `LightConfig`. JobError if there are no splats around the point.
    """
    means = from_numpy(splats.means).double() - from_numpy(point)
    distances = norm(means, dim=-1)
    unit = float(distances.median()) if len(distances) else 0.0
    if not unit > 0.0:
        raise JobError("The take has no splats around that point.", "Choose another point.", ExitCode.USAGE)
    means, distances = means / unit, distances / unit
    quats, log_scales = from_numpy(splats.quats), from_numpy(splats.log_scales).double() - np.log(unit)
    within = (means[:, None] @ rotation_matrices(quats.double()))[:, 0] / log_scales.exp().clamp_min(1e-12)
    share = (distances / config.near - 1.0).clamp(0.0, 1.0) * (norm(within, dim=-1) > config.inside)
    share = share * (log_scales.exp().amax(-1) < config.wide * distances)
    opacity = torch.sigmoid(from_numpy(splats.opacity_logits).double()) * share
    rows = share > 0.0
    towards = (from_numpy(cameras) - from_numpy(point)) / unit
    return SeenSplats(
        means[rows].float(),
        quats[rows],
        log_scales[rows].float(),
        torch.logit(opacity[rows].clamp(1e-6, 1.0 - 1e-6)).float(),
        _colors(from_numpy(splats.sh)[rows], means[rows].float(), towards.float()),
    )


def _colors(sh: Tensor, means: Tensor, cameras: Tensor) -> Tensor:
    """[N, 3] colours of harmonics [N, K, 3] at means [N, 3], for the nearest viewing direction of `cameras` [C, 3].

    The nearest direction is the one with the smallest angle to the direction from the origin to the mean.
    """
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]]
    directions = means / norm(means, dim=-1, keepdim=True)
    best, along = torch.full((len(means),), -2.0), directions.clone()
    for camera in cameras if degree else ():
        ray = means - camera
        ray = ray / norm(ray, dim=-1, keepdim=True).clamp_min(1e-9)
        cosine = (ray * directions).sum(-1)
        # Harmonics are arbitrary in directions in which no camera of the clip looked.
        along = torch.where((cosine > best)[:, None], ray, along)
        best = torch.maximum(best, cosine)
    return ((sh_basis(along, degree)[..., None] * sh).sum(1) + 0.5).clamp_min(0.0)


def _exposed(shot: Shot, facts: dict[str, Any], scene: Scene, colors: Tensor, report: Reporter) -> Tensor:
    """Colours [N, 3] with the exposure of the clip's camera at t*; unchanged if the take's run no longer exists."""
    try:
        run = load_run(shot, str(facts.get("run", "")))
    except (JobError, ValueError):
        run = None
    if run is None or run.stamp != facts.get("checkpoint"):
        report.warning(
            "The run of this take was trained again or removed: the light has the mean exposure, not the one at t*.",
            "Freeze the take again.",
        )
        return colors
    return exposed_as(run, scene, float(facts["t_star_frame"]), colors)


def exposed_as(run: LoadedRun, scene: Scene, frame: float, colors: Tensor) -> Tensor:
    """Display-referred colours [N, 3], not negative, with the camera's exposure at a frame of the clip."""
    exposure = run.model.exposure
    if not exposure.config.on:
        return colors
    with torch.no_grad():
        gain, offset = exposure.at(scene.time_of_frame(frame))
        return (colors * gain + offset).clamp_min(0.0)


# ------------------------------------------------------------------------------------------------- the picture


def render_panorama(
    splats: SeenSplats, turn: NDArray[np.float64], display: Display, config: LightConfig, report: Reporter
) -> NDArray[np.float32]:
    """[width / 2, width, 4] panorama of splats, scene-linear, premultiplied by coverage.

    `turn` [3, 3] rotates the splats' axes to those of the panorama.
    """
    focal, side = sphere.face_camera(config.width)
    K = torch.tensor([[focal, 0.0, side / 2.0], [0.0, focal, side / 2.0], [0.0, 0.0, 1.0]])
    distances = norm(splats.means, dim=-1)
    done = 0

    def face(rotation: NDArray[np.float64]) -> NDArray[np.float32]:
        nonlocal done
        report.progress("making the light", done, len(sphere.FACES) + 1, f"face {done + 1} of {len(sphere.FACES)}")
        report.check_cancelled()
        done += 1
        viewmat = torch.eye(4)
        viewmat[:3, :3] = from_numpy(rotation @ turn).float()
        rows = splats.means @ viewmat[2, :3] > config.cone * distances
        with torch.no_grad():
            out = rasterize(
                splats.means[rows],
                splats.quats[rows],
                splats.log_scales[rows],
                splats.opacity_logits[rows],
                splats.colors[rows],
                viewmats=viewmat[None],
                Ks=K[None],
                width=side,
                height=side,
                settings=RasterSettings(near=0.5 * config.cone * config.near),
            )
        return scene_linear(out.colors[0].numpy(), out.alphas[0].clamp(0.0, 1.0).numpy(), display)

    return sphere.panorama(config.width, face)


def write_panorama(path: Path, light: NDArray[np.float32]) -> Path:
    """Writes a panorama [H, W, 3] of linear Rec.709 as half floats, atomically. OSError if it cannot be written."""
    height, width = light.shape[:2]
    return write_exr(path, linear_spec(width, height, _CHANNELS, (oiio.HALF,) * 3), [light])
