"""Writes the report's folder from a folder of records: report.json, report.md, plots and strips."""

from __future__ import annotations

import dataclasses
import html
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch_backend.shot import write_atomic, write_json

from . import plots
from .metrics import WHOLE
from .records import DELIVERED, RunRecord, load_records, machine_facts
from .setting import NONE, Setting
from .tables import Table, all_tables, markdown, pace, settings_of, to_be_seen
from .truth import RIGID

TITLE = "Frozen time: speed against error"


def write_report(
    results: Path, folder: Path, run_ids: Sequence[str] | None = None, missing: Sequence[str] = (), command: str = ""
) -> Path:
    """Writes the report of the records in `results`, or of those of `run_ids`, and returns its Markdown file.

    Args:
        folder: made if missing; files of an older report are replaced.
        missing: sentences about missing parts, in addition to the metrics that the records lack.
        command: command that repeats the benchmark.

    ValueError without records, or for a damaged one. Without matplotlib a sentence replaces the plots.
    """
    records = load_records(results, run_ids)
    if not records:
        raise ValueError(f"{results} holds no record of a finished run: there is nothing to report")
    missing = [*missing, *sorted({sentence for r in records for sentence in r.missing.values()})]
    folder.mkdir(parents=True, exist_ok=True)
    tables = all_tables(records)
    settings = [s for kind in ("synthetic", "real") for s in settings_of(records, kind)]
    pictures: list[tuple[str, Path]] = []
    if plots.available():
        pictures = [*_plots(records, folder), *_figures(settings, results, folder)]
    else:
        missing.append("There are no plots: matplotlib is not installed (requirements/bench.txt).")
    facts = _facts(records, command)
    write_json(folder / "report.json", _json(records, tables, missing, command))
    write_atomic(folder / "report.md", _markdown(facts, missing, tables, pictures, folder).encode("utf-8"))
    return folder / "report.md"


def _facts(records: Sequence[RunRecord], command: str) -> list[str]:
    """Lines of Markdown with HTML: runs, machines, dates, command."""
    machines = sorted({f"{r.machine['processor']}, {r.machine['cores']} cores" for r in records if r.machine})
    dates = sorted(r.finished for r in records if r.finished)
    scenes = sorted({f"{r.scene} ({r.kind}, {r.cameras} cameras)" for r in records})
    lines = [f"Runs: {len(records)}; scenes: {', '.join(scenes)}"]
    lines += [f"Machine: {'; '.join(machines)}"] if machines else []
    paces = sorted({pace(r) for r in records} - {NONE})
    lines += [f"Threads per run × runs at once: {', '.join(paces)}; all times are of that"] if paces else []
    lines += [f"Runs finished {dates[0]} to {dates[-1]} UTC"] if dates else []
    lines = [html.escape(line) for line in lines]
    return [*lines, f"Command: <code>{html.escape(command)}</code>"] if command else lines


def _plots(records: Sequence[RunRecord], folder: Path) -> list[tuple[str, Path]]:
    drawn: list[tuple[str, Path]] = []
    for kind, region in (("synthetic", WHOLE), ("real", RIGID)):
        settings = [s for s in settings_of(records, kind) if s.variant in ("default", "reference") and to_be_seen(s)]
        for cost, (axis, _) in plots.COSTS.items():
            path = plots.cost_plot(folder / f"{kind}_{cost}.png", settings, cost, region)
            if path is not None:
                drawn.append((f"PSNR of frozen frames ({kind}) against {axis}", path))
    return drawn


def _figures(settings: Sequence[Setting], results: Path, folder: Path) -> list[tuple[str, Path]]:
    """Figures per scene: every method on one frame, our worst frames, one pose at two instants."""
    figures: list[tuple[str, Path]] = []
    scenes = dict.fromkeys((run.scene, run.cameras) for s in settings for run in s.runs)
    for scene, cameras in scenes:
        named = [
            (s.label, run)
            for s in settings
            for run in s.runs
            if to_be_seen(s) and (run.scene, run.cameras, run.variant) == (scene, cameras, "default")
        ]
        if not named:
            continue
        seed = min(run.seed for _, run in named)
        named = [(label, run) for label, run in named if run.seed == seed]
        shown = [(n, r) for n, r in named if r.host == "auto"]
        label, ours = next(((n, r) for n, r in shown if r.shown == DELIVERED), (shown or named[-1:])[0])
        stem = re.sub(r"[^\w-]+", "-", f"{scene}-{cameras}")
        parts = {
            f"{stem}_methods.png": plots.methods_strip(folder / f"{stem}_methods.png", results, named, scene),
            f"{stem}_worst.png": plots.strip(folder / f"{stem}_worst.png", results, ours, f"{scene}, {label}: worst"),
            f"{stem}_two_instants.png": plots.two_instants(
                folder / f"{stem}_two_instants.png", results, ours, f"{scene}, {label}: one pose, two instants"
            ),
        }
        figures += [(name.removesuffix(".png").replace("_", ": "), path) for name, path in parts.items() if path]
    return figures


def _markdown(
    facts: Sequence[str],
    missing: Sequence[str],
    tables: Sequence[Table],
    pictures: Sequence[tuple[str, Path]],
    folder: Path,
) -> str:
    lines = [f"# {TITLE}", "", "  \n".join(facts), ""]
    if missing:
        lines += ["## What is missing", "", *(f"- {sentence}" for sentence in missing), ""]
    lines += ["## Tables", "", *(markdown(table) for table in tables)]
    if pictures:
        lines += ["## Pictures", ""]
        lines += [f"![{name}]({path.relative_to(folder).as_posix()})\n" for name, path in pictures]
    return "\n".join(lines) + "\n"


def _json(
    records: Sequence[RunRecord], tables: Sequence[Table], missing: Sequence[str], command: str
) -> dict[str, Any]:
    return {
        "version": 1,
        "written": time.strftime("%Y-%m-%d %H:%M", time.gmtime()),
        "command": command,
        "machine": machine_facts(),
        "missing": list(missing),
        "tables": [dataclasses.asdict(table) for table in tables],
        "runs": [dataclasses.asdict(record) for record in records],
    }
