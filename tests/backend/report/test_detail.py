"""Benchmarks of plate detail on a trained shot with a known moving patch."""

import itertools
import json
import shutil

import numpy as np
import pytest

from benchmarks import detail, detail_cost, detail_flow, detail_truth
from benchmarks.detail_clip import VARIANTS, open_clip
from benchmarks.other_state import CHANGED, Painted, Pair, Polygon, score
from benchmarks.other_state import __main__ as other_state_main
from torch_backend.footage.images import read_png
from torch_backend.footage.plates import Plates
from torch_backend.shot import Shot, write_json


@pytest.fixture(scope="module")
def shot(trained):
    return trained.shot


def test_delivered_is_the_plate_where_nothing_moves_and_withheld_is_not(shot, tmp_path):
    clip = open_clip(shot.root)
    assert (clip.width, clip.height) == (64, 48) and len(clip.held_out()) == 1
    suggested, second_instant = clip.instants()
    assert abs(suggested - second_instant) >= 7 and {suggested, second_instant} <= set(clip.run.train_frames)
    frames = [*clip.held_out(), clip.frames[3], clip.frames[12]]
    found = detail.judge(clip, [suggested, second_instant], frames, tmp_path / "strips", worst=1)
    assert [f["t_star"] for f in found["freezes"]] == [suggested, second_instant]
    for freeze in found["freezes"]:
        mean = freeze["mean"]
        still = [mean[variant]["still_db"] for variant in VARIANTS]
        better = itertools.pairwise(still)
        assert all(after > before - 0.01 for before, after in better), "at 53 dB one may be as good as the next"
        assert still[3] > max(45, still[2] + 3)
        assert mean["delivered"]["best_90_db"] > mean["splats"]["best_90_db"]
        assert all(0.1 < row["still_share"] < 0.95 for row in freeze["frames"])
    assert found["instants_differ_255"] < 1.0 and found["motion_from"] == clip.motion_from
    strips = list((tmp_path / "strips").glob("*.png"))
    assert len(strips) == 2 and read_png(strips[0]).shape == (48, 5 * 64, 3)
    assert len(detail.table("tiny", found)) == 2 + 12 + 2
    only_first = detail.judge(open_clip(shot.root, develop=False), [suggested], frames[:1])["freezes"][0]["mean"]
    first = found["freezes"][0]["frames"][0]
    assert list(only_first) == ["splats", "withheld", "delivered"]
    assert only_first["splats"]["still_db"] == pytest.approx(first["splats"]["still_db"], abs=0.01)


def test_movers_of_the_plates_are_static_in_the_freeze(shot):
    """At a width of 320 the patch moves by up to 7 pixels per frame in the plates, but not in the frozen frames."""
    clip = open_clip(shot.root, width=320, develop=False)
    t_star = clip.frames[8]
    found = detail_flow.judge_flow(clip, t_star, [(109, 110), (110, 111)])
    restless = {what: of["moving"]["unsteady_255"] for what, of in found["clip"].items()}
    steady = {what: of["still"]["unsteady_255"] for what, of in found["clip"].items()}
    assert restless["plate"] > 1.5 * restless["delivered"] and restless["plate"] > 3 * restless["splats"]
    assert restless["plate"] > 10 * steady["plate"] and steady["delivered"] == pytest.approx(steady["plate"], rel=1e-3)
    assert all(found["clip"][what]["moving"]["pixels"] > 5000 for what in detail_flow.WHAT)
    # The tiny world is too smooth at this size, so no flow is reported.
    assert [(row["frame"], row["next"]) for row in found["frames"]] == [(109, 110), (110, 111)]
    assert found["clip"]["delivered"]["excess_px"] is None
    assert "| t* 109, plate | – | – |" in detail_flow.table("tiny", [found])[2]


def test_what_is_let_go_of_is_scored_against_painted_masks(shot, capsys, tmp_path):
    clip = open_clip(shot.root, develop=False)
    t_star, frame = clip.frames[8], clip.frames[12]
    whole = Polygon(np.array([(0, 0), (64, 0), (64, 48), (0, 48)], float), "everything", CHANGED)
    pairs = (Pair(t_star, t_star, 2, (whole,)), Pair(t_star, frame, 2, (whole,)), Pair(t_star, frame, 2, ()))
    itself, all_changed, all_same = (row.counts["delivered"] for row in score(clip, Painted("tiny", "", 64, 48, pairs)))
    assert itself.recall == 0.0, "plate t* shows t*"
    assert all_changed.recall is not None and 0.02 < all_changed.recall < 0.9, "the patch moved, the rest did not"
    assert all_same.extra == all_changed.both and all_same.right == all_changed.missed
    assert other_state_main.main([str(shot.root), "--results", str(tmp_path)]) == 1
    assert "no masks were painted" in capsys.readouterr().err


def test_the_worst_frames_are_those_that_have_an_excess():
    rows = [{"delivered": {"excess": excess}} for excess in (0.1, None, 0.5)]
    assert detail_flow.worst_frames(rows, 5) == [rows[2], rows[0]]
    assert detail_flow.excesses({"frames": rows}, "delivered") == [0.1, 0.5]


