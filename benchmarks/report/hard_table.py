"""Table rows of the report for hard scenes: glass and mirrors, and recall of small movers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .metrics import known_mean
from .records import SPLATS, FrameScore, RunRecord
from .setting import NONE, Setting, plain
from .things import LEAST_PIXELS, RECALL_CONTRAST, RECALL_DISTANCE, overall
from .truth import PANES

RECALLED = ("swinging", "arm")
"""Things whose recall is measured."""


def pane_rows(settings: Sequence[Setting]) -> list[list[str]]:
    """Row per setting with panes: dB on them and on the nearby wall, the difference, and false motion on them."""
    rows: list[list[str]] = []
    for s in settings:
        if s.summary("psnr_db", "wall") is None:
            continue
        cells = [_decibels(s, region) for region in (*PANES, "wall")]
        less = [_less_than_wall(s, pane) for pane in PANES]
        opened = [_mean(s, lambda row, pane=pane: row.opened.get(pane)) for pane in PANES] if s.shown == SPLATS else []
        matte = [_of_matte(s.runs, pane) for pane in PANES]
        rows.append([s.label, *cells, *less, *_percent(opened or [None] * len(PANES)), *matte])
    return rows


PANE_HEADER = [
    "method",
    "glass, dB",
    "mirror, dB",
    "nearby wall, dB",
    "glass - wall",
    "mirror - wall",
    "glass opened",
    "mirror opened",
    "matte on glass",
    "matte on mirror",
]
PANE_NOTE = (
    "Mean PSNR in dB of window pane and mirror pixels in which nothing moves, and of the static wall within 0.6 m of "
    "them. Opened: share of the pane where the frozen frame's motion matte exceeds 0.5, that is, falsely marks motion. "
    "Matte: share of the pane that the solve's motion matte marks as moving; in brackets, as unknown."
)
MOVER_HEADER = ["method", "recall of the apple", "worst pose", "recall of the arm", "worst pose", "arm, dB", "hair, dB"]
MOVER_NOTE = (
    "Recall: of the pixels that show an apple of 2 % of the picture's width that swings on a thread, and a gesturing "
    f"arm, at t* in the truth, the share that shows it in the frozen frame: colour within {RECALL_DISTANCE} (root mean "
    "square over the channels) of the truth, and nearer to it than to what stands behind. Pixels whose background is "
    f"within {RECALL_CONTRAST} of the thing do not count; the worst pose is one with at least {LEAST_PIXELS} that do. "
    "Hair: loose strands before a bright window, mean PSNR in dB over pixels of which they cover at least 15 %."
)


def mover_rows(settings: Sequence[Setting]) -> list[list[str]]:
    """Row per setting with a small mover or hair: recall over all poses and in the worst one, and dB."""
    rows: list[list[str]] = []
    for s in settings:
        counts = {name: _counts(s.runs, name) for name in RECALLED}
        dB = [_decibels(s, region) for region in ("arm", "hair")]
        if not any(counts.values()) and dB == [NONE, NONE]:
            continue
        recall = [cell for name in RECALLED for cell in _recall(counts[name])]
        rows.append([s.label, *recall, *dB])
    return rows


def _counts(runs: Sequence[RunRecord], name: str) -> list[tuple[int, int]]:
    """[(pixels that show the thing, pixels that should)] by frame."""
    return [tuple(row.recalled[name]) for run in runs for row in run.rows if name in row.recalled]


def _recall(counts: Sequence[tuple[int, int]]) -> list[str]:
    """Recall over all frames, and in the worst frame of those with enough pixels."""
    return [plain(share) for share in overall(counts)]


def _decibels(setting: Setting, region: str) -> str:
    found = setting.summary("psnr_db", region)
    return NONE if found is None else f"{found.mean:.2f}"


def _less_than_wall(setting: Setting, pane: str) -> str:
    """Mean difference in dB of the pane and the wall, over frames that show both."""
    return _signed(_mean(setting, lambda row: _difference(row.value("psnr_db", "wall"), row.value("psnr_db", pane))))


def _difference(wall: float | None, pane: float | None) -> float | None:
    return None if wall is None or pane is None else pane - wall


def _mean(setting: Setting, read: Callable[[FrameScore], float | None]) -> float | None:
    return known_mean(read(row) for run in setting.runs for row in run.rows)


def _of_matte(runs: Sequence[RunRecord], pane: str) -> str:
    """Share of the pane that the matte calls moving, and in brackets unknown."""
    found = [run.matte[pane] for run in runs if pane in run.matte]
    if not found:
        return NONE
    moving, unknown = (float(np.mean([of[name] for of in found])) for name in ("moving", "unknown"))
    return f"{moving:.1%} ({unknown:.1%})"


def _percent(values: Sequence[float | None]) -> list[str]:
    return [NONE if v is None else f"{v:.1%}" for v in values]


def _signed(value: float | None) -> str:
    return NONE if value is None else f"{value:+.2f}"
