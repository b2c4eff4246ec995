"""Compares the pixels that a variant rejects of a frame's own plate with hand-painted masks (`other_state`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.ablate.cases import Case
from benchmarks.ablate.instants import Instant
from benchmarks.ablate.measures import FrameMaker, Row
from benchmarks.ablate.switches import COMBINATIONS, RULES, STATE, of_frames, replaced
from benchmarks.ablate.table import Store
from benchmarks.other_state.masks import CLIPS, Painted, Pair, load_masks, plate_labels
from benchmarks.other_state.scores import LET_GO, count
from benchmarks.report.metrics import known_mean
from torch_backend.lens.plate_lens import load_plate_lenses

RATIOS = ("iou", "extra_share")


def variants() -> dict[str, frozenset[str]]:
    """Name -> frame rules that are off: combinations, and each rule that decides whether the own plate is used."""
    named = {name: disabled for name, disabled in COMBINATIONS.items() if disabled == of_frames(disabled)}
    return named | {f"no {rule.name}": frozenset({rule.name}) for rule in STATE if rule.name in RULES}


def judge_masks(case: Case, store: Store) -> None:
    """Measures every variant at the painted pairs of a clip, on today's scene. A clip without masks is skipped."""
    name = Path(case.clip.shot.info().source).stem
    if name not in CLIPS:
        return
    masks, case_name = load_masks(name), f"{case.name} masks"
    for t_star in sorted({pair.t_star for pair in masks.pairs}):
        todo = {name: disabled for name, disabled in variants().items() if not store.has(case_name, t_star, name)}
        if todo:
            maker = FrameMaker(case.clip, t_star, Instant(case.clip.frozen(t_star), "", {}))
            pairs = [pair for pair in masks.pairs if pair.t_star == t_star]
            with replaced("composite.compositor", "fillers_of", lambda _: lambda *_: None):  # the fill is not judged
                for name, row in _judged(maker, masks, pairs, todo).items():
                    store.save(case_name, t_star, name, row)


def _judged(
    maker: FrameMaker, masks: Painted, pairs: list[Pair], todo: Mapping[str, frozenset[str]]
) -> dict[str, Row]:  # fmt: skip
    """{variant: figures} at one instant."""
    clip, rows = maker.clip, {name: list[Row]() for name in todo}
    lenses = load_plate_lenses(clip.shot)
    scale = np.array([masks.width / clip.width, masks.height / clip.height], np.float32)
    for pair in pairs:
        where = lenses[pair.frame].where(clip.width, clip.height) * scale
        labels = plate_labels(masks.labels(pair), where)
        for name, disabled in todo.items():
            composite, decided, _ = maker.make(pair.frame, disabled)
            rejected = (composite.matte < LET_GO) | (composite.primary != pair.frame)
            counts = count(rejected.numpy(), labels)
            ratios = {key: getattr(counts, key) for key in RATIOS}
            rows[name].append({"frame": pair.frame, "decision_s": decided, **ratios, **asdict(counts)})
    return {
        name: {"frames": found, "seconds": {}, **{key: known_mean(of[key] for of in found) for key in RATIOS}}
        for name, found in rows.items()
    }
