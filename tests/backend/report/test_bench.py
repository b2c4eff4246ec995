"""The benchmark on the tiny world: child processes train, freeze, score and are killed; the report reads their
results."""

import dataclasses
import json
import signal
import subprocess
import sys
import time

import pytest
import torch

from benchmarks.bench import ABLATIONS, HOLDOUT, RunSpec, cores, override, plan, run_plan
from benchmarks.report.evaluate import last_third_step_ms
from benchmarks.report.records import DELIVERED, DEVELOPED, WITHHELD, finished, load_record
from benchmarks.report.truth import RealScene, TruthFolder
from benchmarks.report.write import write_report
from benchmarks.sources import ROOT, last_words
from torch_backend.contract import METHODS, read_json
from torch_backend.deformation import host_config, hosts
from torch_backend.scene import load_scene, split_frames
from torch_backend.train.config import config_from_json

SIZE = {"iterations": 60, "max_gaussians": 900}


def only(runs, *settings):
    return [r for r in runs if (r.host, r.supervision) in settings and r.variant == "default"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory, write_truth):
    folder = tmp_path_factory.mktemp("truth") / "tiny"
    return folder, write_truth(folder)


@pytest.fixture(scope="module")
def done(tmp_path_factory, scene):
    """Results of static and auto from child processes, and of auto's run with another query. A fourth run fails."""
    results = tmp_path_factory.mktemp("results")
    runs, said = plan([f"truth:{scene[0]}"], results, **SIZE)
    runs = only(runs, ("auto", "support"), ("static", "none"))
    bad = dataclasses.replace(only(runs, ("static", "none"))[0], overrides={"sh_degree": "two"})
    (failure,) = run_plan([bad, *runs, frozen_at_t_star(runs)], results, 2)
    assert bad.run_id in failure
    assert (results / "logs" / f"{bad.run_id}.txt").is_file() and not finished(results, bad.run_id)
    return results, runs, said


def frozen_at_t_star(runs):
    auto = only(runs, ("auto", "support"))[0]
    return dataclasses.replace(auto, query="plain", variant="frozen at t* itself")


def test_the_plan_is_every_host_with_and_without_and_says_what_is_missing(scene, tmp_path):
    runs, said = plan([f"truth:{scene[0]}"], tmp_path, presets=("preview", "standard"), seeds=(0, 1), ablations=True)
    assert len({r.run_id for r in runs}) == len(runs)
    kept = {(r.host, r.supervision) for r in runs if r.variant == "default"}
    hosts = [h for h in ("hexplane", "mlp", "control_points") if h in METHODS]
    with_anchors = {(h, s) for h in hosts for s in ("none", "paper", "support")}
    assert kept == with_anchors | {("auto", "support"), ("static", "none")}
    for host in {"hexplane", "mlp", "control_points"} - set(hosts):
        assert sum(repr(host) in sentence for sentence in said) == 1
    variants = {r.variant for r in runs} - {"default"}
    assert {"no hidden loss", "no defective loss", "no confidence weighting", "no exposure"} <= variants
    assert len(variants) + sum("ablation" in s for s in said) == len({a.name for a in ABLATIONS})
    main = {r.run_name for r in runs if r.variant == "default"}
    frozen_runs = [r for r in runs if r.variant.startswith("frozen")]
    assert {r.supervision for r in frozen_runs} == {"none", "paper", "support"}
    assert {r.run_name for r in frozen_runs} <= main  # trained once, queried twice
    assert not only(plan([f"truth:{scene[0]}"], tmp_path)[0], ("auto", "none"))


def test_instants_are_trained_on(scene, tmp_path):
    runs, _ = plan([f"truth:{scene[0]}"], tmp_path)
    truth = TruthFolder(scene[0])
    loaded = load_scene(truth.shot)
    _, test = split_frames(loaded.solved, HOLDOUT, runs[0].holdout_phase)
    assert test and not {loaded.frames[i] for i in test} & set(truth.t_stars)


def test_a_run_is_named_after_scene_and_settings():
    spec = RunSpec("truth:/a/tiny", "abc", "auto", "support", "preview")
    assert spec.run_id == dataclasses.replace(spec).run_id
    assert spec.query == "nearest" and RunSpec("", "", "mlp", "paper", "preview").query == "plain"
    changed = [{"scene_key": "abd"}, {"seed": 1}, {"query": "plain"}, {"overrides": {"exposure.on": False}}]
    assert len({spec.run_id, *(dataclasses.replace(spec, **c).run_id for c in changed)}) == 5
    assert dataclasses.replace(spec, query="plain").run_name == spec.run_name  # trained once, queried twice


