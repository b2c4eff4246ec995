"""What the solve is told of masks, by what the artist chose: a file, the clip's alpha, or a mask drawn in Blender."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import settings_of
from ..process import backend
from . import drawn_masks

LABELS = {"ignore": "Ignore", "people": "People"}
"""Kind of mask -> its name on the panel."""
_WORDS = {"NONE": "", "ALPHA": contract.MASK_ALPHA, "FOUND": contract.MASK_FOUND}
"""What is chosen -> what the backend takes for it, where that is no file."""


def sources(scene: bpy.types.Scene, shot: Path | None) -> list[str]:
    """Of each of `contract.MASK_KINDS` what the backend takes for it; a drawn one is rendered into the shot first.

    JobError names what is not chosen, or cannot be written.
    """
    return [_source(scene, shot, kind) for kind in contract.MASK_KINDS]


def _source(scene: bpy.types.Scene, shot: Path | None, kind: str) -> str:
    props = settings_of(scene)
    chosen, path, drawn = (getattr(props, f"{kind}_{part}") for part in ("from", "path", "drawn"))
    if chosen in _WORDS:
        return _WORDS[chosen]
    if chosen == "FILE" and path:
        return os.path.abspath(bpy.path.abspath(path))
    if chosen == "DRAWN" and drawn is not None:
        if shot is None:
            raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE)
        backend.python()  # before anything is written: without a backend nothing would read it
        return str(drawn_masks.render(drawn, shot, kind))
    raise contract.JobError(
        f"Nothing is chosen for the mask {LABELS[kind]}.",
        "Choose a picture, a sequence, a video or a drawn mask, or set the mask to None.",
        contract.ExitCode.USAGE,
    )
