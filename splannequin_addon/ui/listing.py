"""Lists of a shot's runs and takes, for comparison and selection. Drawn from the job timer's stored state."""

from __future__ import annotations

import errno
import os
import shutil
import threading
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..shot.shot_state import ShotState
from .sentences import cells as _cells

if TYPE_CHECKING:
    import bpy

_RUN_HEAD = ("Run", "dB", "Size", "Move", "Time")
_RUN_WIDTHS = (0.23, 0.19, 0.18, 0.2, 0.2)  # fits the sidebar's default width
_TAKE_HEAD = ("Take", "t*", "Frames", "Run")
_TAKE_WIDTHS = (0.3, 0.18, 0.24, 0.28)


def run_rows(state: ShotState) -> list[tuple[str, ...]]:
    """(name, dB on held-out frames, Gaussians, moving fraction, training time) of every run, as displayed.

    An unfinished run has (name, progress), a damaged run (name, "damaged").
    """
    rows: list[tuple[str, ...]] = []
    for name in state.listed("run"):
        run = state.runs.get(name)
        if name in state.damaged["run"]:
            rows.append((name, "damaged"))
            continue
        if run is None:
            paused = state.unfinished[name]
            share = 100.0 * paused["iteration"] / max(1, paused["end"])
            rows.append((name, f"paused at {share:.0f} %"))
            continue
        psnr = run.get("heldout_psnr_db")
        moves = f"{100.0 * (run.get('moving_share') or 0.0):.2g}%"
        quality = "-" if psnr is None else f"{psnr:.2f}"
        size = f"{run.get('gaussians', 0) / 1000.0:.3g}k"
        rows.append((name, quality, size, moves, duration(run.get("train_seconds"))))
    return rows


def take_rows(state: ShotState) -> list[tuple[str, ...]]:
    """(name, t*, frames on disk, run) of every take, as displayed; a damaged take has (name, "damaged")."""
    rows: list[tuple[str, ...]] = []
    for name in state.listed("take"):
        take = state.takes.get(name)
        if take is None:
            rows.append((name, "damaged"))
            continue
        instant = "keyed" if take.get("t_star_per_frame") else str(take["t_star_frame"])
        rows.append((name, instant, str(take["frame_count"]), str(take["run"])))
    return rows


def duration(seconds: float | None) -> str:
    """A training time in short form: "45s", "3m", "1.5h"."""
    if seconds is None:
        return "-"
    if seconds < 90:
        return f"{seconds:.0f}s"
    return f"{seconds / 60:.0f}m" if seconds < 5400 else f"{seconds / 3600:.1f}h"


def draw(layout: bpy.types.UILayout, kind: str, state: ShotState, chosen: str) -> None:
    """Draws rows of the runs or takes (`kind` "run" or "take"), with `chosen` highlighted. A click on a name selects
    it."""
    rows, head, widths = (
        (run_rows(state), _RUN_HEAD, _RUN_WIDTHS) if kind == "run" else (take_rows(state), _TAKE_HEAD, _TAKE_WIDTHS)
    )
    column = layout.column(align=True)
    for row in (head, *rows):
        line = column.row(align=True)
        cells = _cells(line.row(align=True), widths if len(row) == len(head) else (widths[0], 1.0 - widths[0]))
        if row is head:
            cells[0].label(text=row[0])
            line.label(text="", icon="BLANK1")
        else:
            pick = cells[0].operator(f"splannequin.pick_{kind}", text=row[0], translate=False, depress=row[0] == chosen)
            pick.name = row[0]
            line.operator(f"splannequin.remove_{kind}", text="", icon="TRASH").name = row[0]
        for text, cell in zip(row[1:], cells[1:], strict=True):
            cell.label(text=text, translate=row is head)


def remove(shot: Path, folder: Path, wait: bool) -> None:
    """Removes a folder of a shot. It disappears at once; a thread deletes its files, unless `wait` is set.

    If the folder is a link, only the link is removed. Raises OSError if the folder cannot be moved: a file is open
    elsewhere (Windows) or protected, or the parent is a link.
    """
    if contract.is_link(folder.parent):
        raise OSError(
            errno.EPERM, f"{folder.parent.name} is a link to another folder. Remove the item there", str(folder)
        )
    trash = contract.ShotFolder(shot).trash
    if contract.is_link(trash):
        contract.remove_link(trash)
    if contract.is_link(folder):  # its target is not part of the shot
        contract.remove_link(folder)
        return
    trash.mkdir(exist_ok=True)
    os.replace(folder, trash / f"{folder.name}-{uuid.uuid4().hex[:8]}")
    if wait:
        _empty(trash)
    else:
        threading.Thread(target=_empty, args=(trash,), name="trash", daemon=True).start()


def _empty(trash: Path) -> None:
    """Deletes the content of the trash, including leftovers of an earlier Blender. Links are removed, but not
    followed."""
    shutil.rmtree(trash, ignore_errors=True)