def test_a_frame_that_is_not_the_clips_is_refused_in_words(shot, tmp_path, capsys):
    for module in (detail, detail_flow):
        assert module.main([str(shot.root), "--results", str(tmp_path), "--frames", "999"]) == 1
        assert "--frames" in capsys.readouterr().err
    assert module.main([str(shot.root), "--run", "other", "--results", str(tmp_path)]) == 1
    assert "Traceback" not in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_costs_are_of_plates_of_that_size(shot, tmp_path):
    """A child process reads plates of twice the width from the footage and reports seconds and memory."""
    clip = open_clip(shot.root)
    poses = detail_cost.middle_poses(clip, 2)
    assert poses == [108, 109]
    before = (shot.root / "frames" / "frames.json").read_bytes()
    with pytest.raises(ValueError, match="not read: .*no cameras"):  # the solve has no lens
        detail_cost.enlarged(shot, tmp_path / "without", 2, poses)
    solved = Shot.open(shutil.copytree(shot.root, tmp_path / shot.root.name))
    lens = {"camera_model": "PINHOLE", "distortion": [], "focal_px": 60.0}
    write_json(solved.solve / "solve.json", {"version": 1, "key": "", **lens})
    large = detail_cost.enlarged(solved, tmp_path / "with", 2, poses)
    assert (shot.root / "frames" / "frames.json").read_bytes() == before
    plates = Plates(large)
    assert (plates.width, plates.height) == (128, 96) and not plates.note
    found = detail_cost.in_child(large, "main", 128, poses)
    assert (found["width"], found["height"]) == (128, 96) == tuple(found["plates"])
    assert [row["frame"] for row in found["frames"]] == poses and found["peak_mb"] >= found["before_mb"] > 100
    assert all(row["whole"] > row["splats"] > 0 for row in found["frames"]) and set(poses) & set(found["plates_used"])
    lines = detail_cost.table([found | {"summary": detail_cost.summary(found)}])
    assert lines[-1].startswith("| 128x96 | 2 | ")


def test_costs_are_those_of_the_later_half():
    rows = [{"whole": s, "splats": 0.1} for s in (9.0, 5.0, 1.0, 2.0, 3.0)]
    summary = detail_cost.summary({"frames": rows})
    assert (summary["first"], summary["median"], summary["least"], summary["most"]) == (9.0, 2.0, 1.0, 3.0)


def test_means_and_gains_are_reported_by_region():
    def pose(splats: float, withheld: float, delivered: float, moving: float | None) -> dict:
        values = splats, splats + 1, withheld, delivered
        regions = {
            name: {"whole": value, "moving": moving if name == "splats" or moving is None else moving - 1}
            for name, value in zip(detail_truth.VARIANTS, values, strict=True)
        }
        return {"t_star": 9, "pose": 1, **regions}

    mean = detail_truth.means([pose(20, 23, 25, 22.0), pose(22, 23, 27, None)])
    assert mean == {
        "whole": {"splats": 21, "developed": 22, "withheld": 23, "delivered": 26},
        "moving": {"splats": 22, "developed": 21, "withheld": 21, "delivered": 21},
    }
    row = "| room | whole | 21.00 -> 22.00 -> 23.00 -> 26.00 | +1.00 | +2.00 | +5.00 |"
    assert row in detail_truth.table({"room": mean})
    rows = [{detail_truth.PERCEIVED: pose(20, 23, 25, None)}, {detail_truth.PERCEIVED: pose(22, 23, 27, None)}]
    seen = detail_truth.perceived(rows)
    assert "| room | whole | 21.0000 -> 22.0000 -> 23.0000 -> 26.0000 |" in detail_truth.perceived_table({"room": seen})
    absent = [{detail_truth.PERCEIVED: {name: {"whole": None} for name in detail_truth.VARIANTS}}]
    assert detail_truth.perceived_table({"room": detail_truth.perceived(absent)}) == [], "no made-up figure"
    json.dumps(mean)


def test_recall_of_small_movers_is_reported_overall_and_for_the_worst_pose():
    def pose(found: int, should: int) -> dict:
        return {detail_truth.RECALLED: {v: {"arm": [found, should]} for v in detail_truth.VARIANTS}}

    without_object = {detail_truth.RECALLED: {v: {} for v in detail_truth.VARIANTS}}
    recalls = detail_truth.recalls([pose(90, 100), pose(30, 60), pose(0, 5), without_object])
    assert recalls == {"arm": dict.fromkeys(detail_truth.VARIANTS, (120 / 165, 0.5))}, "five pixels are no worst pose"
    row = "| room | arm | 0.727 / 0.500 -> 0.727 / 0.500 -> 0.727 / 0.500 -> 0.727 / 0.500 |"
    assert detail_truth.recall_table({"room": recalls})[-1] == row
    few = detail_truth.recalls([pose(0, 0)])
    assert detail_truth.recall_table({"room": few})[-1] == f"| room | arm | {' -> '.join(['– / –'] * 4)} |"
    assert detail_truth.recall_table({"room": detail_truth.recalls([without_object])}) == []
