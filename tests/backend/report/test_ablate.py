"""The ablation benchmark on the tiny world: switches, records and table."""

import argparse
import dataclasses
import functools
import importlib
from collections import Counter

import numpy as np
import pytest
import torch

from benchmarks.ablate import masks
from benchmarks.ablate.__main__ import Ablation, tables
from benchmarks.ablate.cases import TUNED_AT, Case, drawn, pairs_of
from benchmarks.ablate.instants import Instants, digest
from benchmarks.ablate.measures import FrameMaker, summary
from benchmarks.ablate.switches import COMBINATIONS, FRAME, RULES, detail_config, replaced, rules_disabled, variants
from benchmarks.ablate.table import TRUTH, Store, sweep_table, table
from benchmarks.detail_clip import open_clip
from benchmarks.other_state import CHANGED, Painted, Pair, Polygon


@pytest.fixture(scope="module")
def clip(trained):
    return open_clip(trained.shot.root)


@pytest.fixture(scope="module")
def instants(clip):
    return Instants(clip, clip.run.train_frames[6])


def current_value(switch):
    found = importlib.import_module(f"torch_backend.freeze.{switch.module}")
    for name in switch.name.split("."):
        found = getattr(found, name)
    return found


@pytest.mark.parametrize("rule", RULES.values(), ids=lambda rule: rule.name)
def test_disabled_rule_is_restored(rule):
    before = [current_value(switch) for switch in rule.switches]
    with pytest.raises(ArithmeticError), rules_disabled(frozenset({rule.name})):
        assert all(current_value(switch) is not was for switch, was in zip(rule.switches, before, strict=True))
        raise ArithmeticError  # restored even if the measurement fails
    assert [current_value(switch) for switch in rule.switches] == before
    config = detail_config(frozenset({rule.name}))
    assert all(functools.reduce(getattr, name.split("."), config) == value for name, value in rule.numbers.items())
    assert rule.switches or rule.numbers


def test_groups_of_variants():
    assert COMBINATIONS["motion alone"] < variants(("combinations",))["mattes alone"]
    frame, scene = variants((FRAME,)), variants(("scene",))
    swept = variants(("sweep-frame", "sweep-scene"))
    assert not frame.keys() & scene.keys() - {"today"} and swept.keys() & scene.keys() == {"today"}
    assert len(frame) + len(scene) + len(swept) == len(RULES) + 3
    assert detail_config(swept["twice doubt"]).doubt == 2.0 * detail_config(swept["today"]).doubt
    with pytest.raises(ValueError, match="no group or variant 'bent'"):
        variants(("bent",))


def brightened(step, counts=None):
    """Develop step that also brightens the scene, so that it has an effect on every CPU; `counts` counts its calls."""

    def brighten(*args, **more):
        if counts is not None:
            counts["develop"] += 1
        frozen = step(*args, **more)
        return dataclasses.replace(frozen, state={**frozen.state, "sh0": frozen.state["sh0"] + 0.05})

    return brighten


def test_shared_steps_of_variants_run_once(instants, clip):
    """Switching `develop` off reuses the earlier steps; switching a frame rule off reuses all steps."""
    counts = Counter[str]()
    with replaced("instant.repairs", "develop", functools.partial(brightened, counts=counts)):
        today = instants.make(frozenset())
        assert instants.make(frozenset({next(n for n, r in RULES.items() if r.stage == FRAME)})).key == today.key
    assert counts == {"develop": 1}
    plain = instants.make(frozenset({"develop"}))
    assert plain.key != today.key and plain.frozen.descent is not None
    assert torch.equal(plain.frozen.state["means"], plain.frozen.descent.state["means"])
    assert set(plain.seconds) == set(today.seconds) - {"develop"} and all(s >= 0.0 for s in today.seconds.values())


def test_a_developed_scene_is_kept_whole_and_read_again(clip, tmp_path):
    ways = [Instants(clip, clip.run.train_frames[6], tmp_path).make(frozenset()) for _ in range(2)]
    assert len(list(tmp_path.iterdir())) == 1 and ways[0].key == ways[1].key
    assert ways[0].seconds["develop"] == ways[1].seconds["develop"] > 0.0, "the second was read"


def test_a_rule_of_frames_changes_the_frame_and_not_for_long(instants, clip):
    maker = FrameMaker(clip, instants.t_star, instants.make(frozenset()))
    frame = clip.frames[1]
    today = maker.make(frame, frozenset())[0]
    bare, decided, took = maker.make(frame, frozenset({"residuals"}))
    assert not torch.equal(bare.linear, today.linear) and torch.equal(bare.matte, today.matte)
    assert 0.0 < decided < took
    again = maker.make(frame, frozenset())[0]
    assert torch.equal(again.linear, today.linear) and torch.equal(again.depth, today.depth)


