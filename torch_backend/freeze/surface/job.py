"""The surface job: fuses the frozen frames of a take to a mesh, takes/NAME/surface.ply."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ...cameras.placement import Similarity
from ...contract import (
    LIVE_SOURCE,
    NO_DEPTH,
    TRIANGLE_FIELDS,
    VERTEX_FIELDS,
    ExitCode,
    JobError,
    Reporter,
    SurfaceHeader,
    SurfaceParams,
    TakeFolder,
    file_digest,
    open_regular,
    placement_of,
    read_json,
    read_surface_header,
    surface_of_take,
)
from ...footage.color import linear_to_srgb8
from ...scene import evenly_spaced, resize_intrinsics
from ...shot import Shot, atomic_path, disk_error, is_disk_full
from ...torch_types import from_numpy
from ..exr import read_frozen_exr
from ..take.folder import frames_of
from .dressed import Surface, dress
from .nets import extract
from .volume import SurfaceConfig, View, fuse


def make_surface(
    shot: Shot, params: SurfaceParams, report: Reporter, config: SurfaceConfig | None = None
) -> dict[str, Any]:
    """Makes the surface of a take, in the axes and units of its exported splats, unless it already exists.

    Returns {take, surface: file, vertices, triangles, people: number of triangles that move in the clip, made: bool}.
    JobError if it cannot be made.
    """
    config = config or SurfaceConfig()
    folder = TakeFolder(shot.own(shot.take(params.take)))
    if not folder.facts.is_file():
        raise JobError(f"{shot.root.name} has no finished take {params.take!r}.", "Freeze it first.", ExitCode.FREEZE)
    facts = read_json(folder.facts)
    if facts.get("t_star_per_frame"):
        raise JobError(
            f"Time does not stand still in the take {params.take!r}: its t* was keyed.",
            "Freeze a take at one instant, and create its surface.",
            ExitCode.USAGE,
        )
    if _has_living(facts):
        raise JobError(
            f"Something keeps moving in the take {params.take!r}, so no surface fits all frames.",
            "Create the surface of the take that it was combined from.",
            ExitCode.USAGE,
        )
    key = file_digest(folder.facts)
    header = surface_of_take(folder)
    is_new = header is None
    if header is None:
        surface = _fused(folder, config, report)
        transform = Similarity.of(placement_of(facts))
        placed = transform.points(surface.vertices).astype(np.float32)
        header = SurfaceHeader(key, len(placed), len(surface.triangles))
        try:
            write_surface(folder.surface, header, placed, surface)
        except OSError as error:
            raise (disk_error(folder.root) if is_disk_full(error) else error) from error
    people = int(read_surface(folder.surface)[1]["people"].sum())
    return {
        "take": params.take,
        "surface": str(folder.surface),
        "vertices": header.vertices,
        "triangles": header.triangles,
        "people": people,
        "made": is_new,
    }


def _has_living(facts: dict[str, Any]) -> bool:
    """True for a combined take with an object from the live plate."""
    combined = facts.get("combined")
    things = cast("dict[str, Any]", combined).get("things") if isinstance(combined, dict) else None
    return isinstance(things, dict) and LIVE_SOURCE in cast("dict[str, Any]", things).values()


def _fused(folder: TakeFolder, config: SurfaceConfig, report: Reporter) -> Surface:
    """The surface of a take's frames, in solve units. JobError if the frames have no depth or give no surface."""
    frames = frames_of(folder)
    chosen = [frames[i] for i in evenly_spaced(len(frames), min(config.views, len(frames)))]
    views: list[View] = []
    for done, number in enumerate(chosen):
        report.progress("making the surface", done, 2 * len(chosen), f"frame {number}")
        report.check_cancelled()
        views.append(view_of(folder.frame(number), config))
    seen = [v.depth[v.depth > 0] for v in views]
    if not any(len(depth) for depth in seen):
        raise JobError("The frames of the take have no depth.", "Freeze the take again.", ExitCode.FREEZE)
    far = float(np.quantile(np.concatenate(seen), config.far))
    for view in views:
        view.depth[view.depth > far] = 0.0

    def report_progress(share: float) -> None:
        report.progress("making the surface", round(len(chosen) * (1 + share)), 2 * len(chosen), "fusing depth")
        report.check_cancelled()

    volume = fuse(views, config, progress=report_progress)
    vertices, triangles = extract(volume)
    if not len(triangles):
        raise JobError("The frames of the take show no surface.", "Freeze more frames of it.", ExitCode.FREEZE)
    cut = (volume.cut * volume.space.scale(vertices)).astype(np.float32)
    surface = dress(vertices, triangles, views, cut, config.part)
    report.progress("making the surface", 2 * len(chosen), 2 * len(chosen), f"{len(surface.triangles)} triangles")
    return surface


def view_of(path: Path, config: SurfaceConfig) -> View:
    """A frozen frame resized for fusing, in solve units. ValueError if the EXR cannot be read."""
    frame = read_frozen_exr(path)
    height, width = frame.depth.shape
    w = min(width, config.width)
    h = max(1, round(height * w / width))
    K = from_numpy(frame.metadata.K.astype(np.float64))
    K[0, 2] += frame.margin[0]
    K[1, 2] += frame.margin[1]

    def small(layer: NDArray[Any], method: int = cv2.INTER_AREA) -> NDArray[Any]:
        return cv2.resize(layer, (w, h), interpolation=method)

    # INTER_NEAREST takes the first pixel of every block, which is half a block away from the new pixel's centre.
    depth = small(frame.depth, cv2.INTER_NEAREST_EXACT)
    sigma = frame.more.get("DepthSigma")  # takes of earlier versions lack it
    error = np.zeros_like(depth) if sigma is None else small(sigma, cv2.INTER_NEAREST_EXACT)
    is_known = (depth < NO_DEPTH) & (depth > 0) & (small(frame.rgba[..., 3]) > 0.5)
    return View(
        frame.metadata.viewmat.astype(np.float64),
        resize_intrinsics(K[None], width, height, w, h)[0].numpy(),
        np.where(is_known, depth, 0.0).astype(np.float32),
        error.astype(np.float32),
        linear_to_srgb8(np.clip(small(frame.rgba[..., :3]), 0.0, 1.0)),
        small(frame.motion),
    )


def write_surface(path: Path, header: SurfaceHeader, vertices: NDArray[np.float32], surface: Surface) -> None:
    """Writes a surface with placed vertices [V, 3], atomically. OSError if it cannot be written."""
    points = np.zeros(len(vertices), np.dtype(list(VERTEX_FIELDS)))
    for n, (place, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        points[place], points[color] = vertices[:, n], surface.colors[:, n]
    faces = np.zeros(len(surface.triangles), np.dtype(list(TRIANGLE_FIELDS)))
    faces["corners"], faces["people"] = 3, surface.people
    for n, corner in enumerate("abc"):
        faces[corner] = surface.triangles[:, n]
    with atomic_path(path) as partial, open(partial, "wb") as handle:
        handle.write(header.to_bytes())
        handle.write(points.data)  # `tofile` would not report a full disk
        handle.write(faces.data)


def read_surface(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """(vertices, triangles) of a file of `write_surface`, with `VERTEX_FIELDS` and `TRIANGLE_FIELDS`. ValueError for
    other files."""
    with open_regular(path) as handle:
        header = read_surface_header(handle, path)
        vertices = np.frombuffer(handle.read(header.vertices * 15), np.dtype(list(VERTEX_FIELDS)))
        return vertices, np.frombuffer(handle.read(), np.dtype(list(TRIANGLE_FIELDS)))
