"""Estimates shown with the presets before they run."""

import pytest


def run(**figures):
    return {"run": "main", "preset": "preview", "width_px": 320, "iterations": 3000, "train_seconds": 150.0} | figures


@pytest.fixture
def costs(addon, tmp_path):
    """costs(runs, width): ({preset: cost} for a shot of that width, the run that the estimate is based on)."""

    def call(runs, width=1280):
        state = addon("shot.shot_state").ShotState(tmp_path, {"width": width, "height": 720}, runs=runs)
        rows, basis = addon("train.estimates").costs(state)
        return {row.preset: row for row in rows}, basis

    return call


def test_without_a_timed_run_nothing_is_promised(costs, addon, contract):
    for runs in ({}, {"a": run(train_seconds=None)}, {"a": run(train_seconds="x")}, {"a": run(iterations=0)}):
        rows, basis = costs(runs)
        assert basis is None and all(row.seconds is None and not row.measured for row in rows.values())
    assert {n: (r.steps, r.width) for n, r in rows.items()} == {
        n: (contract.PRESET_STEPS[n], contract.PRESET_WIDTHS[n] or 1280) for n in ("preview", "standard", "final")
    }
    rows, basis = addon("train.estimates").costs(None)
    assert basis is None and rows[-1].width == 0, "nothing is known of the clip"


def test_estimates_scale_a_timed_run_by_pixels_and_steps(costs):
    rows, basis = costs({"main": run(iterations=1000, train_seconds=100.0)})
    assert basis["run"] == "main"
    assert (rows["preview"].seconds, rows["preview"].measured) == (200.0, True)
    assert (rows["standard"].seconds, rows["standard"].measured) == (pytest.approx(200.0 * 4.5 * 9), False)
    assert rows["final"].seconds == 200.0 * 15 * 16


def test_a_static_run_does_not_tell_how_long_one_with_motion_takes(costs):
    runs = {"main": run(iterations=1000, train_seconds=100.0, method="auto")}
    runs["still"] = run(run="still", iterations=2000, train_seconds=40.0, method="static")
    rows, basis = costs(runs)
    assert basis["run"] == "main" and rows["preview"].seconds == 200.0
    rows, basis = costs({"still": runs["still"]})
    assert basis["run"] == "still" and rows["preview"].seconds == 40.0, "better than nothing"


def test_a_final_run_of_a_card_tells_of_the_sources_pixels(costs):
    runs = {"main": run(preset="final", width_px=1920, iterations=30_000, train_seconds=600.0, device="cuda")}
    rows, basis = costs(runs)
    assert (rows["final"].width, rows["final"].seconds, rows["final"].measured) == (1920, 600.0, True)
    assert rows["preview"].width == 320 and not rows["preview"].measured and basis["device"] == "cuda"
    runs["main"] |= dict(device="cpu")
    assert costs(runs)[0]["final"].width == 1280


def test_a_small_clip_is_not_enlarged(costs):
    rows, _ = costs({"main": run(width_px=320)}, width=640)
    assert (rows["standard"].width, rows["final"].width) == (640, 640)


def test_without_a_run_the_machines_earlier_trainings_tell(addon, contract, tmp_path):
    estimates, state = addon("train.estimates"), addon("shot.shot_state").ShotState(tmp_path)
    state.info, state.frames = {"width": 1280, "height": 720}, 50
    rows, basis = estimates.costs(state, pace=2.0)
    expected = contract.expected_seconds(
        "train", contract.TrainParams(preset="standard"), contract.ShotSize(50, (1280, 720), (1280, 720))
    )
    assert basis is None and [row.preset for row in rows] == list(contract.PRESET_STEPS)
    assert rows[1].seconds == pytest.approx(2.0 * expected) and not rows[1].measured
    assert [row.seconds for row in estimates.costs(state)[0]] == [None] * 3
    assert [row.seconds for row in estimates.costs(None, pace=2.0)[0]] == [None] * 3