def test_what_was_measured_is_not_measured_again(clip, tmp_path):
    case = Case("tiny", clip, [clip.run.train_frames[6]], None)
    args = argparse.Namespace(
        variants=["no residuals", "no develop"], clip_variants=None, every=1, pairs=2, draw=0, instants=0, seconds=0.0
    )
    store = Store(tmp_path / "code")
    with replaced("instant.repairs", "develop", brightened):
        Ablation(store, tmp_path / "kept", args).run([case])
    first = {path: path.stat().st_mtime_ns for path in store.folder.rglob("*.json")}
    assert {path.stem for path in first} == {"today", "no-residuals", "no-develop"}
    assert list((tmp_path / "kept").glob("develop-*.safetensors"))
    text = "\n".join(tables(store))
    assert "| no residuals | " in text and "| no develop | 1 of 1 | " in text and text.endswith("tiny 107.")
    Ablation(store, tmp_path / "kept", args).run([case])
    assert {path: path.stat().st_mtime_ns for path in store.folder.rglob("*.json")} == first


def test_instants_and_pairs_are_drawn_by_seed_and_never_where_rules_were_tuned(clip):
    frames = list(range(1, 75))
    ways = [drawn("sitting", frames, seed) for seed in range(20)]
    assert ways[0] == drawn("sitting", frames, 0) != ways[1] and all(len(set(way)) == 6 for way in ways)
    assert not {frame for way in ways for frame in way} & set(TUNED_AT["sitting"])
    case, t_star = Case("tiny", clip, [], None), clip.frames[4]
    pairs = pairs_of(case, t_star, 3, 0)
    assert len(pairs) == 3 and all(clip.frames.index(b) == clip.frames.index(a) + 1 for a, b in pairs)
    assert not any(t_star in pair for pair in pairs)


def test_differences_are_of_instants_that_both_variants_have():
    def record(variant: str, t_star: int, whole: float, seconds: float = 1.0) -> dict:
        frame = {"delivered": {"whole": whole}, "developed": {}, "recalled": {"arm": [1, 4]}, "decision_s": seconds}
        return {"case": "a", "t_star": t_star, "variant": variant, "frames": [frame], "seconds": {}}

    rows = [record("today", 1, 30.0), record("today", 2, 20.0), record("no x", 1, 30.5), record("no x", 3, 90.0)]
    assert summary(rows[0])["recall"] == 0.25 and summary(rows[0])["delivered whole"] == 30.0
    lines = table([*rows, record("no y", 1, 30.0, 2.0)], TRUTH)
    assert lines[2].startswith("| **today** | 2 instants | 25.00 ± 7.07 |")
    assert lines[3].startswith("| no x | 1 of 1 | +0.50 |") and lines[4].startswith("| no y | 0 of 1 | +0.00 |")
    assert not sweep_table(rows)
    lines = sweep_table([*rows, record("half z", 1, 29.0), record("half z", 2, 20.5), record("twice z", 2, 21.5)])
    assert lines[2:] == ["| z | -0.25 | – | – | – | – | +1.50 | – | – | – | – |"]


def test_digests_tell_content_and_not_objects():
    a, b = torch.zeros(3), torch.zeros(3)
    assert digest([a, {"x": 1}, object()]) == digest([b, {"x": 1}, object()])
    assert len({digest([a]), digest([a.double()]), digest([a[:2]]), digest([a + 1]), digest([])}) == 5


def test_rejected_pixels_are_scored_against_painted_masks(clip, tmp_path, monkeypatch):
    """The whole plate is painted as another state, so the removed fraction of a frame is its IoU."""
    t_star, frame = clip.run.train_frames[6], clip.run.train_frames[2]
    whole = Polygon(
        np.array([(0, 0), (clip.width, 0), (clip.width, clip.height), (0, clip.height)], float), "", CHANGED
    )
    painted = Painted("tiny", "", clip.width, clip.height, (Pair(t_star, frame, 0, (whole,)),))
    case, store = Case("tiny", clip, [], None), Store(tmp_path)
    masks.judge_masks(case, store)
    assert not store.records()  # no masks were painted for this clip
    monkeypatch.setattr(masks, "CLIPS", (clip.shot.info().source.rpartition("/")[2].partition(".")[0],))
    monkeypatch.setattr(masks, "load_masks", lambda _: painted)
    monkeypatch.setattr(masks, "load_plate_lenses", lambda _: {frame: AsItIs()})
    masks.judge_masks(case, store)
    found = {record["variant"]: record for record in store.records()}
    assert {"today", "no scene flow", "mattes alone"} <= set(found) and "no develop" not in found
    today = found["today"]["frames"][0]
    assert today["iou"] == pytest.approx(today["both"] / (clip.width * clip.height)) and 0.0 < today["iou"] < 1.0


class AsItIs:
    """Lens without distortion."""

    def where(self, width: int, height: int) -> np.ndarray:
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return np.stack([x, y], axis=-1).astype(np.float32)