def test_an_override_that_does_not_exist_is_refused():
    config = RunSpec("", "", "auto", "support", "preview").config()
    override(config, "supervision.tau", 0.0)
    assert config.supervision.tau == 0.0
    for path in ("supervision.taw", "supervisor.tau", "tau"):
        with pytest.raises(ValueError, match=path):
            override(config, path, 0.0)


def test_a_record_holds_every_frame_and_its_regions(done, scene):
    results, runs, _ = done
    truth = TruthFolder(scene[0])
    for spec in runs:
        record = load_record(results / f"{spec.run_id}.json")
        assert [(r.t_star, r.pose) for r in record.rows] == [(t, p) for t in truth.t_stars for p in truth.poses(t, [])]
        whole = record.values("psnr_db")
        assert all(10 < v < 50 for v in whole.values())
        unseen = {key[3:]: value for key, value in record.values("psnr_db", "never_seen").items()}
        assert unseen[103, 103] is None and unseen[103, 114] > 5  # t*'s own pose sees nothing new
        assert record.host == spec.host and record.iterations == 60 and record.heldout_psnr_db is not None
        assert record.jobs == 2 and record.threads == max(1, len(cores()) // 2) and 0 < record.step_ms < 60_000
        # The benchmark measures 8-bit PNG plates, the trainer the same plates in half precision.
        psnr = [row.psnr_db["whole"] for row in record.heldout]
        assert psnr and sum(psnr) / len(psnr) == pytest.approx(record.heldout_psnr_db, abs=0.02)
        assert record.frozen_fps > 0 and 1e4 < record.model_bytes < 1e7 and record.train_cpu_seconds > 0
        assert all((results / p.ours).is_file() and (results / p.truth).is_file() for p in record.pictures)
        assert [p.psnr_db for p in record.pictures] == sorted(p.psnr_db for p in record.pictures)
        # The same with plate detail. The delivered frame at t*'s own pose equals the truth and is left out.
        poses = [(r.t_star, r.pose) for r in record.rows]
        for shown in (DEVELOPED, WITHHELD):
            assert [(r.t_star, r.pose) for r in record.detailed[shown].rows] == poses
        assert [(r.t_star, r.pose) for r in record.detailed[DELIVERED].rows] == [p for p in poses if p[0] != p[1]]
        static = {shown: record.as_shown(shown).values("psnr_db", "static") for shown in record.detailed}
        gains = [value - static[WITHHELD][key] for key, value in static[DELIVERED].items()]
        assert sum(gains) > 0 and "detail" not in record.missing
        splats_psnr = record.values("psnr_db", "static")
        gains = [value - splats_psnr[key] for key, value in static[DEVELOPED].items()]
        assert sum(gains) > len(gains), "a run of 60 steps has a lot to gain"
        delivered = record.detailed[DELIVERED]
        assert (
            delivered.frozen_fps > 0
            and delivered.pictures
            and all((results / p.ours).is_file() for p in delivered.pictures)
        )
        assert not {p.ours for p in delivered.pictures} & {p.ours for p in record.pictures}
        first, second = record.two_instants
        assert first.pose == second.pose and {first.t_star, second.t_star} == set(truth.t_stars) == {
            *map(int, record.plates)
        }


def test_runs_sharing_a_training_are_adjacent_and_train_once(done):
    results, runs, _ = done
    spec, variant = only(runs, ("auto", "support"))[0], frozen_at_t_star(runs)
    nearest, plain = (load_record(results / f"{s.run_id}.json") for s in (spec, variant))
    assert (nearest.query, plain.query) == ("nearest", "plain")
    assert (plain.train_seconds, plain.threads) == (nearest.train_seconds, nearest.threads)
    logs = [(results / "logs" / f"{s.run_id}.txt").read_text() for s in (spec, variant)]
    assert "already trained" not in logs[0] and "already trained" in logs[1]


def test_settings_of_a_run_are_what_is_trained(done, scene, tmp_path):
    spec = only(done[1], ("auto", "support"))[0]
    trained = read_json(TruthFolder(scene[0]).shot.run(spec.run_name) / "config.json")["config"]
    assert config_from_json(trained) == spec.config()
    runs, _ = plan([f"truth:{scene[0]}"], tmp_path, reference=True, **SIZE | {"iterations": 20})
    published = [r for r in runs if r.variant == "reference"]
    assert {(r.host, r.supervision) for r in published} == {(h, s) for h in hosts() for s in ("none", "paper")}
    for spec in published:
        config = spec.config()
        assert config.field == host_config(spec.host, "reference", 20) != host_config(spec.host, "default", 20)


def test_pace_is_measured_in_the_last_third_of_a_run(tmp_path):
    # Ten measurements of 100 steps: 20 ms per step, then 50 ms from the 7th on; an interruption repeated the 8th.
    rows = [{"iteration": 100 * n, "seconds": 2.0 * min(n, 6) + 5.0 * max(0, n - 6)} for n in range(1, 11)]
    rows.insert(7, {"iteration": 800, "seconds": 99.0})
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert last_third_step_ms(tmp_path / "metrics.jsonl", 1000) == pytest.approx(50.0)
    assert last_third_step_ms(tmp_path / "absent.jsonl", 1000) is None


def test_a_finished_plan_runs_nothing(done, capsys):
    results, runs, _ = done
    before = {p: p.stat().st_mtime_ns for p in results.glob("*.json")}
    assert run_plan(runs, results) == []
    assert capsys.readouterr().out == ""
    assert {p: p.stat().st_mtime_ns for p in results.glob("*.json")} == before


@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
def test_killed_it_ends_as_if_it_had_not_been(done, tmp_path, write_truth):
    results, runs, _ = done
    folder = tmp_path / "tiny"
    write_truth(folder)
    again = tmp_path / "results"
    spec = dataclasses.replace(only(runs, ("static", "none"))[0], source=f"truth:{folder}")
    log = again / "logs" / f"{spec.run_id}.txt"
    code = (
        "import json, sys; from pathlib import Path; from benchmarks.bench import *\n"
        "run_plan([RunSpec(**json.loads(sys.argv[1]))], Path(sys.argv[2]))"
    )
    command = [sys.executable, "-c", code, json.dumps(dataclasses.asdict(spec)), str(again)]
    bench = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (
        log.is_file() and "stage='training'" in log.read_text().replace('"', "'")
    ):
        if finished(again, spec.run_id):
            break
        time.sleep(0.01)
    bench.send_signal(signal.SIGKILL)
    bench.wait()
    log.unlink(missing_ok=True)
    # Children of the killed process may still be writing their last checkpoint; nothing waits for them here.
    assert run_plan([spec], again) == [] and not working(spec.run_id)
    first, second = (load_record(place / f"{spec.run_id}.json") for place in (results, again))
    for a, b in zip(first.rows, second.rows, strict=True):
        assert b.value("psnr_db") == pytest.approx(a.value("psnr_db"), abs=0.01)
        assert b.regions.keys() == a.regions.keys()


def working(run_id: str) -> bool:
    """True if a child process of that run is alive."""
    found = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True)
    return any(run_id in line and "--work" in line for line in found.stdout.splitlines())


