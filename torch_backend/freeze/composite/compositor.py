"""Frozen frames composited from the plates: splats give geometry, motion and occlusion; plates give the pixels.

C is the frozen render of a camera at the instant t*. I_m is plate m. R_m is the model's render with the camera, time
and exposure of plate m. p_m(x) is the pixel where plate m shows the surface point of x, after the model has moved the
point from t* to m. A pixel x of the frozen frame is

    out = A I_n(p_n) + (1 - A) ((1 - c) (C + b sum_m w_m (I_m - R_m)(p_m) / sum_m w_m) + c I_t*(p_t*))
    A = clip(1/2 - L / (2 s), 0, 1)        b = sum_m w_m / (sum_m w_m + doubt)

n is the primary plate: the frame's own plate on the clip's poses, the plate nearest in pose on others. A is its matte:
1 where it surely shows the state of t*. L are the smoothed log-odds of another state, s their softness (`state.py`).
On the pose of t*, and on black bars, A is 1, so the plate is reproduced bit for bit. Off the clip's poses A also falls
with occlusion and with the parallax of a depth error. The remaining pixels are filled. The residual I_m - R_m adds what
the model missed: texture, edges and light. Plate t* is trusted even where the model does not explain it, because it
shows the frozen instant. Other plates are trusted where nothing moves or where they agree with the model. b fades to
the splats alone where no plate is trusted. c is the share of plate t*'s own pixels on movers that it shows from nearly
the same side. Residuals are added in display space, in which splats blend and highlights have a shoulder. A mixes
scene-linear light, so that artists can repeat the mix with their own plate.

Source: Buehler et al. 2001, "Unstructured Lumigraph Rendering"; Li et al. 2023, "DynIBaR"; figures: docs/benchmarks.md.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...footage.display import PLAIN, Display
from ...scene import Scene
from ...torch_types import from_numpy
from ...train import LoadedRun
from ..bands import bands, hand_back
from ..frozen import FrozenGaussians, FrozenImage, OutputFrame
from ..views.reproject import resized
from ..views.source_views import MovingOf, PlateReader, SourceViews
from ..views.target_view import TargetView, target_view
from .config import CompositeConfig
from .fill import Filling, fill, fillers_of
from .filled import Fillers
from .primary_source import PrimaryMatte, primary_matte, primary_plate
from .transfer import to_display, to_linear
from .warp import MATTE_STEPS, sample

_MIN_MATTE = 0.5 / MATTE_STEPS
"""Largest matte that rounds to 0."""


@dataclass
class CompositeFrame:
    """One frozen frame composited from plates, on the model's device, with the overscan of the render."""

    linear: Tensor
    """[H, W, 3] premultiplied, scene-linear: matte * plate(st) + fill."""
    alpha: Tensor
    """[H, W] in 0..1."""
    splat: Tensor
    """[H, W, 3] the splats alone, premultiplied, in the colours of `display`."""
    splat_alpha: Tensor
    """[H, W] in 0..1: alpha of `splat`."""
    plate: Tensor
    """[H, W] in 0..1: share of the pixel that comes from plates. 0: all of it comes from splats."""
    source: Tensor
    """[H, W] float32: frame number of the plate with the largest share; 0 where `plate` is 0."""
    depth: Tensor
    """[H, W] as in `FrozenImage`."""
    support: Tensor
    """[H, W] in 0..1. 1: the surface is static, or a frame near t* shows it. 0: no frame shows its state at t*."""
    motion: Tensor
    """[H, W] in 0..1: share of the pixel that moves in the clip, from the plates where they show it. On the clip's own
    poses it is also 1 where the frame's own plate shows a mover and is rejected. Where it is 0, that plate is valid."""
    primary: int
    """Frame number of the primary plate, to which `st` refers."""
    st: Tensor
    """[H, W, 2] s to the right, t up, 0..1 over the undistorted plate `primary`, pixel centres at (i + 0.5) / size."""
    matte: Tensor
    """[H, W] in 0..1: share of the pixel that comes from the primary plate."""
    fill: Tensor
    """[H, W, 3] scene-linear, premultiplied by 1 - matte: the rest of the pixel."""
    display: Display = PLAIN
    """Transfer function (display encoding) of `splat` and `color`."""
    depth_sigma: Tensor | None = None
    """As in `FrozenImage`."""
    terms: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    """Name -> [h, w] at decision resolution: evidence that chose the source of each pixel (`--debug-terms`)."""

    def cpu(self) -> CompositeFrame:
        """The frame on the CPU, for writing files; tensors that are there already are not copied."""
        moved = {name: value.cpu() for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **moved, terms={name: term.cpu() for name, term in self.terms.items()})

    @property
    def color(self) -> Tensor:
        """[H, W, 3] `linear` on its display, not clipped. It is not cached, because few callers need it."""
        out = torch.empty_like(self.linear)
        for rows in bands(*self.alpha.shape):
            out[rows] = to_display(self.linear[rows], self.display)
        return out


