"""Renders the frames of a take one by one, and writes them with their layers, warps and previews."""

from __future__ import annotations

import functools
from collections.abc import Callable, Set

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...contract import (
    NO_DEPTH,
    Reporter,
    TakeFolder,
)
from ...footage.color import in_light, light_matrix, on_straight_colour
from ...footage.display import Display
from ...footage.images import write_png
from ...scene import Scene
from ...shot import disk_error, is_disk_full, need_disk
from ...torch_types import from_numpy
from .. import exr_rows
from ..bands import bands
from ..composite import grain, transfer
from ..composite.compositor import CompositeFrame
from ..composite.grain import Brush, Grain
from ..composite.transfer import straight_to_linear, to_display
from ..composite.warp import WarpMetadata, write_warp
from ..deep_exr import write_deep_exr
from ..exr import DetailLayers, FrameMetadata, LazyLayer, write_frozen_exr
from ..frozen import FrozenGaussians, FrozenImage, OutputFrame, render_frozen
from ..views.reproject import resized
from .background_writer import BackgroundWriter
from .debug_terms import origin_terms, write_terms
from .deep import DeepSamples, deep_samples
from .motion_blur import MotionBlur, kept_grain
from .plan import FrameSpec, PlannedTake


def make_ready(take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter) -> None:
    """Develops the instants of the `frames` that are not in `done`. JobError if the disk has no room for the frames."""
    spec, missing = take.spec, [f for f in frames if f.frame not in done]
    bytes_per_frame = (
        spec.whole[0]
        * spec.whole[1]
        * (
            20.0
            + (6.0 if spec.grain else 0.0)
            + (24.0 if spec.detail else 0.0)
            + (26.0 if spec.passes else 0.0)
            + (14.0 if spec.deep else 0.0)
        )
    )
    need_disk(take.folder.root, len(missing) * bytes_per_frame, "the take")
    spec.instants.prepare((f.t_star for f in missing), report)


def render_frames(
    take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter,
    before_each: Callable[[], None] | None = None,
) -> dict[int, Tensor]:  # fmt: skip
    """Renders and writes the `frames` that are not in `done`, if the disk has room for them.

    `before_each` is called before each frame is written; its exceptions end rendering. Returns frame number -> [h, w]
    share of plate (see `small_share`) of the rendered frames. JobError if the disk is full.
    """
    make_ready(take, frames, done, report)
    try:
        return _render_all(take, frames, done, report, before_each)
    except OSError as error:
        raise (disk_error(take.folder.root) if is_disk_full(error) else error) from error


def _render_all(
    take: PlannedTake, frames: list[OutputFrame], done: Set[int], report: Reporter,
    before_each: Callable[[], None] | None,
) -> dict[int, Tensor]:  # fmt: skip
    folder, scene, spec, keys = take.folder, take.scene, take.spec, take.keys
    done = done if spec.debug_terms is None else set()  # debug terms of existing frames are not stored
    shares: dict[int, Tensor] = {}
    for module in (exr_rows, grain, transfer):  # kernels that the writer's thread runs
        module.warm_up()
    with BackgroundWriter() as out:
        for n, output in enumerate(frames):
            report.check_cancelled()
            report.progress("freezing", n, len(frames), f"frame {output.frame}")
            if output.frame in done:
                continue
            image = _render(output, scene, spec, report)
            deep = None if spec.deep is None else _deep(output, image, scene, spec, report)
            if isinstance(image, CompositeFrame):
                shares[output.frame] = small_share(image.plate, image.support)
            if before_each is not None:
                before_each()
            write = functools.partial(_write, folder, output, image, deep, scene, spec, keys[output.frame])
            out.write(write, sum(value.nbytes for value in vars(image).values() if isinstance(value, Tensor)))
            del image, deep, write  # frees 1 GB at 4K for the next frame
    report.progress("freezing", len(frames), len(frames), f"{len(frames)} frames")
    return shares


