"""Runs and takes of a shot side by side, to compare and to pick one. Drawn from what the job timer keeps."""

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
_RUN_WIDTHS = (0.23, 0.19, 0.18, 0.2, 0.2)  # a sidebar of Blender's own width shows all of it
_TAKE_HEAD = ("Take", "t*", "Frames", "Run")
_TAKE_WIDTHS = (0.3, 0.18, 0.24, 0.28)


def run_rows(state: ShotState) -> list[tuple[str, ...]]:
    """(name, dB on frames kept out, Gaussians, share that moves, time trained) of every run, as shown.

    Of one that is not finished (name, how far it came), of one that cannot be read (name, that it is damaged).
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
    """(name, t*, frames on disk, run) of every take, as shown; of one that cannot be read (name, "damaged")."""
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
    """A training time in few letters: "45s", "3m", "1.5h"."""
    if seconds is None:
        return "-"
    if seconds < 90:
        return f"{seconds:.0f}s"
    return f"{seconds / 60:.0f}m" if seconds < 5400 else f"{seconds / 3600:.1f}h"


def draw(layout: bpy.types.UILayout, kind: str, state: ShotState, chosen: str) -> None:
    """Rows of the runs or takes (`kind` "run" or "take"), the `chosen` one marked; a click on a name picks it."""
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
    """Removes a folder of a shot: gone at once; its files are deleted in the background unless asked to `wait`.

    What lies behind a link is not the shot's: of a folder that is one, only the link is removed.
    OSError if it cannot be moved away, because a file of it is open elsewhere (Windows) or protected, or lies behind a
    link itself.
    """
    if contract.is_link(folder.parent):
        raise OSError(errno.EPERM, f"{folder.parent.name} is a link to another folder: remove it there", str(folder))
    trash = contract.ShotFolder(shot).trash
    if contract.is_link(trash):
        contract.remove_link(trash)
    if contract.is_link(folder):
        contract.remove_link(folder)
        return
    trash.mkdir(exist_ok=True)
    os.replace(folder, trash / f"{folder.name}-{uuid.uuid4().hex[:8]}")
    if wait:
        _empty(trash)
    else:
        threading.Thread(target=_empty, args=(trash,), name="trash", daemon=True).start()


def _empty(trash: Path) -> None:
    """Deletes what lies in the trash, what an earlier Blender left there too. Links are removed, and never followed."""
    shutil.rmtree(trash, ignore_errors=True)
