"""Retry strategies after a failed first solve, with COLMAP on a rendered room that the first attempt cannot solve."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torch_backend.contract import Cancelled, ExitCode, JobError, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.sfm.retries import Attempt, next_strategy, solve_with_retries
from torch_backend.sfm.solving import SolveConfig, _key, solve_shot
from torch_backend.sfm.verdict import Fault, fault_of
from torch_backend.shot import Shot

REQUEST = {"solved": ["1.png"] * 60, "features": 4096, "camera_model": "SIMPLE_RADIAL"}
LENS = {"doubt": "", "held": False, "found_deg": 60.0, "view_deg": 60.0, "found_bend": 0.0}


def attempt(kind, registered=20, lens=LENS, error=0.8, solved=60):
    """Attempt with a fault of `kind`, or without one; `registered` 0 is a failure."""
    fault = Fault(kind, JobError(f"It is {kind}.", "Hint.", ExitCode.SOLVE)) if kind else None
    found = {"registered": registered, "reprojection_error_px": error, "lens": lens}
    answer = {"result": found} if registered else {"failure": "bare"}
    return Attempt("first", Path(), answer, fault, solved)


def strategies(best, **changes):
    """(name, changes) of all strategies that are tried while `best` stays the best."""
    done = ["first"]
    found = []
    while (strategy := next_strategy(best, {**REQUEST, **changes}, set(done))) is not None:
        done.append(strategy.name)
        found.append((strategy.name, *strategy.changes.values()))
    return found


def test_wide_matching_is_not_retried_twice():
    done = {"first", "features"}
    assert next_strategy(attempt("few"), {**REQUEST, "wide": True}, done).name == "lens"
    assert next_strategy(attempt("few"), REQUEST, done).name == "pairs"


MATCHING = [("features", 8192, 0.0025), ("pairs", True)]
OPENCV, FISHEYE = ("lens", "OPENCV"), ("lens", "OPENCV_FISHEYE")


@pytest.mark.parametrize(
    ("best", "expected"),
    [
        (attempt(""), []),
        (attempt("still", 0), []),
        (attempt("turning", 0), []),
        (attempt("turning", 5), []),
        (attempt("narrow", 60), []),
        (attempt("bare", 0), MATCHING),
        (attempt("unmatched", 0), MATCHING),
        (attempt("few"), [*MATCHING, OPENCV, ("global", "global")]),
        (attempt("poor", 40), [*MATCHING, OPENCV, ("global", "global")]),
        # All frames are registered with a large error: more matches do not help.
        (attempt("poor", 60, error=3.0), [OPENCV, ("pairs", True)]),
        (attempt("lens", 60), [OPENCV, ("pairs", True)]),
        (attempt("lens", 60, {**LENS, "doubt": "bent", "found_bend": -0.3}), [FISHEYE, ("pairs", True)]),
        (attempt("lens", 60, {**LENS, "doubt": "bent", "found_bend": 1.3}), [OPENCV, ("pairs", True)]),
        (attempt("lens", 60, {**LENS, "found_deg": 140.0}), [FISHEYE, ("pairs", True)]),
        (attempt("bent", 60, {**LENS, "doubt": "bent", "held": True, "found_bend": -0.3}), [FISHEYE]),
    ],
)
def test_only_what_can_help_is_tried(best, expected):
    assert strategies(best) == expected


def test_chosen_lens_model_is_retried_only_as_fisheye():
    assert strategies(attempt("lens", 60), camera_model="OPENCV") == [("pairs", True)]
    bent = attempt("lens", 60, {**LENS, "doubt": "bent", "found_bend": -0.3})
    assert strategies(bent, camera_model="OPENCV") == [FISHEYE, ("pairs", True)]
    assert strategies(bent, camera_model="OPENCV_FISHEYE") == [("pairs", True)]


def test_file_focal_length_is_doubted_first_unless_the_user_set_one():
    assert [name for name, *_ in strategies(attempt("few"), start_focal_px=700.0)][:2] == ["focal", "features"]
    assert strategies(attempt("few"), start_focal_px=700.0, focal_px=650.0) == strategies(attempt("few"))
    assert strategies(attempt("narrow"), start_focal_px=700.0) == []


def test_the_best_is_the_one_that_can_be_used_then_the_one_with_more_frames_then_the_one_that_fits():
    order = [
        attempt("bare", 0),
        attempt("few", 20),
        attempt("lens", 60, error=0.3),
        attempt("poor", 40, error=0.5),
        attempt("poor", 50, error=0.9),
        attempt("poor", 50, error=0.6),
        attempt("", 60),
    ]
    assert sorted(reversed(order), key=lambda one: one.rank) == order


def test_of_two_tries_that_came_to_the_same_the_first_keeps_its_files(tmp_path, monkeypatch, tools):
    def again(strategy, request, frames, last, scratch, log, report):
        folder = scratch / strategy
        folder.mkdir()
        for name in ("poses.json", "database.db"):
            (folder / name).write_text(strategy)
        return replace(attempt("poor"), strategy=strategy, folder=folder)

    monkeypatch.setattr("torch_backend.sfm.retries._attempt", again)
    solved = solve_with_retries(REQUEST, {"frames": []}, True, tmp_path, tmp_path / "log", tools.recorder())
    assert solved.best.strategy == "first" and len(solved.tries) > 2
    assert (tmp_path / "first" / "poses.json").read_text() == "first"
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"first/poses.json", *(f"{attempt_record['rung']}/database.db" for attempt_record in solved.tries)}


@pytest.fixture(scope="module")
def fog(tmp_path_factory, tools):
    """The room through fog at 6 % contrast: COLMAP's default threshold finds no features."""
    folder = tmp_path_factory.mktemp("fog")
    clip = tools.write_clip(folder, tools.handheld(8), noise=0.3, contrast=0.06)
    shot = Shot.create(folder / "fog.splannequin")
    import_footage(shot, str(clip), FootageConfig(step=1), tools.recorder())
    return shot