def _render(output: OutputFrame, scene: Scene, spec: FrameSpec, report: Reporter) -> FrozenImage | CompositeFrame:
    """A frame of the take, from splats or plates. With motion blur, only colour and alpha are blurred."""
    frozen = spec.instants.at(output.t_star, report)
    K = whole_camera(output, spec)
    image, frame = _composited(output, frozen, scene, spec)
    if spec.debug_terms is not None and isinstance(frame, CompositeFrame):
        h, w = frame.terms["motion"].shape
        frame.terms |= origin_terms(frozen, output.viewmat, K, spec.whole, spec.beyond, (w, h))
    picture = _display(frame, slice(None)) + (1.0 - frame.alpha[..., None]) * 0.5
    measured = spec.measured.at(output.t_star, frozen)
    frame.depth, frame.depth_sigma = spec.depths.of(output.viewmat, K, frame.depth, image.motion, picture, measured)
    if spec.blur is not None:
        _blur(frame, spec.blur.sample_cameras(output, K, frame.depth), frozen, scene, spec, report)
    return frame


def _composited(
    output: OutputFrame, frozen: FrozenGaussians, scene: Scene, spec: FrameSpec
) -> tuple[FrozenImage, FrozenImage | CompositeFrame]:  # fmt: skip
    """(the splats' render, the frame) of one camera, on the CPU; both are the same without plate detail."""
    exposed_at, K = scene.time_of_frame(output.exposed_like), whole_camera(output, spec)
    image = render_frozen(frozen, output.viewmat, K, *spec.whole, spec.run.model.exposure, exposed_at, spec.beyond)
    frame = image if spec.detail is None else spec.detail.frame(output, frozen, image, *spec.size)
    return image.cpu(), frame.cpu()


def _blur(
    frame: FrozenImage | CompositeFrame, cameras: list[OutputFrame], frozen: FrozenGaussians, scene: Scene,
    spec: FrameSpec, report: Reporter,
) -> None:  # fmt: skip
    """Replaces colours and alphas of a frame with the scene-linear mean of its own and those of other `cameras`."""
    if not cameras:
        return
    sums = _lights(frame, scene.display)
    for camera in cameras:
        report.check_cancelled()
        for total, light in zip(sums, _lights(_composited(camera, frozen, scene, spec)[1], scene.display), strict=True):
            total += light
    means = [total / (len(cameras) + 1) for total in sums]
    if isinstance(frame, CompositeFrame):
        frame.linear, frame.alpha = means[0][..., :3], means[0][..., 3]
        frame.splat, frame.splat_alpha = _from_light(means[1], scene.display), means[1][..., 3]
    else:
        frame.color, frame.alpha = _from_light(means[0], scene.display), means[0][..., 3]


def _lights(image: FrozenImage | CompositeFrame, display: Display) -> list[Tensor]:
    """[H, W, 4] each, scene-linear, premultiplied: the frame, and for a `CompositeFrame` also its splats."""
    if isinstance(image, CompositeFrame):
        splat = scene_linear(image.splat.numpy(), image.splat_alpha.numpy(), display)
        return [torch.cat([image.linear, image.alpha[..., None]], dim=2), from_numpy(splat)]
    return [from_numpy(scene_linear(image.color.numpy(), image.alpha.numpy(), display))]


def _from_light(light: Tensor, display: Display) -> Tensor:
    """[H, W, 3] premultiplied, display-referred, from scene-linear [H, W, 4]: the inverse of `scene_linear`."""
    alpha = light[..., 3:]
    straight = torch.where(alpha > 0.0, light[..., :3] / alpha.clamp_min(1e-8), 0.0)
    return to_display(straight, display) * alpha


def whole_camera(output: OutputFrame, spec: FrameSpec) -> Tensor:
    """[3, 3] intrinsics of a frame in pixels of its picture with overscan."""
    K = output.K.clone()
    K[:2, 2] += torch.tensor(spec.beyond, dtype=K.dtype, device="cpu")
    return K


def _write(
    folder: TakeFolder,
    output: OutputFrame,
    image: FrozenImage | CompositeFrame,
    deep: DeepSamples | None,
    scene: Scene,
    spec: FrameSpec,
    key: str,
) -> None:
    """Writes all files of a frame. Each stores the frame's key, with which `folder.stored_key` checks that the files
    belong together. The EXR is written last, so that all other files exist once it does."""
    if isinstance(image, CompositeFrame):
        if spec.debug_terms is not None:
            write_terms(spec.debug_terms, output.frame, image.terms)
        if spec.has_warps:
            _write_warp(folder, output, image, spec, key)
    if deep is not None:
        _write_deep(folder, output, image, deep, scene, spec, key)
    _write_frame(folder, output, image, scene, spec, key)


