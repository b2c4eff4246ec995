"""Records of the ablation, and the table of the worth of each rule."""

from __future__ import annotations

import ast
import re
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.ablate.measures import summary
from benchmarks.ablate.switches import SWEEP
from torch_backend.contract import read_json
from torch_backend.shot import content_key, write_json

RECORD_VERSION = 1
"""Increase to invalidate older records."""
TRUTH = {
    "delivered whole": "whole", "delivered never_seen": "never seen", "delivered moving": "moving",
    "delivered static": "static", "recall": "recall", "over splats": "moving, delivered - developed",
}  # fmt: skip
"""Figure of a record -> its column, against truth; in dB except recall."""
CLIPS = {
    "still": "still, dB", "excess": "p99 residual flow, moving - still, px", "moving_p50": "p50 moving, px",
    "moving_p99": "p99 moving, px", "flicker": "flicker, /255", "decision_s": "decision, CPU s per frame",
    "instant_s": "instant, CPU s",
}  # fmt: skip
"""Figure of a record -> its column, on clips."""
MASKS = {"iou": "IoU of masks", "extra_share": "unchanged pixels rejected, share"}
"""Figure of a record -> its column, against hand-painted masks."""


@dataclass(frozen=True)
class Store:
    """Records in a folder, one JSON file for each variant at each instant of a case."""

    folder: Path
    """Folder of the records of one version of the code."""

    def path(self, case: str, t_star: int, variant: str) -> Path:
        """File of a record."""
        words = [re.sub(r"[^\w+-]+", "-", word).strip("-") for word in (case, f"t{t_star:06d}", variant)]
        return self.folder / words[0] / words[1] / f"{words[2]}.json"

    def has(self, case: str, t_star: int, variant: str) -> bool:
        """True if a variant was measured."""
        return self.path(case, t_star, variant).is_file()

    def save(self, case: str, t_star: int, variant: str, row: dict[str, Any]) -> None:
        """Writes a record atomically."""
        facts = {"version": RECORD_VERSION, "case": case, "t_star": t_star, "variant": variant}
        path = self.path(case, t_star, variant)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, facts | row)

    def records(self) -> list[dict[str, Any]]:
        """All records."""
        return [read_json(path) for path in sorted(self.folder.rglob("t*/*.json"))]


def code_version(root: Path) -> str:
    """Hash of the code of the freeze and of this benchmark, without comments, docstrings and layout.

    Edited documentation therefore keeps existing records valid.
    """
    files = [*sorted((root / "torch_backend" / "freeze").rglob("*.py"))]
    files += [root / "benchmarks" / "ablate" / f"{name}.py" for name in ("switches", "measures", "instants")]
    return content_key(RECORD_VERSION, [_code_of(path) for path in files])[:12]


