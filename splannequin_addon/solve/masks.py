"""Mask parameters of the solve from the artist's settings: a file, the clip's alpha, or a mask drawn in Blender."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import settings_of
from ..process import backend
from ..shot import selection
from . import drawn_masks, exchange

LABELS = {"ignore": "Ignore", "people": "People"}
"""Kind of mask -> its label on the panel."""
# Choice on the panel -> the backend's keyword, for choices that are not files.
_WORDS = {"NONE": "", "ALPHA": contract.MASK_ALPHA, "FOUND": contract.MASK_FOUND}


def params(scene: bpy.types.Scene, rendered: bool = False) -> contract.SolveParams:
    """Solve parameters from the artist's settings. Writes drawn masks and cameras of the scene into the shot first.

    With `rendered`, the caller writes these files. Raises JobError, which names a missing choice or a file that cannot
    be written.
    """
    shot = selection.shot_folder(scene)
    params = exchange.params(scene, shot, rendered)
    params.ignore_mask, params.people_mask = (_source(scene, shot, kind, rendered) for kind in contract.MASK_KINDS)
    return params


def drawn(scene: bpy.types.Scene) -> dict[str, bpy.types.Mask]:
    """Kind of mask -> the drawn mask that is selected for it."""
    props = settings_of(scene)
    chosen = {kind: getattr(props, f"{kind}_drawn") for kind in contract.MASK_KINDS if _is_drawn(scene, kind)}
    return {kind: mask for kind, mask in chosen.items() if mask is not None}


def _is_drawn(scene: bpy.types.Scene, kind: str) -> bool:
    return bool(getattr(settings_of(scene), f"{kind}_from") == "DRAWN")


def _source(scene: bpy.types.Scene, shot: Path | None, kind: str, rendered: bool) -> str:
    props = settings_of(scene)
    chosen, path, mask = (getattr(props, f"{kind}_{part}") for part in ("from", "path", "drawn"))
    if chosen in _WORDS:
        return _WORDS[chosen]
    if chosen == "FILE" and path:
        return os.path.abspath(bpy.path.abspath(path))
    if chosen == "DRAWN" and mask is not None:
        if shot is None:
            raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE)
        backend.python()  # fails before anything is written
        return str(contract.ShotFolder(shot).drawn_masks(kind) if rendered else drawn_masks.render(mask, shot, kind))
    raise contract.JobError(
        f"Nothing is chosen for the mask {LABELS[kind]}.",
        "Choose an image, a sequence, a video or a drawn mask, or set the mask to None.",
        contract.ExitCode.USAGE,
    )