BarsOf = Callable[[int], "NDArray[np.bool_] | None"]
"""Frame number -> bool [H, W], True on black bars around the picture of its plate; None: no bars."""


class Compositor:
    """Composites frozen frames of one run from plates. Results per plate are cached for all frames that use it."""

    def __init__(
        self,
        run: LoadedRun,
        scene: Scene,
        plates: PlateReader,
        config: CompositeConfig | None = None,
        moving: MovingOf | None = None,
        bars: BarsOf | None = None,
    ) -> None:
        """`moving`: see `SourceViews`. `bars`: see `BarsOf`; None: the footage has none."""
        self.run, self.scene, self.plates = run, scene, plates
        self.config = config or CompositeConfig()
        self._moving, self._bars = moving, bars
        self.source_views = SourceViews(run, scene, plates, moving, self.config.source_views)
        """The plates compared with the current model, which is the run or a developed instant."""

    @torch.no_grad()
    def frame(
        self,
        output: OutputFrame,
        frozen: FrozenGaussians,
        image: FrozenImage,
        width: int,
        height: int,
        withheld: Collection[int] = (),
    ) -> CompositeFrame:
        """One frozen frame.

        Args:
            output: camera and instant of the frame.
            frozen: the scene frozen at `output.t_star`.
            image: the splats' render of the frame, overscan included.
            width, height: pixels of the frame without overscan.
            withheld: frames whose plates must not be used.
        """
        self._use_instant(frozen, output.t_star)
        target = target_view(self.source_views, output, frozen, image, width, height)
        usable = [frame for frame in self.source_views.frames if frame not in withheld]
        primary = primary_plate(self.source_views, output, target, usable)
        primary_part = primary_matte(self.source_views, self.config, output, target, primary, usable, (width, height))
        bars = (
            self._keep_bars(primary_part.matte, primary)
            if primary_part.is_identity and primary == output.frame
            else None
        )
        fillers = fillers_of(self.source_views, self.config, target, primary_part.matte, primary, usable)
        composite = self._mix_frame(target, primary, primary_part, fillers)
        if bars is not None:  # bars look the same at every instant
            composite.support[bars], composite.motion[bars] = 1.0, 0.0
        return composite

    def _keep_bars(self, matte: Tensor, frame: int) -> Tensor | None:
        """Sets `matte` [H, W] to 1 on the bars of a frame's own plate. Returns the bars, bool [H, W], or None."""
        found = None if self._bars is None else self._bars(frame)
        if found is None:
            return None
        (rows, columns), (height, width) = matte.shape, found.shape
        top, left = (rows - height) // 2, (columns - width) // 2
        bars = torch.zeros_like(matte, dtype=torch.bool)
        bars[top : top + height, left : left + width] = from_numpy(found).to(matte.device)
        matte[bars] = 1.0
        return bars

    def _use_instant(self, frozen: FrozenGaussians, t_star: float) -> None:
        """Recreates `source_views` when the developed instant changes; frames of an instant come in sequence."""
        developed = frozen if frozen.descent is not None else None
        if developed is not self.source_views.stage.developed:
            config = self.config.source_views
            self.source_views = SourceViews(
                self.run, self.scene, self.plates, self._moving, config, developed, round(t_star)
            )

    def _mix_frame(
        self,
        target: TargetView,
        primary: int,
        primary_part: PrimaryMatte,
        fillers: Fillers | None,
    ) -> CompositeFrame:
        image, matte, st, is_identity = target.image, primary_part.matte, primary_part.st, primary_part.is_identity
        rows, columns = image.alpha.shape
        parts = bands(rows, columns)
        if len(parts) > 1:
            hand_back()
        has_primary = bool((matte > _MIN_MATTE).any())
        plate = self.plates.linear(primary).to(matte.device) if has_primary and not is_identity else None
        composite = CompositeFrame(
            linear=torch.empty_like(image.color), alpha=image.alpha.clone(), splat=image.color,
            splat_alpha=image.alpha, plate=torch.empty_like(image.alpha), source=torch.empty_like(image.alpha),
            depth=image.depth, support=torch.minimum(image.support, 1.0 - resized(target.out_of_view, columns, rows)),
            motion=resized(target.moved, columns, rows), primary=primary, st=st, matte=matte,
            fill=torch.zeros_like(image.color), display=self.scene.display,
            terms={**primary_part.terms, **_terms(target, fillers)},
        )  # fmt: skip
        for band in parts:
            filling = None if fillers is None else fill(self.source_views, self.config, target, fillers, matte, band)
            matte[band] = (matte[band] * MATTE_STEPS).round() / MATTE_STEPS
            lead = sample(plate, st[band]) if plate is not None else None
            if has_primary and is_identity:
                lead = self._placed(primary, rows, columns, band).to(matte.device)
            self._mix_rows(composite, filling, lead, band)
        return composite

    def _placed(self, frame: int, rows: int, columns: int, band: slice) -> Tensor:
        """[h, columns, 3] scene-linear: rows `band` of a plate centred in `rows` x `columns` pixels, 0 around it."""
        height, width = self.plates.height, self.plates.width
        if (height, width) == (rows, columns):
            return self.plates.linear(frame, band)
        out = torch.zeros(band.stop - band.start, columns, 3, device="cpu")
        top, left = (rows - height) // 2, (columns - width) // 2
        first, last = max(band.start, top), min(band.stop, top + height)
        if first < last:
            part = self.plates.linear(frame, slice(first - top, last - top))
            out[first - band.start : last - band.start, left : left + width] = part
        return out

    def _mix_rows(self, composite: CompositeFrame, filling: Filling | None, lead: Tensor | None, rows: slice) -> None:
        """Mixes some rows of a frame. Its `matte` is final, and its `alpha` is that of the splats.

        `lead` [h, W, 3] holds the primary plate's pixels of these rows, scene-linear. None: the plate is not used.
        """
        matte, alpha, fill = composite.matte[rows], composite.alpha[rows], composite.fill[rows]
        share = matte.clone()
        source = torch.full_like(share, float(composite.primary))
        if filling is not None:
            at = filling.y, filling.x
            remaining = 1.0 - matte[at]
            alpha[at] += (1.0 - alpha[at]) * filling.share
            covered = torch.maximum(alpha, matte)[at].clamp_min(1e-4)[:, None]
            color = filling.color if self.plates.deep else filling.color.clamp(0.0, 1.0)
            color = color / covered
            if composite.display.bends:  # on the shoulder a small error is many times as large in linear light
                color = color.clamp_max(filling.most)
            fill[at] = remaining[:, None] * covered * to_linear(color, composite.display)
            share[at] += remaining * filling.share
            source[at] = torch.where(remaining > 0.5, filling.source, float(composite.primary))
        torch.maximum(alpha, matte, out=alpha)
        source[share <= 0.0] = 0.0
        composite.plate[rows], composite.source[rows] = share, source
        composite.linear[rows] = fill if lead is None else torch.addcmul(fill, matte[..., None], lead)


def _terms(target: TargetView, fillers: Fillers | None) -> dict[str, Tensor]:
    """Maps of a target view, and visibility and agreement per fill plate: see `CompositeFrame.terms`."""
    terms = {"motion": target.motion, "doubt": target.doubt, "moved": target.moved, "unseen": target.out_of_view}
    if fillers is not None:
        for n, frame in enumerate(fillers.chosen):
            terms |= {f"shown.{frame}": fillers.visible[n], f"agreed.{frame}": fillers.agreed[n]}
    return terms
