"""Pictures of a report: quality against cost with Pareto fronts, strips of frames, one pose at two instants."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torch_backend.footage.images import read_png
from torch_backend.shot import atomic_path

from .metrics import pareto_front
from .records import Picture, RunRecord
from .setting import Setting
from .tables import HOST_NAMES, pace

COSTS: dict[str, tuple[str, Callable[[RunRecord], float | None]]] = {
    "seconds": ("training, seconds", lambda run: run.train_seconds),
    "frame_ms": ("rendering a frozen frame, milliseconds", lambda run: run.frozen_fps and 1000.0 / run.frozen_fps),
    "megabytes": ("model, megabytes", lambda run: run.model_bytes / 1e6),
}
"""File stem -> (axis label, figure of a run); less is better for all."""
_INK, _GRID, _GROUND = "#1d1d1f", "#d5d5da", "white"
_COLOURS = {
    "hexplane": "#2f7ed8",
    "mlp": "#c9721a",
    "control_points": "#2a9d5c",
    "auto": "#d6336c",
    "static": "#8a8a94",
}
_MARKERS = {"none": "o", "paper": "s", "support": "D"}


def available() -> bool:
    """True if matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def cost_plot(path: Path, settings: Sequence[Setting], cost: str, region: str) -> Path | None:
    """Mean PSNR of frozen frames against a cost in `COSTS`, one point per setting; None if no setting has both."""
    axis, read = COSTS[cost]
    points: list[tuple[Setting, float, float]] = []
    for s in settings:
        psnr, price = s.summary("psnr_db", region), s.of_runs(read)
        if psnr is not None and price is not None:
            points.append((s, price, psnr.mean))
    if not points:
        return None
    figure, axes = _figure((7.2, 5.0))
    front = pareto_front([p[1] for p in points], [p[2] for p in points])
    axes.step([points[i][1] for i in front], [points[i][2] for i in front], where="post", color=_INK, lw=1, ls=":")
    for i, (s, price, psnr) in enumerate(points):
        colour = _COLOURS.get(s.host, _INK)
        axes.scatter(price, psnr, s=70, marker=_MARKERS[s.supervision], zorder=3, edgecolors=colour, linewidths=1.6,
                     facecolors=colour if i in front else _GROUND)  # fmt: skip
    axes.set_xscale("log")
    _limits(axes, [p[1] for p in points])
    named = [p for p in points if p[0].host == "auto" or p[0].variant != "default"]
    # Colour and marker already identify the host; labels of the six published ones would overlap.
    texts = [p[0].variant if p[0].variant == "reference" else p[0].label for p in named]
    points_of = [(p[1], p[2], text, _COLOURS.get(p[0].host, _INK)) for p, text in zip(named, texts, strict=True)]
    _labels(axes, points_of)
    _legend(figure, [p[0] for p in points])
    paces = ", ".join(sorted({pace(run) for s, _, _ in points for run in s.runs}))
    measured = "" if cost == "megabytes" else f"; threads × runs at once: {paces}"
    axes.set_xlabel(f"{axis} (logarithmic, less is better{measured})")
    axes.set_ylabel("PSNR of frozen frames, dB")
    axes.set_title("Filled and joined: no other is better in both", fontsize=9, color=_INK, loc="left")
    axes.grid(color=_GRID, lw=0.6, which="both")
    return _save(figure, path)


def _limits(axes: Any, prices: Sequence[float]) -> None:
    """Sets axis limits with room at the sides of the points, and plain numbers on a logarithmic axis."""
    ticker: Any = importlib.import_module("matplotlib.ticker")

    low, high = min(prices), max(prices)
    axes.set_xlim(low / 1.3, high * max(1.6, (high / low) ** 0.35))
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(_plain))
    axes.xaxis.set_minor_formatter(ticker.NullFormatter())


def _plain(value: float, position: int) -> str:
    return f"{value:g}"


def _legend(figure: Any, settings: Sequence[Setting]) -> None:
    """Draws a legend of host colours and supervision markers below the plot."""
    Line2D: Any = importlib.import_module("matplotlib.lines").Line2D

    plain = {"color": "none", "markersize": 7}
    hosts = dict.fromkeys(s.host for s in settings)
    keys = [Line2D([], [], marker="o", markerfacecolor=_COLOURS.get(h, _INK), markeredgecolor="none", **plain,
                   label=HOST_NAMES.get(h, h)) for h in hosts]  # fmt: skip
    kinds = {"none": "no anchors", "paper": "paper", "support": "support"}
    used = [name for name in kinds if any(s.supervision == name for s in settings)]
    keys += [Line2D([], [], marker=_MARKERS[name], markerfacecolor="none", markeredgecolor=_INK, **plain,
                    label=kinds[name]) for name in used]  # fmt: skip
    figure.legend(handles=keys, loc="outside lower center", ncols=4, frameon=False, fontsize=8, labelcolor=_INK)


def _labels(axes: Any, named: Sequence[tuple[float, float, str, str]]) -> None:
    """Draws names to the right of points, moved apart where they overlap; named: (x, y, name, colour)."""
    withStroke: Any = importlib.import_module("matplotlib.patheffects").withStroke

    low, high = axes.get_ylim()
    pad = 0.06 * max(high - low, 0.2)
    axes.set_ylim(low - pad, high + pad)
    gap = 0.045 * (axes.get_ylim()[1] - axes.get_ylim()[0])
    placed: list[tuple[float, float]] = []
    for x, y, name, colour in sorted(named, key=lambda p: p[1]):
        near = [at for label_y, at in placed if abs(np.log(label_y / x)) < 1.2]
        at = max([y, *(v + gap for v in near if v + gap > y)], default=y)
        placed.append((x, at))
        line = {"arrowstyle": "-", "color": colour, "lw": 0.5} if at - y > gap / 2 else None
        halo = [withStroke(linewidth=3, foreground=axes.get_facecolor())]
        text = axes.annotate(
            name, (x, y), (x * 1.06, at), fontsize=8, color=colour, va="center", arrowprops=line, zorder=2
        )
        text.set_path_effects(halo)


