"""Verdict of a run in sentences: sentences from figures, figures compared with known motion, and small whole runs."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from tests.backend.conftest import build_world
from torch_backend.contract import TrainParams, read_json, verdict_lines
from torch_backend.footage.images import read_png, write_png
from torch_backend.train import train_shot
from torch_backend.train.evidence import GRID, travelled, unexplained
from torch_backend.train.verdict import RunFigures, judge, region_text, span_text, spans_of

FRAMES = list(range(1, 75, 3))


def figures(**changes) -> RunFigures:
    """Figures of the preview run of `sitting`, with changes."""
    none = np.zeros((len(FRAMES), GRID, GRID), np.float32)
    still = RunFigures(640, FRAMES, none + 0.02, none + 0.01, 0.021, 0.0, 0.0256, 24.4, 22.8, True)
    return dataclasses.replace(still, **changes)


def lost_at(first: int, last: int, row: int, column: int, share: float = 0.8) -> np.ndarray:
    cells = np.full((len(FRAMES), GRID, GRID), 0.02)
    inside = [n for n, frame in enumerate(FRAMES) if first <= frame <= last]
    cells[inside, row, column] = share
    return cells


def test_still_people_are_good_with_sway_in_pixels():
    verdict = judge(figures())
    assert verdict.lines() == ["Good. It matches the whole clip.", "Moving parts sway by up to 13 of 640 pixels."]
    assert verdict.where == []
    assert judge(figures(width=1920)).sentences[-1] == "Moving parts sway by up to 40 of 1920 pixels."


def test_static_world_is_reported():
    verdict = judge(figures(sway=0.0039, farthest=0.0045))
    assert verdict.word == "good" and "Nothing moves in it." in verdict.sentences
    assert verdict.advice == ["Any frame works as t*."]


def test_a_run_that_learnt_no_motion_is_not_taken_for_a_still_world():
    still = {"sway": 0.0, "farthest": 0.0}
    verdict = judge(figures(**still, matte_moving=0.087))
    assert verdict.word == "fair" and "9 % of the frames as moving" in verdict.sentences[-1]
    assert "more steps" in verdict.advice[0] and "Any frame" not in verdict.advice[0]
    assert judge(figures(**still, matte_moving=0.009)).word == "good"
    assert judge(figures(matte_moving=0.087)).word == "good", "what moves was learnt"


def test_walker_is_reported_with_frames_place_and_advice():
    travel = lost_at(10, 40, 1, 1, 0.22)
    verdict = judge(figures(unexplained=lost_at(10, 31, 3, 0), travel=travel, far=0.02, farthest=0.22))
    assert verdict.word == "fair"
    assert verdict.where == [
        {"first": 10, "last": 31, "region": "lower left"}, {"first": 10, "last": 40, "region": "middle"}
    ]  # fmt: skip
    assert verdict.sentences == [
        "It does not match the clip in frames 10 to 31, lower left.",
        "Something does not hold still: it travels up to 141 of 640 pixels in frames 10 to 40, middle.",
    ]
    assert verdict.advice == ["Choose t* in frames 43 to 73, or train only on that range."]
    assert verdict.instants == [43, 73] and judge(figures()).instants == []
    followed = judge(figures(travel=travel, far=0.02, farthest=0.22))
    assert followed.instants == [] and not any("t*" in line for line in followed.advice), "shown, it stands at any t*"


def test_tracked_walker_is_reported():
    verdict = judge(figures(travel=lost_at(1, 74, 2, 2, 0.22), far=0.02, farthest=0.22))
    assert verdict.word == "fair" and "141 of 640" in verdict.sentences[-1] and "motion matte" in verdict.advice[0]
    spot = judge(figures(travel=lost_at(1, 74, 2, 2, 0.22), far=0.0005, farthest=0.034))
    assert spot.word == "good", "a few far pixels, as in `hall`, are nobody who walks"


def test_inconsistent_or_unlike_run_is_poor():
    verdict = judge(figures(unexplained=lost_at(1, 74, 1, 1)))
    assert verdict.word == "poor" and "frames 1 to 73, middle" in verdict.sentences[0]
    assert "If somebody walks through" in verdict.advice[0]
    by_mattes = [
        judge(figures(unexplained=lost_at(1, 74, 1, 1), still_unexplained=share)).advice for share in (0.01, 0.2)
    ]
    assert "Somebody walks through: choose" in by_mattes[0][0] and "solve the camera again" in by_mattes[1][0]
    dim = judge(figures(median_db=18.9, tenth_db=17.6, held_out=False))
    said = "It does not match the clip: 18.9 dB on half of its training frames, 17.6 dB on the worst tenth."
    assert dim.word == "poor" and dim.sentences[0] == said
    assert judge(figures(median_db=float("nan"))).word == "poor"


def test_regions_and_frames_in_words():
    cells = np.zeros((GRID, GRID))
    for (row, column), expected in {
        (0, 0): "upper left", (0, 2): "top", (0, 3): "upper right", (1, 1): "middle", (2, 0): "left",
        (3, 1): "bottom", (3, 3): "lower right",
    }.items():  # fmt: skip
        one = cells.copy()
        one[row, column] = 1.0
        assert region_text(one) == expected
    assert region_text(cells + 1.0) == region_text(cells) == "most of the picture"
    shares = lost_at(4, 7, 0, 0) + lost_at(40, 61, 3, 3) - 0.02
    shares[FRAMES.index(49)] = 0.0  # one good frame does not split a span
    spans = spans_of(FRAMES, shares, shares > 0.3)
    assert [span_text(span) for span in spans] == ["frames 40 to 61, lower right", "frames 4 to 7, upper left"]
    assert span_text({"first": 4, "last": 4, "region": "top"}) == "frame 4, top"
    assert spans_of(FRAMES, shares, shares > 2.0) == []


def test_travel_is_measured_in_the_view_and_only_where_somebody_saw_it():
    """A point moves by 0.5 units at depth 2 with a focal length of 100 px: 25 px, computed by hand."""
    places = torch.tensor([[0.0, 0.0, 2.0], [0.25, 0.0, 2.0], [0.5, 0.0, 2.0]])[:, None].repeat(1, 5, 1)
    places[2, 1] = torch.nan  # seen at the first two times only
    places[1:, 2] = torch.nan  # seen once
    places[1, 3, 2] = -1.0  # behind the camera once
    places[:, 4] = torch.nan  # never seen
    K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])
    assert travelled(places, torch.eye(4), K).tolist() == pytest.approx([25.0, 12.5, 0.0, 0.0, 0.0], abs=1e-4)


def test_edges_and_grain_are_explained_and_a_figure_that_is_missing_is_not():
    g = torch.Generator().manual_seed(1)
    plate = torch.rand(90, 160, 3, generator=g) * 0.2 + 0.4
    moved = torch.roll(plate, 1, 1) + 0.05 * torch.randn(90, 160, 3, generator=g)
    assert not unexplained(plate, moved).any()
    missing = plate.clone()
    missing[30:70, 60:90] += 0.4
    found = unexplained(plate, missing)
    assert found[35:65, 65:85].all() and not found[:20].any()


def walk_through(shot):
    """Paint a person who crosses the picture into the frames, with other clothes in every frame."""
    random = np.random.default_rng(3)
    files = sorted(shot.frames.glob("*.png"))
    for n, path in enumerate(files):
        pixels = read_png(path)
        left = round(n / len(files) * pixels.shape[1] * 0.8)
        person = pixels[8:, left : left + 14]
        person[:] = random.integers(0, 256, (1, 1, 3)) * np.linspace(0.4, 1.0, len(person))[:, None, None]
        write_png(path, pixels)


def test_run_reports_travel_distance(trained):
    """The small world's patch sways by 0.4 units at depth 3.2, which is more than people who hold still."""
    summary = trained.summary
    places = [trained.at(time)["means"][trained.moving][0] for time in (0.25, 0.75)]
    true = float((places[0] - places[1])[0]) * 60.0 / 3.2
    assert summary["travel_px"] == pytest.approx(true, rel=0.35)
    assert (summary["quality"], summary["quality_on"]) == ("Fair", "held-out frames")
    kept = read_json(trained.shot.run("main") / "summary.json")
    assert kept["verdict"] == summary["verdict"] and summary["unexplained_share"] < 0.01
    match = re.search(r"(\d+) of 64 pixels", verdict_lines(kept)[1])
    assert match and float(match[1]) == pytest.approx(summary["farthest_px"], abs=0.56), "rounded once, and once more"


def test_person_walking_through_is_reported(tmp_path, quiet):
    world = build_world(tmp_path)
    params = TrainParams(iterations=120, max_gaussians=800, holdout=0)
    walk_through(world.shot)
    report = quiet()
    summary = train_shot(world.shot, params, report)
    assert summary["quality"] == "Poor"
    assert summary["worst_tenth_psnr_db"] <= summary["median_psnr_db"]
    assert summary["quality_on"] == "training frames"
    (warning,) = [e for e in report.events if e[0] == "warning" and e[1].startswith("Poor.")]
    number = re.search(r"([\d.]+) dB on half of its training frames", warning[1])
    assert number and float(number[1]) == pytest.approx(summary["median_psnr_db"], abs=0.056)
    assert "walks through" in warning[2] and "solve" in warning[2]
    assert "It does not match the clip in frame" in warning[2], "frames and place are told"
