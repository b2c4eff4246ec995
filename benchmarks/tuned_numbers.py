"""Counts the numbers by which the freeze is tuned: `python -m benchmarks.tuned_numbers [--list]`.

Counts the numbers of `views`, `instant` and `composite` in torch_backend/freeze: those of fields and constants (each
element of a tuple), and literals in the code. A number counts as tuned unless it is one of these:

- trivial: 0, 1, 2, 3, 4 and one half in the code, used for dimensions, pixel centres, windows and even odds;
- a guard, except in fields: at most 1e-3 or at least 1e4, which keeps a quotient or a logarithm finite;
- in `UNTUNED`: a resource (bytes, rows, cache sizes), a format (steps of a file, transfer functions, versions), a unit,
  or a proven mathematical constant.

The variants `sweep-frame` and `sweep-scene` of benchmarks.ablate measure the effect of halving and doubling a number.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOMS = ("views", "instant", "composite")
TRIVIAL = {0.0, 0.5, 1.0, 2.0, 3.0, 4.0}
"""Values ignored in code. Fields and constants count with any value except 0."""
GUARDS = 1e-3, 1e4
"""Numbers of code and constants up to the first or from the second value on are guards."""
UNTUNED = {
    "views/reproject.py:_REACH": "mathematics",
    "views/scene_flow.py:_KEPT": "resource",
    "views/scene_flow.py:HIDDEN": "guard",
    "views/source_views.py:LENGTHS_OF": "unit",
    "views/source_views.py:_VIEWS _VIEWS_BYTES": "resource",
    "views/source_views.py:_RESIDUALS_BYTES": "resource",
    "views/source_views.py:_FINEST": "resource",
    "views/source_views.py:_ROWS": "resource",
    "views/source_views.py:SourceViews.__init__": "resource",
    "views/source_views.py:SourceViews.view": "resource",
    "views/source_views.py:SourceViews.residual": "resource",
    "views/source_views.py:SourceViews.difference": "resource",
    "views/source_views.py:SourceViews._missed": "resource",
    "views/target_view.py:target_view": "resource",
    "views/visibility.py:_POINTS": "resource",
    "views/working_plates.py:WorkingPlates.__init__": "resource",
    "views/working_plates.py:WorkingPlates.picture": "format",
    "instant/develop.py:_FineTuning._judged": "unit",
    "instant/instants.py:VERSION": "format",
    "instant/instants.py:MOST": "resource",
    "instant/missing.py:with_missing": "guard",
    "instant/static_baseline.py:_Pair.__init__": "unit",
    "composite/compositor.py:_MIN_MATTE": "format",
    "composite/compositor.py:Compositor._mix_frame": "format",
    "composite/fill.py:FULL_MATTE": "format",
    "composite/fill.py:Filling.most": "format",
    "composite/fill.py:fillers_of": "format",
    "composite/filled.py:_PIXELS": "resource",
    "composite/filled.py:filled": "format",
    "composite/grain.py:SAMPLED": "resource",
    "composite/grain.py:BINS": "format",
    "composite/grain.py:Grain.to_json": "format",
    "composite/grain.py:measure": "mathematics",
    "composite/grain.py:_noise": "format",
    "composite/grain.py:_basis": "mathematics",
    "composite/grain.py:_blocks": "format",
    "composite/grain.py:_kept": "resource",
    "composite/grain.py:_LAGS": "mathematics",
    "composite/grain.py:_SOFTNESS": "resource",
    "composite/grain.py:_median_ratio": "mathematics",
    "composite/primary_source.py:_places": "guard",
    "composite/surface_depth.py:TO_SIGMA": "mathematics",
    "composite/surface_depth.py:_QUANTUM": "format",
    "composite/surface_depth.py:_SLOPE_NOISE": "mathematics",
    "composite/surface_depth.py:_slope": "mathematics",
    "composite/planes.py:fit_planes": "mathematics",
    "composite/surface_depth.py:frame_depth": "guard",
    "composite/surface_depth.py:FrameDepths._key": "guard",
    "composite/transfer.py:_BLOCKS": "resource",
    "composite/warp.py:WARP_VERSION": "format",
    "composite/warp.py:STEPS": "format",
    "composite/warp.py:_ROWS": "resource",
    "composite/warp.py:read_warp": "format",
}
"""`file:name` of a constant, field or function -> why its numbers are not tuned. A wrong entry is a bug."""


@dataclass(frozen=True)
class Number:
    """One number in the code."""

    file: str
    """Path below torch_backend/freeze."""
    line: int
    """Line number."""
    name: str
    """The field, constant or function of the number."""
    value: float
    """Value of the number."""
    kind: str
    """`tuned`, `guard`, or a value of `UNTUNED`."""


def numbers_of(file: str, text: str) -> Iterator[Number]:
    """Yields the non-trivial numbers of a module; `file` is its path below torch_backend/freeze."""
    for name, node, is_named in _places(ast.parse(text)):
        for each in ast.walk(node):
            if not isinstance(each, ast.Constant) or isinstance(each.value, bool):
                continue
            if not isinstance(each.value, int | float):
                continue
            value = abs(float(each.value))
            if value == 0.0 or (not is_named and value in TRIVIAL):
                continue
            kind = UNTUNED.get(f"{file}:{name}")
            if kind is None:
                is_field = is_named and "." in name
                kind = "tuned" if is_field or GUARDS[0] < value < GUARDS[1] else "guard"
            yield Number(file, each.lineno, name, each.value, kind)


def _places(tree: ast.Module) -> Iterator[tuple[str, ast.AST, bool]]:
    """Yields (name, syntax tree to search, True for a field or a constant) of every part of a module."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            for part in node.body:
                if isinstance(part, ast.AnnAssign) and part.value is not None and isinstance(part.target, ast.Name):
                    yield f"{node.name}.{part.target.id}", part.value, _is_plain(part.value)
                elif isinstance(part, ast.FunctionDef):
                    yield f"{node.name}.{part.name}", part, False
        elif isinstance(node, ast.FunctionDef):
            yield node.name, node, False
        elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
            yield " ".join(names), node.value, _is_plain(node.value)


def _is_plain(value: ast.expr) -> bool:
    """True for a number, or a tuple or product of numbers, without calls, subscripts or names."""
    return not any(isinstance(each, ast.Call | ast.Subscript | ast.Name) for each in ast.walk(value))


def numbers(freeze: Path) -> list[Number]:
    """All non-trivial numbers of the freeze."""
    files = [path for room in ROOMS for path in sorted((freeze / room).glob("*.py"))]
    return [
        each
        for path in files
        for each in numbers_of(path.relative_to(freeze).as_posix(), path.read_text(encoding="utf-8"))
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="list every tuned number")
    parser.add_argument("--all", action="store_true", help="list every number")
    args = parser.parse_args(argv)
    found = numbers(Path(__file__).resolve().parents[1] / "torch_backend" / "freeze")
    for each in found if args.list or args.all else ():
        if args.all or each.kind == "tuned":
            print(f"{each.file}:{each.line}  {each.name} = {each.value:g}  {each.kind}")
    tuned = Counter(each.file for each in found if each.kind == "tuned")
    print("\n".join(f"{count:4d} {file}" for file, count in tuned.items()))
    for name in sorted(UNTUNED.keys() - {f"{each.file}:{each.name}" for each in found}):
        print(f"{name} no longer exists.")
    kinds = Counter(each.kind for each in found)
    print("Tuned: {}. Not tuned: {}.".format(
        kinds.pop("tuned", 0), ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items()))
    ))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