def strip(path: Path, results: Path, record: RunRecord, title: str, most: int = 6) -> Path | None:
    """Strip of frames with truth above and ours below, worst first; None if the run saved no pictures."""
    shown = record.pictures[:most]
    if not shown:
        return None
    heads = [f"t* {p.t_star}, pose {p.pose}\n{p.psnr_db:.2f} dB" for p in shown]
    rows = {"truth": [p.truth for p in shown], "ours": [p.ours for p in shown]}
    return _grid(path, results, rows, heads, title)


def methods_strip(path: Path, results: Path, runs: Sequence[tuple[str, RunRecord]], title: str) -> Path | None:
    """One frame as frozen by every method, after the truth: the common frame with the greatest spread in PSNR."""
    if not runs:
        return None
    kept = [{(p.t_star, p.pose): p for p in run.pictures} for _, run in runs]
    common = set(kept[0]).intersection(*kept[1:])
    if not common:
        return None

    def spread(key: tuple[int, int]) -> float:
        values = [table[key].psnr_db for table in kept]
        return max(values) - min(values)

    key = max(sorted(common), key=spread)
    cells = [("truth", kept[0][key].truth)]
    cells += [(f"{name}\n{t[key].psnr_db:.2f} dB", t[key].ours) for (name, _), t in zip(runs, kept, strict=True)]
    columns = min(4, len(cells))
    rows = {str(n): [c[1] for c in cells[n : n + columns]] for n in range(0, len(cells), columns)}
    heads = [[c[0] for c in cells[n : n + columns]] for n in range(0, len(cells), columns)]
    return _grid(path, results, rows, heads, f"{title}: t* {key[0]}, pose {key[1]}", named=False)


def two_instants(path: Path, results: Path, record: RunRecord, title: str) -> Path | None:
    """One pose at two instants with the truth and the plates of the instants; None if the run has no such pair."""
    pair: list[Picture] = record.two_instants
    if len(pair) != 2:
        return None
    heads = [f"t* = frame {p.t_star}, seen from {p.pose}" for p in pair]
    rows = {
        "plate at t*": [record.plates[str(p.t_star)] for p in pair],
        "ours": [p.ours for p in pair],
        "truth": [p.truth for p in pair],
    }
    if record.kind == "real":  # the truth of both is the plate at the pose
        rows.pop("truth")
    return _grid(path, results, rows, heads, title)


def _grid(
    path: Path,
    results: Path,
    rows: dict[str, list[str]],
    heads: Sequence[str] | Sequence[list[str]],
    title: str,
    named: bool = True,
) -> Path:
    """Pictures in rows, with a name before each row and a heading over each column or each picture."""
    plt = _pyplot()
    pictures = {name: [read_png(results / p) for p in paths] for name, paths in rows.items()}
    first = next(iter(pictures.values()))[0]
    columns = max(len(row) for row in pictures.values())
    width = 12.0 / max(columns, 3)
    per_picture = bool(heads) and isinstance(heads[0], list)
    tall = width * first.shape[0] / first.shape[1] + (0.42 if per_picture else 0.06)
    lines = max(str(head).count("\n") + 1 for head in (heads[0] if per_picture else heads))
    top = 0.34 + 0.15 * lines
    height = tall * len(pictures) + top
    with plt.rc_context({"font.size": 8}):
        figure, axes = plt.subplots(
            len(pictures), columns, figsize=(width * columns + 0.5 * named, height), squeeze=False, facecolor="white"
        )
        for r, (name, row) in enumerate(pictures.items()):
            for c in range(columns):
                cell: Any = axes[r][c]
                cell.set_axis_off()
                if c >= len(row):
                    continue
                cell.imshow(row[c], interpolation="lanczos")
                if per_picture:
                    cell.set_title(heads[r][c], fontsize=8, pad=3)
                elif r == 0:
                    cell.set_title(str(heads[c]), fontsize=8, pad=3)
            if named:
                axes[r][0].text(-0.03, 0.5, name, rotation=90, ha="right", va="center", transform=axes[r][0].transAxes)
        figure.suptitle(title, fontsize=10, x=0.01, y=0.995, ha="left", va="top", weight="bold")
        figure.subplots_adjust(
            left=0.5 * named / (width * columns + 0.5) + 0.004,
            right=0.996,
            bottom=0.01,
            top=1 - top / height,
            wspace=0.03,
            hspace=0.42 / tall if per_picture else 0.04,
        )
        return _save(figure, path)


def _pyplot() -> Any:
    """matplotlib.pyplot without windows."""
    importlib.import_module("matplotlib").use("Agg")
    return importlib.import_module("matplotlib.pyplot")


def _figure(size: tuple[float, float]) -> tuple[Any, Any]:
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=size, facecolor=_GROUND, layout="constrained")
    axes.set_facecolor(_GROUND)
    axes.tick_params(colors=_INK, which="both", labelsize=8)
    axes.xaxis.label.set_color(_INK)
    axes.yaxis.label.set_color(_INK)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(_GRID)
    return figure, axes


def _save(figure: Any, path: Path) -> Path:
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=150)
    _pyplot().close(figure)
    return path