def test_cancelling_ends_the_tries_and_leaves_nothing_half_done(fog, tools):
    class Impatient(tools.recorder):
        def warning(self, message, hint=""):
            super().warning(message, hint)
            self.cancelled = True

    report = Impatient()
    with pytest.raises(Cancelled):
        solve_shot(fog, SolveConfig(features=1000), report)
    assert len(report.warnings) == 1 and {p.name for p in fog.solve.iterdir()} == {"colmap.log"}
    assert not list(fog.frames.glob("*.png"))


def test_a_clip_that_the_first_try_cannot_take_is_solved_with_more_features_and_that_is_said(fog, tools):
    report = tools.recorder()
    result = solve_shot(fog, SolveConfig(features=1000), report)
    assert result["registered"] == 8
    record = read_json(fog.solve_record)
    assert record["rung"] == "features" and [attempt_record["rung"] for attempt_record in record["tries"]] == [
        "first",
        "features",
    ]
    assert record["tries"][1]["found"] == record["quality"]
    assert report.warnings[0].startswith("The frames show too little to match: ")
    assert report.warnings[0].endswith("Trying again with up to 2000 features per frame, including faint ones.")
    assert record["focal_px"] == pytest.approx(300.0, rel=0.02)
    # The log has the output of both attempts, and their other files are removed.
    assert not (fog.solve / "scratch").exists() and (fog.solve / "colmap.log").stat().st_size


def test_switching_it_on_again_solves_again_and_solves_of_before_stay():
    config = SolveConfig(features=1000)
    frames = {"key": "frames"}
    assert _key(config, frames, [], {}) != _key(replace(config, retry=False), frames, [], {})
    assert _key(SolveConfig(), frames, [], {}) == "0eaee751dea72988", "what it was before there were tries"


def test_a_fisheye_that_was_taken_for_an_ordinary_lens_is_solved_as_one(tmp_path, tools):
    focal = 160.0
    rays = tools.fisheye_rays(focal, 0.02)
    poses = tools.handheld(9)
    pictures = [tools.room().cast(pose, rays) for pose in poses]
    request, frames = tools.request_for(tmp_path, pictures, features=500)
    report = tools.recorder()
    best = solve_with_retries(request, frames, True, tmp_path, tmp_path / "log.txt", report).best
    assert (best.strategy, best.fault) == ("lens", None)
    assert best.answer["result"]["camera_model"] == "OPENCV_FISHEYE"
    assert best.answer["result"]["focal_px"] == pytest.approx(focal, rel=0.02)
    assert report.warnings == [
        "The solved lens folds the picture over, so a typical lens is used. "
        "Trying again with a fisheye lens (OPENCV_FISHEYE)."
    ]
    assert {p.name for p in (tmp_path / "first").iterdir()} <= {"database.db"}
    lens = best.answer["result"]["lens"]
    assert lens["view_deg"] == pytest.approx(112.0, abs=4.0) and not lens["doubt"]
    found = read_json(best.folder / "poses.json")
    turns = [np.array(found[name]["pose"])[:, :3] for name in request["solved"]]
    for a, b, true_a, true_b in zip(turns, turns[1:], poses, poses[1:]):
        between = (b @ a.T) @ (true_b[:3, :3] @ true_a[:3, :3].T).T
        assert np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))) < 0.2


def test_what_cannot_be_solved_is_refused_after_all_tries_and_each_runs(tmp_path, tools):
    """Five frames show a room, the other six show noise."""
    pictures = [tools.room().render(pose, (300.0, 300.0, 160.0, 120.0)) for pose in tools.handheld(14)[:5]]
    rng = np.random.default_rng(3)
    pictures += [rng.integers(0, 256, (240, 320, 3), np.uint8) for _ in range(6)]
    request, frames = tools.request_for(tmp_path, pictures, features=250)
    report = tools.recorder()
    with pytest.raises(JobError) as error:
        solve_with_retries(request, frames, True, tmp_path, tmp_path / "log.txt", report)
    assert error.value.message.startswith("Cameras were found for only ")
    assert error.value.hint.endswith(
        "Tried without success: more features, more pairs, another lens model and the global mapper."
    )
    assert [w.split("Trying again with ")[1].split()[-1] for w in report.warnings] == [
        "ones.",
        "other.",
        "(OPENCV).",
        "mapper).",
    ]


def test_the_global_mapper_and_wider_pairs_find_the_room_as_well(tmp_path, tools):
    pictures = [tools.room().render(pose, (300.0, 300.0, 160.0, 120.0)) for pose in tools.handheld(8)]
    request, frames = tools.request_for(tmp_path, pictures, mapper="global", wide=True, features=400)
    answer = solve_with_retries(request, frames, False, tmp_path, tmp_path / "log.txt", tools.recorder()).best.answer
    assert fault_of(answer, frames) is None and answer["result"]["registered"] == 8
    assert answer["result"]["focal_px"] == pytest.approx(300.0, rel=0.02)
