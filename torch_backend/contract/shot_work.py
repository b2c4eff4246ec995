"""Work in a shot that depends on its present frames. An import of other frames must not use or remove it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .shot_folder import (
    DRAWN_FOLDER,
    LAYERS,
    PAINTED_FOLDER,
    PATHS_FOLDER,
    PICTURE,
    RUNS_FOLDER,
    SOLVE_FOLDER,
    TAKES_FOLDER,
    TRACKING_FOLDER,
    ShotFolder,
)

FOLDERS_OF_FRAMES = (
    SOLVE_FOLDER, RUNS_FOLDER, TAKES_FOLDER, PAINTED_FOLDER, DRAWN_FOLDER, TRACKING_FOLDER, PATHS_FOLDER,
)  # fmt: skip
"""Folders of a shot whose content depends on its frames: made from them, or painted, drawn or tracked over them."""


def work_words(shot: ShotFolder) -> list[str]:
    """Descriptions of the work in a shot besides its frames: "a solved camera", "2 runs" and so on; [] if none."""
    runs = sum(any(_files(run, "*")) for run in _folders(shot.runs))
    takes = sum(any(_files(take, "*" + LAYERS)) or any(_files(take, "*")) for take in _folders(shot.takes))
    found = [
        "a solved camera" if shot.cameras.is_file() else "",
        f"{runs} runs" if runs > 1 else "1 run" if runs else "",
        f"{takes} takes" if takes > 1 else "1 take" if takes else "",
        "painted motion mattes" if any(_files(shot.painted, "*" + PICTURE)) else "",
        "drawn masks" if any(any(_files(kind, "*")) for kind in _folders(shot.root / DRAWN_FOLDER)) else "",
        "a tracked camera" if shot.tracking.is_file() else "",
        "camera paths" if any(_files(shot.root / PATHS_FOLDER, "*.json")) else "",
    ]
    return [words for words in found if words]


def _folders(parent: Path) -> Iterator[Path]:
    """Folders in a folder; hidden ones are leftovers of killed processes."""
    return (path for path in parent.glob("[!.]*") if path.is_dir())


def _files(folder: Path, pattern: str) -> Iterator[Path]:
    return (path for path in folder.glob(pattern) if path.is_file())
