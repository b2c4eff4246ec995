"""Measures the worth of each rule of the freeze: `python -m benchmarks.ablate SCENE ... --clip SHOT ... --results DIR`.

Every rule and term of the freeze is switched off alone and in named combinations (`switches.py`). SCENE is a folder of
benchmarks/synthetic; SHOT is a trained clip. Scenes are judged against truth: dB of delivered and developed frames by
region, and recall of small objects. Clips are judged at instants drawn by a seed, except those used for tuning. Their
figures are dB of still pixels, residual flow and flicker between neighbouring frozen frames, and CPU seconds. Each
variant at each instant is one JSON file in DIR/ablate/CODE, so an interrupted run continues where it stopped. `--table`
only prints the tables of existing records.

Flicker is the mean absolute difference of two neighbouring frozen frames, on a scale of 0..255. The second frame is
warped to the first by frozen depth and cameras; only pixels visible in both count. The spread in the table is the
standard deviation over instants, scenes and seeds.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")


from benchmarks.ablate.cases import Case, clip_case, pairs_of, scene_case
from benchmarks.ablate.instants import Instants
from benchmarks.ablate.masks import judge_masks
from benchmarks.ablate.measures import FrameMaker, Row, judge, poses_of
from benchmarks.ablate.switches import COMBINATIONS, of_frames, variants
from benchmarks.ablate.table import CLIPS, MASKS, TRUTH, Store, case_table, code_version, sweep_table, table
from benchmarks.sources import in_words

ROOT = Path(__file__).resolve().parents[2]
SHOWN_BY_CASE = tuple(COMBINATIONS)
"""Variants whose figures are printed for each case."""


class Ablation:
    """One run of the ablation."""

    def __init__(self, store: Store, kept: Path, args: argparse.Namespace) -> None:
        self.store, self.kept, self.args = store, kept, args
        self.ends = time.monotonic() + args.seconds if args.seconds else float("inf")

    def run(self, cases: Sequence[Case]) -> None:
        """Measures every variant without a record, until time is up: first instants of all cases, then second ones."""
        most = self.args.instants or max(len(case.t_stars) for case in cases)
        for n in range(most):
            for case in cases:
                if n < len(case.t_stars):
                    self._instant(case, case.t_stars[n])

    def _instant(self, case: Case, t_star: int) -> None:
        names = variants(tuple(self.args.variants))
        if case.truth is None and self.args.clip_variants:
            names = variants(tuple(self.args.clip_variants))
        todo = {name: disabled for name, disabled in names.items() if not self.store.has(case.name, t_star, name)}
        instants = Instants(case.clip, t_star, self.kept)
        for disabled_scene_rules, group in _by_scene(todo):
            if time.monotonic() > self.ends:
                return
            since = time.monotonic()
            self._scene(case, instants, disabled_scene_rules, group)
            what = f"{len(group)} variants on the scene without {', '.join(sorted(disabled_scene_rules)) or 'nothing'}"
            print(f"{case.name}, t* {t_star}: {what}, {time.monotonic() - since:.0f} s", flush=True)

    def _scene(
        self, case: Case, instants: Instants, disabled_scene_rules: frozenset[str], group: dict[str, frozenset[str]]
    ) -> None:
        t_star, instant = instants.t_star, instants.make(disabled_scene_rules)
        poses = [] if case.truth is None else poses_of(case.truth, t_star, self.args.every)
        pairs = [] if case.truth is not None else pairs_of(case, t_star, self.args.pairs, self.args.draw)
        maker = FrameMaker(case.clip, t_star, instant)
        for name, rules in group.items():
            disabled = of_frames(rules)
            row = self._judged(case, t_star, instant.key, disabled)
            if row is None:
                row = judge(case, maker, {name: disabled}, poses, pairs)[name]
            facts = {"scene": instant.key, "frame_rules": sorted(disabled), "seconds": instant.seconds}
            self.store.save(case.name, t_star, name, row | facts)

    def _judged(self, case: Case, t_star: int, key: str, disabled: frozenset[str]) -> Row | None:
        """Figures of a recorded variant with the same scene and frame rules; None if there is none."""
        place = self.store.path(case.name, t_star, "today").parent
        for record in Store(place.parent).records() if place.is_dir() else ():
            if (record["t_star"], record["scene"], record["frame_rules"]) == (t_star, key, sorted(disabled)):
                return {"frames": record["frames"]}
        return None


def _by_scene(todo: dict[str, frozenset[str]]) -> Iterator[tuple[frozenset[str], dict[str, frozenset[str]]]]:
    """Yields (scene rules that are off, variants that share them)."""
    groups: dict[frozenset[str], dict[str, frozenset[str]]] = {}
    for name, disabled in todo.items():
        groups.setdefault(disabled - of_frames(disabled), {})[name] = disabled
    yield from groups.items()


def tables(store: Store) -> list[str]:
    """Lines of all tables of the records."""
    records = store.records()
    lines = [f"Records of the freeze {store.folder.name}: {len(records)}."]
    for title, columns in (("Against truth", TRUTH), ("On clips", CLIPS), ("Masks painted by hand", MASKS)):
        lines += ["", f"{title}: difference to `today`, mean ± standard deviation over instants, scenes and seeds", ""]
        lines += table(records, columns)
        lines += ["", *case_table(records, columns, SHOWN_BY_CASE)]
    swept = sweep_table(records)
    lines += ["", "Numbers halved and doubled: difference to `today`", "", *swept] if swept else []
    drawn = sorted({(record["case"], record["t_star"]) for record in records})
    return [*lines, "", "Instants: " + ", ".join(f"{case} {t_star}" for case, t_star in drawn) + "."]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE")
    parser.add_argument(
        "--clip",
        action="append",
        type=Path,
        default=[],
        metavar="SHOT",
        help="folder of a trained shot; may be repeated",
    )
    parser.add_argument("--run", default="main", metavar="NAME", help="run of each clip")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--lent", type=Path, metavar="DIR", help="results folder of benchmarks.detail_truth; its runs are copied"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], metavar="N", help="training seeds of scenes")
    parser.add_argument(
        "--draw", type=int, default=62, metavar="N", help="seed that draws the instants and frames of clips"
    )
    parser.add_argument(
        "--variants", nargs="+", default=["combinations", "frame", "scene"], metavar="NAME",
        help="groups (combinations, frame, scene) or single variants",
    )  # fmt: skip
    parser.add_argument(
        "--clip-variants", nargs="+", metavar="NAME", help="groups or variants for clips (default: those of --variants)"
    )
    parser.add_argument("--every", type=int, default=3, metavar="K", help="judge every K-th pose of a scene")
    parser.add_argument(
        "--pairs", type=int, default=2, metavar="N", help="pairs of neighbouring frames per instant of a clip"
    )
    parser.add_argument(
        "--instants", type=int, default=0, metavar="N", help="maximum number of instants per case (default: all)"
    )
    parser.add_argument(
        "--seconds", type=float, default=0.0, metavar="S", help="start no measurement after S seconds (0: no limit)"
    )
    parser.add_argument("--masks", action="store_true", help="only judge clips by hand-painted masks")
    parser.add_argument("--table", action="store_true", help="only print the tables of existing records")
    return parser


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    args = _parser().parse_args(argv)
    how = f"every{args.every}-pairs{args.pairs}-draw{args.draw}"
    store = Store(args.results / "ablate" / f"{code_version(ROOT)}-{how}")
    if not args.table:
        results = args.results.absolute()
        cases = [scene_case(folder, seed, results, args.lent) for seed in args.seeds for folder in args.scenes]
        cases += [clip_case(path, args.run, args.draw) for path in args.clip]
        for case in cases if args.masks else ():
            judge_masks(case, store)
        if cases and not args.masks:
            Ablation(store, args.results / "ablate" / "instants", args).run(cases)
    print("\n".join(["", *tables(store)]))


if __name__ == "__main__":
    sys.exit(main())
