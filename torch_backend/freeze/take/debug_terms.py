"""Writes the terms behind the compositor's decisions as pictures, for `--debug-terms DIR`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import OpenImageIO as oiio
import torch
from torch import Tensor

from ...contract import frame_file
from ...raster import RasterSettings
from ...train.model import render
from ..exr import linear_spec, write_exr
from ..frozen import FrozenGaussians
from ..instant.develop import DevelopConfig
from ..instant.repairs import repairs
from ..views.reproject import resized


def origin_terms(
    frozen: FrozenGaussians, viewmat: Tensor, K: Tensor, whole: tuple[int, int], beyond: tuple[int, int],
    size: tuple[int, int],
) -> dict[str, Tensor]:  # fmt: skip
    """{"origin.NAME": [h, w]} per repair NAME: share of each pixel from Gaussians that the repair changed last.

    Args:
        viewmat, K: the frame's camera, as for `render_frozen`.
        whole: width and height of the frame in pixels, with overscan.
        beyond: pixels of overscan (left and right, above and below).
        size: (w, h) of the terms.
    """
    if frozen.origin is None:
        return {}
    names = [step.name for step in repairs(DevelopConfig())]
    marks = torch.stack([(frozen.origin == n + 1).float() for n in range(len(names))], dim=1)
    out = render(
        frozen.state, 0, viewmat.to(marks.device), K.to(marks.device), *whole, colors=marks, with_contributions=False,
        settings=RasterSettings(overscan=beyond),
    )  # fmt: skip
    shares = resized(out.colors[0, ..., 3:].cpu(), *size)
    return {f"origin.{name}": shares[..., n] for n, name in enumerate(names)}


def write_terms(folder: Path, frame: int, terms: Mapping[str, Tensor]) -> Path | None:
    """Writes one half-float EXR with a channel per term. Returns its path, or None for a frame without terms.

    Args:
        folder: output folder, created if missing.
        frame: frame number, used as the file name.
        terms: `CompositeFrame.terms`, [h, w] each; their names become the channel names.

    OSError with the system's reason if the file cannot be written.
    """
    if not terms:
        return None
    names = tuple(sorted(terms))
    height, width = terms[names[0]].shape
    spec = linear_spec(width, height, names, (oiio.HALF,) * len(names))
    return write_exr(folder / frame_file(frame, ".exr"), spec, [terms[name].numpy() for name in names])
