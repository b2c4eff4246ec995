"""Tasks, their amounts of work, measured rates, and the resulting cost of a job."""

import dataclasses
import math

import pytest

from torch_backend.contract import JobError, write_json
from torch_backend.contract.pace import FIRST_FRAMES, PER_SOLVED, PER_STEP, PER_WORKING
from torch_backend.farm import rates
from torch_backend.farm.cost import estimate, needs, sentences
from torch_backend.farm.rates import Rate, measure, read_rates, to_json
from torch_backend.farm.shots import gather
from torch_backend.farm.work import MOST_VALUES, steps_of
from torch_backend.freeze.instant.develop import DevelopConfig

ONE = {kind: Rate(1.0, 0.0, 2.0, 1000) for kind in rates.MEASURED}
"""Rates at which every task takes a second on two cores."""


PARTS = ((1, 10), (11, 10), (21, 3))
"""(first frame, length) of the parts of 23 frames, ten frames each."""


def shots_of(shot, requests, count=1, instants=(4, 12), **words):
    roots = [str(shot(f"shot{n}", **words).root) for n in range(count)]
    return gather(roots, requests(), list(instants), {}, "")


def test_a_take_is_cut_into_parts_that_are_all_of_it(shot, requests):
    (one,) = shots_of(shot, requests, last=23)
    steps = {step.kind: step for step in steps_of(one, 10, True)}
    assert list(steps) == ["solve", "train", "open", "freeze", "finish", "bake", "deliver"]
    assert steps["freeze"].starts == [1, 11, 21] and len(list(steps["freeze"].tasks())) == 6
    frame, working = 1920 * 1080 / 1e6, 640 * 360 / 1e6
    assert steps["finish"].amounts[0] == pytest.approx(23 * frame)
    assert steps["bake"].amounts == pytest.approx({n: size * frame for n, size in PARTS})
    assert steps["freeze"].amounts == pytest.approx(
        {n: size * frame + (size + FIRST_FRAMES) * PER_WORKING * working for n, size in PARTS}
    )
    assert [step.kind for step in steps_of(one, 10, False)][-1] == "finish"


def test_a_part_is_longer_where_a_take_would_have_more_than_a_template_may(shot, requests):
    (one,) = shots_of(shot, requests, last=5000)
    steps = {step.kind: step for step in steps_of(one, 1, False)}
    assert steps["freeze"].part == 5 and len(steps["freeze"].starts) == 1000 <= MOST_VALUES


def test_a_training_costs_its_steps_and_pixels_and_an_instant_too(shot, requests):
    (one,) = shots_of(shot, requests)
    amounts = {step.kind: step.amounts[0] for step in steps_of(one, 10, False) if 0 in step.amounts}
    assert amounts["train"] == pytest.approx(2000 * (320 * 180 / 1e6 + PER_STEP))
    assert amounts["open"] == pytest.approx(DevelopConfig().steps * 640 * 360 / 1e6)
    assert amounts["solve"] == pytest.approx(20 * (640 * 360 / 1e6 + PER_SOLVED))
    one.requests["train"].update(iterations=100, width=64)
    one.requests["freeze"]["develop"] = "off"
    amounts = {step.kind: step.amounts[0] for step in steps_of(one, 10, False) if 0 in step.amounts}
    assert amounts["train"] == pytest.approx(100 * (64 * 36 / 1e6 + PER_STEP)) and amounts["open"] == 0.0


def test_what_a_job_costs(shot, requests):
    found = shots_of(shot, requests, count=3)
    steps = [step for one in found for step in steps_of(one, 5, False)]
    cost = estimate(steps, ONE, True, False)
    # per shot: solve, train, 2 opened, 2 x 4 parts, 2 finished
    assert (cost.shots, cost.tasks) == (3, 3 * 14)
    task_core_seconds, engine = sum(row.core_seconds for row in cost.rows[:-1]), cost.rows[-1]
    assert task_core_seconds == pytest.approx(3 * 14 * 2.0) and cost.core_hours == pytest.approx(
        (task_core_seconds + engine.core_seconds) / 3600
    )
    overhead_seconds = 3 * 5 * rates.SESSION_SECONDS + 3 * 14 * rates.TASK_SECONDS
    assert (engine.kind, engine.tasks) == ("engine", 3 * 5) and engine.seconds == pytest.approx(overhead_seconds)
    assert engine.core_seconds == pytest.approx(overhead_seconds + 3 * 14 * rates.WATCH_CORES), (
        "it watches every second of tasks"
    )
    assert cost.card_hours == pytest.approx(3 * (1 + 2 + 8) / 3600), "train, open and freeze"
    assert cost.critical_seconds == pytest.approx(5 * (1.0 + rates.SESSION_SECONDS + rates.TASK_SECONDS))
    assert cost.on_hosts[1] == pytest.approx(3 * 14 + overhead_seconds)
    assert cost.on_hosts[100] == pytest.approx(cost.critical_seconds)
    assert cost.on_hosts[1] / 2 <= cost.on_hosts[2] < cost.on_hosts[1] * 0.7
    assert cost.disk_gb == pytest.approx(3 * (2 * 20 * 1920 * 1080 * 50 + 100e6) / 1e9, rel=0.01)
    said = "\n".join(sentences(cost, "of nobody"))
    assert "3 shots, 42 tasks. Estimated from rates of nobody" in said and "freeze       24 tasks" in said
    assert "engine       15 sessions" in said
    assert estimate(steps, ONE, False, False).card_hours == 0.0


