"""Estimate of a training's duration: arithmetic, the clock, and the estimates of a run on the CPU."""

import pytest

from torch_backend.contract import FORECAST, Cancelled, TrainParams, duration
from torch_backend.train import PRESETS, train_shot
from torch_backend.train.forecast import (
    GAUSSIAN_PIXELS,
    STEPS,
    Alternative,
    Outlook,
    Stopwatch,
    smaller_presets,
    step_work,
    warning_of,
)


def test_the_work_of_a_run_that_grows_is_the_sum_of_its_steps():
    def count(step):
        return 1000.0 + 3.0 * step

    exact = sum(step_work(5000, count(step)) for step in range(700, 9000))
    assert Outlook(5000, 700, 9000, count).work() == pytest.approx(exact, rel=1e-3)
    assert Outlook(5000, 8998, 9000, count).work() == pytest.approx(
        sum(step_work(5000, count(s)) for s in (8998, 8999))
    )
    assert Outlook(5000, 9000, 9000, count).work() == 0.0


def test_the_first_step_does_not_count_and_what_is_between_neither():
    now = [0.0]
    watch, estimates = Stopwatch(lambda: now[0]), []
    now[0] = 100.0  # loading and compiling
    for n in range(STEPS + 3):
        now[0] += 50.0 if n == 0 else 0.2
        estimates.append(watch.step(10.0))
    assert [n for n, each in enumerate(estimates) if each is not None] == [STEPS - 1]
    assert estimates[STEPS - 1] == pytest.approx(0.02)
    watch.begin()
    now[0] += 1000.0
    assert [watch.step(10.0) for _ in range(STEPS)][-1] == 0.0


def test_smaller_presets_take_less_and_what_fits_an_hour_is_named():
    each = 1e-6
    rows = smaller_presets("final", (1280, 720), 20_000, each)
    assert [row.preset for row in rows] == ["standard", "preview"]
    standard, preview = (row.seconds for row in rows)
    assert [row.width for row in rows] == [960, 320]
    pixels, budget = 960 * 540, PRESETS["standard"]().densify.budget
    low, high = (9000 * each * (pixels + GAUSSIAN_PIXELS * n) for n in (20_000, budget))
    assert low < standard < high and preview < standard / 10
    assert smaller_presets("preview", (1280, 720), 20_000, each) == []
    sentence, hint = warning_of(9000.0, 1280, False, rows)
    assert sentence == "The training takes about 2.5 h on the processor."
    assert hint.endswith(f"The preset preview would take about {duration(preview)}.") and standard > 3600
    assert warning_of(9000.0, 1280, True, [Alternative("standard", 3000.0, 960), Alternative("preview", 9.0, 320)]) == (
        "The training takes about 2.5 h more on the processor.",
        "It can be paused at any time and continues where it stopped. The preset standard would take about 50 min.",
    )
    assert "number of Gaussians" in warning_of(9000.0, 1280, False, [])[1]
    assert warning_of(3600.0, 1280, False, rows) is None


def test_smaller_preset_with_equal_pictures_is_reported():
    rows = smaller_presets("final", (640, 480), 20_000, 4e-7)
    assert [row.width for row in rows] == [640, 320]
    hint = warning_of(9000.0, 640, False, rows)[1]
    assert hint.endswith(f"standard would take about {duration(rows[0].seconds)} on pictures of the same size.")


def test_a_long_run_says_how_long_it_takes_before_it_has_begun_in_earnest_and_when_it_goes_on(world, quiet):
    for resumed in (False, True):
        report = quiet(cancel_at=("training", (60 if resumed else 30) / 10**7))
        params = TrainParams(run="long", preset="standard", iterations=10**7, max_gaussians=300, width=32)
        with pytest.raises(Cancelled):
            train_shot(world.shot, params, report)
        (left,) = (event[2]["seconds_left"] for event in report.events if event[:2] == ("metric", FORECAST))
        ((sentence, hint),) = (event[1:] for event in report.events if event[0] == "warning")
        more = " more" if resumed else ""
        assert sentence == f"The training takes about {duration(left)}{more} on the processor." and left > 3600
        assert "The preset preview would take about" in hint


def test_a_short_run_is_silent_but_for_the_figure(world, quiet):
    report = quiet(cancel_at=("training", 60 / 240))
    with pytest.raises(Cancelled):
        train_shot(world.shot, TrainParams(run="short", iterations=240, max_gaussians=300), report)
    metrics = [event[2] for event in report.events if event[:2] == ("metric", FORECAST)]
    assert len(metrics) == 2, "again after every measurement on frames held out"
    assert all(row["of"] == "training" and 0 < row["seconds_left"] < 600 for row in metrics)
    assert not [event for event in report.events if event[0] == "warning" and "processor" in event[1]]
