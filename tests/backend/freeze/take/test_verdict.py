"""Verdict of a take in sentences: plate coverage, weak areas, and advice, derived from figures."""

import json

import numpy as np
import pytest

from torch_backend.contract import Verdict, summarise, verdict_lines
from torch_backend.freeze.take.verdict import judge_take, unsure

FRAMES = list(range(1, 41))


def facts(lost=(), share=0.9, row=3, column=0, around=0.02, **more) -> dict:
    """take.json of a take whose cell (row, column) is guessed in the frames `lost`."""
    rows = []
    for frame in FRAMES:
        cells = np.full((4, 4), around)
        if frame in lost:
            cells[row, column] = share
        rows.append({"frame": frame, "plate_share": 1 - float(cells.mean()), "invented_share": float(cells.mean()),
                     "regions": cells.tolist()})  # fmt: skip
    invented = float(np.mean([r["invented_share"] for r in rows]))
    detail = {"plate_share": 1 - invented, "invented_share": invented, "per_frame": rows}
    return {"t_star_frame": 8, "t_star_per_frame": {}, "camera_path": "", "detail": detail, **more}


def test_a_take_of_plates_is_good():
    verdict = judge_take(facts())
    assert verdict is not None
    assert verdict.lines() == ["Good. 98 % of the picture is plate, 2 % is a guess."]
    assert judge_take(facts(around=0.0)).lines() == ["Good. 100 % of the picture is plate, 0 % is a guess."]
    assert judge_take(facts(around=0.001)).lines() == ["Good. 99 % of the picture is plate, 1 % is a guess."]


def test_the_worst_frame_is_named_where_no_place_is():
    all_facts = facts()
    all_facts["detail"]["per_frame"][36]["plate_share"] = 0.86
    verdict = judge_take(all_facts)
    assert verdict is not None and verdict.word == "good"
    assert verdict.lines()[1:] == ["Most of it in frame 37: 14 %."]
    all_facts["detail"]["per_frame"][36]["plate_share"] = 0.91
    assert judge_take(all_facts).lines()[1:] == []


def test_guessed_area_is_reported_with_frames_place_and_advice():
    verdict = judge_take(facts(lost=range(31, 41)))
    assert verdict is not None and verdict.word == "fair"
    assert verdict.lines()[1:] == [
        "Mostly a guess in frames 31 to 40, lower left.",
        "Try a t* nearer to frame 35.",
        "Or deliver only frames 1 to 30.",
    ]
    assert unsure(verdict, FRAMES) == set(range(31, 41))
    run = Verdict("fair", ["It does not match the clip in frame 40."], instants=[5, 28])
    advised = judge_take(facts(lost=range(31, 41)), run)
    assert advised is not None and "Try a t* nearer to frame 28." in advised.advice, "within what the run recommends"
    keyed = judge_take(facts(lost=range(31, 41), t_star_per_frame={"1": 8.0}))
    assert keyed is not None and keyed.advice == ["Or deliver only frames 1 to 30."]
    of_artists_camera = judge_take(facts(lost=range(31, 41), camera_path="a.json"))
    assert of_artists_camera is not None and of_artists_camera.advice == [
        "Keep the camera closer to the clip's own path there."
    ]


def test_a_place_that_is_a_guess_all_along_may_be_one_that_does_not_move():
    verdict = judge_take(facts(lost=range(5, 41), row=1, column=1))
    assert verdict is not None and verdict.advice == ["If nothing moves there, paint it black in the motion matte."]
    assert "frames 5 to 40, middle" in verdict.sentences[1]


def test_a_take_that_is_mostly_guessed_is_poor():
    verdict = judge_take(facts(around=0.4))
    assert verdict is not None and verdict.word == "poor" and verdict.advice


def test_take_of_splats_only_is_reported_and_older_takes_are_not():
    splats_only = judge_take({**facts(), "detail": None})
    assert splats_only is not None and "Detail is off" in splats_only.sentences[0]
    assert judge_take({"t_star_frame": 8}) is None


def test_a_take_is_no_better_than_its_run():
    walker = "Something does not hold still: it travels up to 141 of 640 pixels in frames 10 to 20, middle."
    place = {"first": 10, "last": 20, "region": "middle"}
    run = Verdict("fair", ["It matches the whole clip.", walker], [place], ["Paint walking people."])
    verdict = judge_take(facts(), run)
    assert verdict is not None
    assert verdict.lines() == ["Fair. 98 % of the picture is plate, 2 % is a guess.", walker, "Paint walking people."]
    assert unsure(verdict, FRAMES) == set(range(10, 21))
    poor = judge_take(facts(), Verdict("poor", ["It does not match the clip."], [], ["Check its previews."]))
    assert poor is not None and poor.word == "poor"
    good = Verdict("good", ["It matches the whole clip.", "Moving parts sway by up to 7 of 640 pixels."])
    assert judge_take(facts(), good) == judge_take(facts())
    summary = verdict_lines({"verdict": vars(run)}, {"verdict": vars(verdict)})
    assert summary.count(walker) == 1, "the summary of both says it once"


def results() -> dict:
    solve = {"frames": 40, "solved_frames": 40, "registered": 40, "reprojection_error_px": 0.5}
    train = {"gaussians": 1, "moving_share": 0.1, "train_seconds": 1.0, "iterations": 10, "heldout_psnr_db": None,
             "width_px": 320, "run": "main", "verdict": vars(Verdict("fair", ["A."], [], ["B."]))}  # fmt: skip
    take = {k: k for k in ("t_star_frame", "exr_dir", "contact_sheet", "video", "ply", "take")}
    return {"solve": solve, "train": train, "freeze": take}


def test_the_summary_of_a_whole_run_has_verdict_and_shares():
    results_of_run = results()
    results_of_run["freeze"] |= facts() | {"verdict": vars(judge_take(facts()))}
    summary = json.loads(json.dumps(summarise("s", "c", results_of_run, {}, 1.0)))
    assert summary["verdict"] == ["Fair. A.", "B.", "Good. 98 % of the picture is plate, 2 % is a guess."]
    assert summary["plate_share"] == pytest.approx(0.98) and summary["invented_share"] == pytest.approx(0.02)
    old = summarise("s", "c", results(), {}, 1.0)
    assert (old["verdict"], old["plate_share"], old["invented_share"]) == (["Fair. A.", "B."], None, None)


def test_a_verdict_from_a_strange_file_is_cut_and_has_no_control_characters():
    sentences = [f"a\x1b[2J{n}" + "b" * 999 for n in range(50)]
    (first, *rest) = verdict_lines({"verdict": {"word": "poor", "sentences": sentences}})
    assert len(rest) == 11 and "\x1b" not in first and len(first) < 320