def _write_frame(
    folder: TakeFolder,
    output: OutputFrame,
    image: FrozenImage | CompositeFrame,
    scene: Scene,
    spec: FrameSpec,
    key: str,
) -> None:
    """Writes preview and EXR. The layers are computed some rows at a time, to save memory."""
    write_png(folder.preview(output.frame), _preview(image, spec), key)
    size = tuple(image.alpha.shape)

    def depth(rows: slice) -> np.ndarray:
        return torch.where(image.depth[rows] < NO_DEPTH, image.depth[rows] / scene.scale, NO_DEPTH).numpy()

    layers = None
    if isinstance(image, CompositeFrame):
        splat, covered = image.splat.numpy(), image.splat_alpha.numpy()
        splat_layer = LazyLayer((*size, 4), lambda rows: scene_linear(splat[rows], covered[rows], scene.display))
        layers = DetailLayers(splat_layer, image.plate, image.source)
    more: dict[str, NDArray[np.float32] | LazyLayer] = {}
    if image.depth_sigma is not None:
        more["DepthSigma"] = (image.depth_sigma / scene.scale).numpy()
    if spec.passes is not None:
        more |= spec.passes.of(output, whole_camera(output, spec), image.depth)
    write_frozen_exr(
        folder.frame(output.frame),
        LazyLayer((*size, 4), functools.partial(_rgba, image, scene)),
        LazyLayer(size, depth),
        image.support.numpy(),
        image.motion.numpy(),
        FrameMetadata(
            output.frame,
            output.t_star,
            _solve_viewmat(output, scene).float().numpy(),
            output.K.numpy(),
            timecode=spec.timecode(output.frame),
            key=key,
            light=spec.light,
        ),
        spec.beyond,
        None if spec.grain is None else _grain(spec.grain, output, image, spec, scene.display),
        layers,
        more,
    )


def _rgba(image: FrozenImage | CompositeFrame, scene: Scene, rows: slice) -> NDArray[np.float32]:
    """[h, W, 4] some rows of a frame, scene-linear, premultiplied."""
    alpha = image.alpha[rows].numpy()
    if isinstance(image, CompositeFrame):
        return np.concatenate([image.linear[rows].numpy(), alpha[..., None]], axis=2)
    return scene_linear(image.color[rows].numpy(), alpha, scene.display)


def _deep(
    output: OutputFrame, image: FrozenImage | CompositeFrame, scene: Scene, spec: FrameSpec, report: Reporter
) -> DeepSamples:  # fmt: skip
    """The deep samples of a frame with final depth."""
    exposure, exposed_at = spec.run.model.exposure, scene.time_of_frame(output.exposed_like)
    frozen, K = spec.instants.at(output.t_star, report), whole_camera(output, spec)
    return deep_samples(frozen, output, K, spec.beyond, exposure, exposed_at, scene.display, image.depth)