def test_the_report_is_written_from_what_the_runs_left(done, tmp_path):
    results, runs, said = done
    path = write_report(results, tmp_path / "report", [r.run_id for r in runs], said, "bench --quick")
    text = path.read_text()
    assert "auto (ours)" in text and "static 3DGS" in text and "never seen at t*" in text
    assert all(sentence in text for sentence in said)
    figures = json.loads((tmp_path / "report" / "report.json").read_text())
    assert {r["run_id"] for r in figures["runs"]} == {r.run_id for r in runs}


def test_a_real_clip_is_judged_where_nothing_moves_far_from_the_instant(scene):
    truth = RealScene(scene[1].shot, instants=3)
    assert truth.t_stars == [101, 109, 116]
    assert truth.poses(101, [103, 105, 106, 115]) == [106, 115]
    mask = truth.regions(101, 109, 32, 24)["rigid"]
    assert mask.shape == (24, 32) and mask.dtype == torch.bool
    kept = scene[1].shot.solve / "motion" / "000109.png"
    before = kept.stat().st_mtime_ns
    again = RealScene(scene[1].shot, instants=3)
    assert bool((again.regions(116, 109, 32, 24)["rigid"] == mask).all()) and kept.stat().st_mtime_ns == before


def test_what_a_failed_child_said_is_not_lost_behind_what_libraries_say_at_the_end():
    errors = "starting\nanny is missing: install it.\nnanobind: leaked 3 instances!\n - leaked type x\nSee https://nanobind.y\n"
    assert last_words(errors) == "anny is missing: install it."
    assert last_words("\n") == "no output"