def test_session_restarts_after_a_number_of_tasks(shot, requests):
    (one,) = shots_of(shot, requests)
    steps = steps_of(one, 5, False)
    keeps, enters = estimate(steps, ONE, False, False), estimate(steps, ONE, False, False, 1)
    assert [cost.rows[-1].tasks for cost in (keeps, enters)] == [5, 14]
    assert estimate(steps, ONE, False, False, 3).rows[-1].tasks == 1 + 1 + 1 + 3 + 1
    more = 9 * rates.SESSION_SECONDS
    assert enters.on_hosts[1] - keeps.on_hosts[1] == pytest.approx(more)
    assert 3600 * (enters.core_hours - keeps.core_hours) == pytest.approx(more)
    assert enters.critical_seconds == pytest.approx(keeps.critical_seconds), "the first task of each step enters, too"


def test_requested_memory_is_measured_memory_plus_half():
    needed = needs({"train": Rate(1, 1, 1, 2000), "bake": Rate(1, 1, 1, 700)}, True, 2.0)
    assert (needed["train"].memory_mib, needed["train"].gpu) == (3072, True)
    assert (needed["bake"].memory_mib, needed["bake"].gpu) == (1536, False)


def record(step, amount, seconds, cpu=None, memory=800):
    return {"step": step, "amount": amount, "seconds": seconds, "cpu_seconds": cpu or seconds, "memory_mib": memory}


def test_rates_are_measured_from_what_tasks_took():
    records = [record("freeze", a, 4.0 + 2.0 * a, cpu=2 * (4.0 + 2.0 * a), memory=900 + a) for a in (1, 2, 5)]
    records += [record("train", 100, 65.0), record("open", 0, 9.0), record("open", 0, 11.0), record("nap", 1, 1)]
    records += [{"step": "freeze"}, record("finish", 10, 0.5)]
    found = measure(records)
    assert found["freeze"].fixed == pytest.approx(4.0) and found["freeze"].per_unit == pytest.approx(2.0)
    assert (found["freeze"].cores, found["freeze"].memory_mib) == (2.0, 905)
    usual = rates.MEASURED["train"]
    assert found["train"].seconds(100) == pytest.approx(65.0, abs=0.01)
    share = found["train"].fixed / found["train"].per_unit
    assert share == pytest.approx(usual.fixed / usual.per_unit, rel=0.01), "one amount: all is slower by as much"
    assert found["open"].seconds(0) == pytest.approx(10.0)
    assert found["finish"].seconds(10) == pytest.approx(0.5, abs=0.01)
    assert set(found) == {"freeze", "train", "open", "finish"}


def test_more_work_never_takes_less_time():
    fell = measure([record("freeze", a, 10.0 - a) for a in (1, 2, 3)])["freeze"]
    assert (fell.fixed, fell.per_unit) == (8.0, 0.0)
    steep = measure([record("freeze", a, 5.0 * a - 4.0) for a in (1, 2, 3)])["freeze"]
    assert steep.fixed == 0.0 and steep.per_unit == pytest.approx(3.0)


def test_rates_file_overrides_built_in_rates(tmp_path):
    file = tmp_path / "rates.json"
    write_json(file, to_json({"train": Rate(1.0, 2.0, 3.0, 4)}))
    read = read_rates(file)
    assert read["train"] == Rate(1.0, 2.0, 3.0, 4) and read["freeze"] == rates.MEASURED["freeze"]
    for wrong in ({"version": 2}, {"version": 1, "rates": {"nap": dataclasses.asdict(Rate(1, 1, 1, 1))}}, {}):
        write_json(file, wrong)
        with pytest.raises(JobError, match="is not a file of rates"):
            read_rates(file)
    assert all(math.isfinite(rate.seconds(1.0)) for rate in rates.MEASURED.values())