def _write_deep(
    folder: TakeFolder, output: OutputFrame, image: FrozenImage | CompositeFrame, deep: DeepSamples, scene: Scene,
    spec: FrameSpec, key: str,
) -> None:  # fmt: skip
    """Writes the deep EXR of a frame, in the axes and units of Blender's scene."""
    assert spec.deep is not None
    matrix, units = light_matrix(spec.light), spec.deep.scale / scene.scale

    def samples(rows: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        rgba, depth = deep.rows(rows, _rgba(image, scene, rows))
        return in_light(rgba, matrix), np.where(depth < NO_DEPTH, depth * units, NO_DEPTH).astype(np.float32)

    viewmat = spec.deep.viewmats(_solve_viewmat(output, scene).numpy()[None])[0]
    write_deep_exr(
        folder.deep(output.frame),
        tuple(image.alpha.shape),
        samples,
        FrameMetadata(
            output.frame, output.t_star, viewmat.astype(np.float32), output.K.numpy(), spec.timecode(output.frame),
            "scene units", key=key, light=spec.light,
        ),
        spec.beyond,
    )  # fmt: skip


def _solve_viewmat(output: OutputFrame, scene: Scene) -> Tensor:
    """[4, 4] world-to-camera of a frame in solve units, float64."""
    viewmat = output.viewmat.double().clone()
    viewmat[:3, 3] = viewmat[:3, 3] / scene.scale - viewmat[:3, :3] @ from_numpy(scene.centre)
    return viewmat


def _grain(
    grain: Grain, output: OutputFrame, image: FrozenImage | CompositeFrame, spec: FrameSpec, display: Display
) -> LazyLayer:  # fmt: skip
    """The grain layer of a frame, [H, W, 3] scene-linear, premultiplied. Grain is measured on sRGB, so colours of other
    displays are converted first."""
    brush = Brush(grain, output.frame, image.alpha.shape, spec.whole_grain_size)
    K, softness = whole_camera(output, spec), grain.softness * spec.whole[0] / spec.whole_grain_size[0]
    blur: MotionBlur | None = None if spec.blur is None or spec.blur.is_still(output) else spec.blur

    def layer_rows(rows: slice) -> np.ndarray:
        alpha = image.alpha[rows]
        if not isinstance(image, CompositeFrame):
            colour = image.color[rows].numpy()
            if display.bends:
                rgba = np.concatenate([colour, alpha[..., None].numpy()], axis=2)
                colour = on_straight_colour(rgba, lambda x: display.straightened(np.asarray(x, np.float32)))[..., :3]
            return brush.rows(rows, colour, alpha.numpy(), np.ones(alpha.shape, np.float32))
        lacking = 1.0 - image.plate[rows]  # plates already have grain
        if blur is not None:  # motion blur averages part of the plates' grain away; variances add up
            lengths = blur.lengths(output, K, image.depth[rows], rows.start)
            lacking = (1.0 - kept_grain(lengths, softness).float() * (1.0 - lacking.square())).sqrt()
        return brush.rows(rows, image.linear[rows].numpy(), alpha.numpy(), lacking.numpy(), is_light=True)

    return LazyLayer((*image.alpha.shape, 3), layer_rows)


def _display(image: FrozenImage | CompositeFrame, rows: slice) -> Tensor:
    """[h, W, 3] some rows of a frame, premultiplied, in the scene's display."""
    return to_display(image.linear[rows], image.display) if isinstance(image, CompositeFrame) else image.color[rows]


def _preview(image: FrozenImage | CompositeFrame, spec: FrameSpec) -> np.ndarray:
    """[H, W, 3] uint8 the frame without overscan on a grey background, for contact sheet and video."""
    (width, height), (left, top) = spec.size, spec.beyond
    out = np.empty((height, width, 3), np.uint8)
    for part in bands(height, width):
        rows = slice(part.start + top, part.stop + top)
        pixels = _display(image, rows) + (1.0 - image.alpha[rows][..., None]) * 0.5
        pixels = pixels[:, left : left + width].clamp(0.0, 1.0) * 255.0 + 0.5
        out[part] = pixels.to(torch.uint8).numpy()
    return out


def _write_warp(folder: TakeFolder, output: OutputFrame, frame: CompositeFrame, spec: FrameSpec, key: str) -> None:
    assert spec.detail is not None
    plates = spec.detail.plates
    write_warp(
        folder.warp(output.frame),
        frame.st,
        frame.matte,
        frame.fill,
        frame.alpha,
        WarpMetadata(output.frame, frame.primary, output.t_star, plates.width, plates.height, key, light=spec.light),
        spec.beyond,
    )


def small_share(plate: Tensor, support: Tensor) -> Tensor:
    """[h, w] share of plate [H, W], averaged to a picture at most 160 pixels wide, for statistics.

    The share is limited by `support` [H, W]: without support, plates show the surface but not its state at t*.
    """
    plate = torch.minimum(plate, support)
    height, width = plate.shape
    small = min(width, 160)
    return resized(plate, small, max(4, round(height * small / width)))


def scene_linear(color: np.ndarray, alpha: np.ndarray, display: Display) -> np.ndarray:
    """Premultiplied scene-linear RGBA [H, W, 4] from premultiplied display colour [H, W, 3] and alpha [H, W].

    Splats blend in display space. The colour is therefore divided by alpha before the conversion.
    """
    # Colour above the brightest value of the clip was not supervised in training. It is noise, which the shoulder's
    # inverse would amplify many times. The conversion therefore limits colours to `Display.most`.
    return straight_to_linear(from_numpy(color), from_numpy(alpha), display).numpy()