def _code_of(path: Path) -> str:
    """Dump of a file's syntax tree, which has no comments, after removal of docstrings.

    Every expression statement that is a lone string is a docstring: of a module, class, function, field or constant.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            node.body = [statement for statement in node.body if not _is_docstring(statement)]
    return ast.dump(tree)


def _is_docstring(statement: ast.stmt) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def figures(record: dict[str, Any]) -> dict[str, float | None]:
    """Figures of a record under the names of `TRUTH`, `CLIPS` and `MASKS`."""
    found = summary(record)
    moving, splats = found["delivered moving"], found["developed moving"]
    found["over splats"] = None if moving is None or splats is None else moving - splats
    found["instant_s"] = sum(record.get("seconds", {}).values())
    found["iou"], found["extra_share"] = record.get("iou"), record.get("extra_share")
    return found


def table(records: Iterable[dict[str, Any]], columns: dict[str, str]) -> list[str]:
    """Markdown rows, one per variant: mean difference to `today` over instants, and its standard deviation.

    Only instants with records of both count. "Fires" counts the instants at which any figure except seconds differs.
    """
    by_variant: dict[str, dict[tuple[str, int], dict[str, float | None]]] = {}
    for record in records:
        of = figures(record)
        if any(of.get(name) is not None for name in columns if not name.endswith("_s")):
            by_variant.setdefault(record["variant"], {})[record["case"], record["t_star"]] = of
    today = by_variant.get("today", {})
    lines = [f"| variant | fires | {' | '.join(columns.values())} |", f"|---|---:|{'---:|' * len(columns)}"]
    absolute = [_cell([of[name] for of in today.values()], False) for name in columns]
    lines.append(f"| **today** | {len(today)} instants | {' | '.join(absolute)} |")
    for variant, found in by_variant.items():
        both = [(found[at], today[at]) for at in found if at in today]
        if variant == "today" or not both:
            continue
        cells = [_cell([_less(a[name], b[name]) for a, b in both], True) for name in columns]
        lines.append(f"| {variant} | {sum(_differs(a, b) for a, b in both)} of {len(both)} | {' | '.join(cells)} |")
    return lines


SWEPT = {
    "delivered whole": "whole", "delivered moving": "moving", "delivered static": "static", "still": "still of clips",
    "excess": "residual flow",
}  # fmt: skip
"""Figure of a record -> its heading in the sweep table; in dB except flow, in pixels."""


def sweep_table(records: Iterable[dict[str, Any]]) -> list[str]:
    """Markdown rows, one per number: mean change over instants when halved and doubled; [] without a sweep."""
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    by_place: dict[tuple[str, int], dict[str, dict[str, float | None]]] = {}
    for record in records:
        by_place.setdefault((record["case"], record["t_star"]), {})[record["variant"]] = figures(record)
    for of in by_place.values():
        for variant, changed in of.items():
            word, _, number = variant.partition(" ")
            for name in SWEPT if word in SWEEP and "today" in of else ():
                change = _less(changed.get(name), of["today"].get(name))
                if change is not None:
                    found.setdefault((number, word), {}).setdefault(name, []).append(change)
    heads = [f"{word}: {title}" for word in SWEEP for title in SWEPT.values()]
    lines = [f"| number | {' | '.join(heads)} |", f"|---|{'---:|' * len(heads)}"]
    for number in sorted({number for number, _ in found}):
        of = [found.get((number, word), {}).get(name, []) for word in SWEEP for name in SWEPT]
        lines.append(f"| {number} | {' | '.join(f'{statistics.fmean(v):+.2f}' if v else '–' for v in of)} |")
    return lines if found else []


def case_table(records: Iterable[dict[str, Any]], columns: dict[str, str], variants: Sequence[str]) -> list[str]:
    """Markdown rows: figures of some variants by case, means over its instants."""
    rows: dict[tuple[str, str], list[dict[str, float | None]]] = {}
    for record in records:
        if record["variant"] in variants:
            rows.setdefault((record["case"], record["variant"]), []).append(figures(record))
    lines = [
        f"| case | variant | instants | {' | '.join(columns.values())} |",
        f"|---|---|---:|{'---:|' * len(columns)}",
    ]
    for (case, variant), found in sorted(rows.items(), key=lambda row: (row[0][0], variants.index(row[0][1]))):
        cells = [_cell([of.get(name) for of in found], False) for name in columns]
        if any(cell != "–" for cell, name in zip(cells, columns, strict=True) if not name.endswith("_s")):
            lines.append(f"| {case} | {variant} | {len(found)} | {' | '.join(cells)} |")
    return lines


def _less(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _differs(a: dict[str, float | None], b: dict[str, float | None]) -> bool:
    return any(a[name] != b[name] for name in a if not name.endswith("_s"))


def _cell(values: Sequence[float | None], signed: bool) -> str:
    """Mean and standard deviation of the values that are not None."""
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    sign = "+" if signed else ""
    spread = f" ± {statistics.stdev(known):.2f}" if len(known) > 1 else ""
    return f"{statistics.fmean(known):{sign}.2f}{spread}"
