"""Expected durations of jobs: their work, paces learnt from earlier jobs, and one progress bar for several jobs."""

import json

import pytest

from torch_backend.contract import (
    FreezeParams,
    ShotFolder,
    ShotSize,
    SolveParams,
    TotalProgress,
    TrainParams,
    duration,
    expected_seconds,
    learn_pace,
    paces,
    write_json,
)
from torch_backend.contract.installed import SETUP_NOTES
from torch_backend.contract.pace import PACES_FILE

SIZE = ShotSize(74, (640, 480), (1280, 960))


@pytest.fixture
def environment(tmp_path):
    (tmp_path / SETUP_NOTES).mkdir()
    return tmp_path


def test_the_size_of_a_shot_is_read_from_its_listing(tmp_path):
    shot = ShotFolder(tmp_path / "one.splannequin")
    rows = [{"frame": n} for n in range(3)]
    write_json(shot.listing, {"width": 64, "height": 48, "source_size": [128, 96], "frames": rows})
    assert ShotSize.of(shot) == ShotSize(3, (64, 48), (128, 96))
    write_json(shot.listing, {"width": 64, "height": 48, "frames": rows})
    assert ShotSize.of(shot).source == (64, 48)
    write_json(shot.listing, {"width": 64})
    with pytest.raises(ValueError):
        ShotSize.of(shot)


def test_more_work_is_expected_to_take_longer():
    def seconds(kind, params, size=SIZE):
        return expected_seconds(kind, params, size)

    longer = ShotSize(148, SIZE.working, SIZE.source)
    for kind, params in (("solve", SolveParams()), ("freeze", FreezeParams())):
        once, twice = seconds(kind, params), seconds(kind, params, longer)
        assert once < twice < 2.0 * once  # a part of the time does not depend on the number of frames
    assert seconds("train", TrainParams(iterations=1000)) < seconds("train", TrainParams())
    assert seconds("train", TrainParams()) < seconds("train", TrainParams(preset="standard"))
    assert seconds("train", TrainParams()) == seconds("train", TrainParams(), longer)
    half = FreezeParams(first=1, last=74, step=2)
    assert seconds("freeze", FreezeParams(first=1, last=37)) == pytest.approx(seconds("freeze", half))
    assert seconds("freeze", FreezeParams(width=640)) < seconds("freeze", FreezeParams())
    assert seconds("surface", None) is None


def test_a_machine_is_known_by_the_median_of_its_last_jobs(environment):
    assert paces(environment) == {}
    for seconds in (500.0, 20.0, 20.0, 40.0):
        learn_pace(environment, "solve", seconds, 10.0)
    assert paces(environment) == {"solve": 3.0}
    for _ in range(8):
        learn_pace(environment, "solve", 5.0, 10.0)
    learn_pace(environment, "train", 12.0, 10.0)
    assert paces(environment) == {"solve": 0.5, "train": 1.2}


def test_a_short_job_and_an_environment_that_is_not_ours_teach_nothing(environment, tmp_path):
    learn_pace(environment, "solve", 8.0, 1.0)
    assert not (environment / SETUP_NOTES / PACES_FILE).exists()
    bare = tmp_path / "bare"
    bare.mkdir()
    learn_pace(bare, "solve", 20.0, 10.0)
    assert list(bare.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{", '{"version": 2, "paces": {"solve": [2.0]}}', '{"version": 1, "paces": [1]}',
        '{"version": 1, "paces": {"solve": "fast", "train": [null, "x", 1e9, -1.0, true], "dance": [1.0]}}',
    ],
)  # fmt: skip
def test_a_damaged_file_teaches_nothing_and_is_replaced(environment, text):
    path = environment / SETUP_NOTES / PACES_FILE
    path.write_text(text)
    assert set(paces(environment)) <= {"train"} and paces(environment).get("train", 1.0) == 1.0
    learn_pace(environment, "solve", 20.0, 10.0)
    assert json.loads(path.read_text())["paces"]["solve"] == [2.0]


def run(way, jobs, step=1.0):
    """Run jobs (kind, duration in seconds, whether it estimates itself) through a way; yield (clock, share, left)."""
    clock = 0.0
    for kind, takes, estimates in jobs:
        spent = 0.0
        while spent < takes:
            yield clock + spent, *way.at(kind, spent, takes - spent if estimates else None)
            spent += step
        way.at(kind, takes, 0.0)
        clock += takes


def test_jobs_as_expected_make_an_even_bar_with_a_true_estimate():
    way = TotalProgress({"solve": 50.0, "train": 60.0, "freeze": 40.0}, spent=10.0)
    jobs = [("solve", 50.0, True), ("train", 60.0, False), ("freeze", 40.0, True)]
    for clock, share, left in run(way, jobs):
        assert left == pytest.approx(150.0 - clock, abs=8.0)  # a job without an estimate does not announce its end
        assert share == pytest.approx((10.0 + clock) / 160.0, abs=0.04)


def test_on_a_machine_that_is_twice_as_slow_the_estimate_comes_right_with_the_first_job():
    way = TotalProgress({"solve": 50.0, "train": 60.0, "freeze": 40.0})
    shares = []
    for clock, share, left in run(way, [("solve", 100.0, True), ("train", 120.0, False), ("freeze", 80.0, True)]):
        shares.append(share)
        assert left == pytest.approx(300.0 - clock, abs=16.0)
    assert shares == sorted(shares) and shares[-1] > 0.95


def test_work_that_was_done_before_does_not_make_what_follows_look_short():
    way = TotalProgress({"solve": 50.0, "train": 60.0, "freeze": 40.0})
    assert way.at("solve", 0.1, None)[1] == pytest.approx(49.9 + 100.0)
    assert way.at("train", 0.0, None)[1] == pytest.approx(100.0)
    assert way.at("train", 2.0, 3.0)[1] == pytest.approx(43.0)  # it continues near its end
    share, left = way.at("freeze", 0.0, None)
    assert left == pytest.approx(40.0) and 0.0 < share < 0.2


def test_a_job_that_outlasts_its_estimate_is_never_said_to_be_over():
    way = TotalProgress({"freeze": 40.0})
    last = 0.0
    for spent in range(0, 200, 10):
        share, left = way.at("freeze", float(spent), None)
        assert left > 0.0 and last <= share < 1.0
        last = share


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "1 s"), (89, "89 s"), (100, "2 min"), (5300, "88 min"), (5500, "1.5 h"), (36000, "10 h")],
)
def test_a_duration_in_words(seconds, words):
    assert duration(seconds) == words
