"""Pause, resume, extended training, and several runs and takes: on files of the real formats, and on a real backend."""

import json
import os
import struct
import time
from pathlib import Path

import bpy
import pytest

CONFIG = {
    "preset": "preview", "iterations": 900, "width": 48, "method": "auto", "host": "mlp", "host_config": "reference",
    "holdout": 5, "seed": 7, "densify": {"budget": 1234}, "supervision": {"preset": "paper", "detector": "weight"},
}  # fmt: skip


def checkpoint(path: Path, **facts) -> None:
    """Write a checkpoint file in safetensors format: the header and one tensor."""
    record = {"version": 1, "key": "k", "config": CONFIG, "trained_seconds": 10.0, **facts}
    tensor = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    header = json.dumps({"__metadata__": {"splannequin": json.dumps(record)}, "means": tensor}).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(struct.pack("<Q", len(header)) + header + b"\0\0\0\0")


@pytest.fixture
def with_runs(scene, shot):
    """Test shot with a finished run `main`, a paused run `better`, and a second take."""
    scene.splannequin.shot_path = str(shot)
    summary = shot / "runs" / "main" / "summary.json"
    record = {**json.loads(summary.read_text()), "preset": "preview", "key": "k", "train_seconds": 125.0}
    summary.write_text(json.dumps(record))
    checkpoint(shot / "runs" / "main" / "checkpoint.safetensors", iteration=900)
    checkpoint(shot / "runs" / "better" / "checkpoint.safetensors", iteration=300)
    return scene


def plan(addon, scene):
    state = addon("shot.inventory").read(addon("shot.selection").shot_folder(scene))
    return addon("train.training").plan(state, scene.splannequin.run_name, scene.splannequin.preset)


def test_the_button_says_what_it_will_do(addon, with_runs, shot):
    props = with_runs.splannequin
    assert plan(addon, with_runs).button == "Continue Training"
    props.run_name = "new"
    assert (plan(addon, with_runs).button, plan(addon, with_runs).words) == ("Train", "")
    props.run_name = "better"
    assert (plan(addon, with_runs).kind, plan(addon, with_runs).button) == ("resume", "Resume")
    props.preset = "final"
    assert (
        plan(addon, with_runs).button == "Train from Scratch" and "a different preset" in plan(addon, with_runs).words
    )
    props.run_name = "main"
    assert plan(addon, with_runs).kind == "anew"
    props.preset = "preview"
    grown = [{"from_iteration": 900, "steps": 300}]
    checkpoint(shot / "runs" / "main" / "extension.safetensors", iteration=1000, extensions=grown)
    assert (plan(addon, with_runs).kind, plan(addon, with_runs).button) == ("extension", "Resume")
    assert addon("shot.inventory").read(shot).runs["main"]["extension"] == {"done": 100, "steps": 300}
    grown[0]["from_iteration"] = 600
    checkpoint(shot / "runs" / "main" / "extension.safetensors", iteration=700, extensions=grown)
    assert plan(addon, with_runs).kind == "extend", "it was begun on a run that is no longer there"


def test_a_training_that_will_replace_a_run_is_gone_on_with(addon, with_runs, shot):
    """The backend trains with other settings in the subfolder `next` of the run; the finished run stays listed."""
    props, shots = with_runs.splannequin, addon("shot.inventory")
    config, before = {**CONFIG, "preset": "final", "seed": 9}, shots.stamp(shot)
    work = shot / "runs" / "main" / "next" / "0123456789abcdef"
    checkpoint(work / "checkpoint.safetensors", key="other", iteration=450, config=config)
    (work / "metrics.jsonl").write_text('{"seconds": 3.0, "heldout_psnr_db": 20.0}\n')
    assert shots.stamp(shot) != before, "the panel notices"
    state = shots.read(shot)
    assert set(state.runs) == {"main"} and set(state.unfinished) == {"better"}
    assert addon("train.training").history(state.runs["main"], [(4.0, 21.0)]) == [(3.0, 20.0), (4.0, 21.0)]
    assert plan(addon, with_runs).button == "Continue Training", "the run that is there is of the preset that is chosen"
    props.preset = "final"
    assert plan(addon, with_runs).kind == "resume" and "does not change" in plan(addon, with_runs).words
    params = addon("process.steps").STEPS["train"].params(with_runs)
    assert (params.run, params.preset, params.seed, params.iterations, params.extend) == ("main", "final", 9, 900, 0)


def test_train_request_matches_its_button_label(addon, with_runs, shot):
    props, steps = with_runs.splannequin, addon("process.steps").STEPS
    props.extend_steps = 70
    params = steps["train"].params(with_runs)
    assert (params.run, params.extend, params.iterations) == ("main", 70, 0)
    checkpoint(
        shot / "runs" / "main" / "extension.safetensors", iteration=1000,
        extensions=[{"from_iteration": 900, "steps": 300}],
    )  # fmt: skip
    assert steps["train"].params(with_runs).extend == 300, "the steps that were begun, not those in the field"
    props.run_name = "better"
    params = steps["train"].params(with_runs)
    assert (params.run, params.extend, params.iterations, params.width) == ("better", 0, 900, 48)
    assert (params.max_gaussians, params.holdout, params.seed) == (1234, 5, 7)
    assert (params.host, params.host_config, params.supervision, params.detector) == (
        "mlp",
        "reference",
        "paper",
        "weight",
    )
    props.preset = "standard"
    assert (steps["train"].params(with_runs).preset, steps["train"].params(with_runs).iterations) == ("standard", 0)
    props.run_name = "new"
    assert steps["train"].params(with_runs).extend == 0


def test_new_depth_maps_restart_training(addon, with_runs, shot, tmp_path):
    props, step = with_runs.splannequin, addon("process.steps").STEPS["train"]
    props.run_name, props.depth = "new", f"{tmp_path / 'depth'}{os.sep}"
    params = step.params(with_runs)
    assert (params.depth, params.extend) == (str(tmp_path / "depth"), 0)
    props.run_name = "main"
    training = addon("train.training")

    def plan_now():
        state = addon("shot.inventory").read(shot)
        return training.plan(state, props.run_name, props.preset, str(tmp_path / "depth") if props.depth else "")

    assert plan_now().kind == "anew" and "depth" in plan_now().words
    assert step.params(with_runs).depth == str(tmp_path / "depth")
    record = {"key": "d", "source": str(tmp_path / "depth")}
    checkpoint(shot / "runs" / "main" / "checkpoint.safetensors", iteration=900, depth=record)
    checkpoint(shot / "runs" / "better" / "checkpoint.safetensors", iteration=300, depth=record)
    assert plan_now().kind == "extend" and step.params(with_runs).depth == "", "the run has its own copy"
    props.depth = ""
    assert plan_now().kind == "extend"
    props.run_name = "better"
    assert plan_now().kind == "resume" and step.params(with_runs).depth == str(tmp_path / "depth")
    checkpoint(shot / "runs" / "better" / "checkpoint.safetensors", iteration=300, depth={"source": ["/etc"]})
    assert step.params(with_runs).depth == ""


def test_the_panel_says_how_depth_maps_fit(addon, with_runs, shot):
    step, inventory = addon("process.steps").STEPS["train"], addon("shot.inventory")
    file = shot / "runs" / "main" / "summary.json"
    record = json.loads(file.read_text())
    good = {"linear_in": "inverse depth", "residual": 0.0312, "frames": 38, "of_frames": 40}
    for facts, shown in (
        (good, True),
        ({**good, "linear_in": "\n"}, False),
        ({**good, "frames": "38"}, False),
        (7, False),
    ):
        file.write_text(json.dumps({**record, "depth": facts}))
        lines = step.view(with_runs, inventory.read(shot)).state
        assert any("inverse depth" in line and "3.1 %" in line for line in lines) == shown


def test_more_steps_are_a_third_of_the_presets_at_first(scene, contract):
    props = scene.splannequin
    assert props.extend_steps == round(contract.PRESET_STEPS["preview"] / 3)
    for preset, steps in contract.PRESET_STEPS.items():
        props.preset = preset
        assert props.extend_steps == round(steps / 3)
    props.extend_steps = 42
    assert props.extend_steps == 42


def test_after_another_solve_training_begins_anew(addon, with_runs, shot):
    import hashlib

    run, cameras = shot / "runs" / "main", shot / "solve" / "cameras.json"
    key = hashlib.sha256(json.dumps(json.loads(cameras.read_text()), sort_keys=True).encode()).hexdigest()[:16]
    (run / "config.json").write_text(json.dumps({"version": 1, "solve": key}))
    later = (run / "checkpoint.safetensors").stat().st_mtime + 10
    os.utime(cameras, (later, later))
    assert plan(addon, with_runs).kind == "extend", "the same cameras, written again"
    cameras.write_text(cameras.read_text().replace("20.0", "21.0"))
    os.utime(cameras, (later, later))
    assert plan(addon, with_runs).kind == "anew" and "solved again" in plan(addon, with_runs).words


def test_broken_checkpoints_are_passed_over(addon, shot, tmp_path):
    read = addon("shot.checkpoints").facts
    assert read(tmp_path / "none") == {}
    for content in (b"", b"\x05", struct.pack("<Q", 1 << 60) + b"{}", struct.pack("<Q", 2) + b"[]"):
        (tmp_path / "bad").write_bytes(content)
        assert read(tmp_path / "bad") == {}
    (shot / "runs" / "odd").mkdir()
    (shot / "runs" / "odd" / "checkpoint.safetensors").write_bytes(b"odd")
    assert addon("shot.inventory").read(shot).unfinished == {}


def test_runs_and_takes_are_listed_together(addon, with_runs, shot, new_take):
    new_take(shot, "second")
    state, listing = addon("shot.inventory").read(shot), addon("ui.listing")
    assert listing.run_rows(state) == [
        ("better", "paused at 33 %"),
        ("main", "24.00", "12.3k", "5%", "2m"),
    ]
    assert listing.take_rows(state) == [("freeze", "6", "3", "main"), ("second", "6", "3", "main")]
    assert [listing.duration(s) for s in (None, 44.6, 600.0, 5400.0)] == ["-", "45s", "10m", "1.5h"]


def test_a_click_picks_a_run_with_its_preset_and_a_take(addon, with_runs, shot, new_take):
    new_take(shot, "second")
    props = with_runs.splannequin
    checkpoint(shot / "runs" / "better" / "checkpoint.safetensors", iteration=300, config={**CONFIG, "preset": "final"})
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.splannequin.pick_run("EXEC_DEFAULT", True, name="better") == {"FINISHED"}
    assert (props.run_name, props.preset) == ("better", "final")
    bpy.ops.ed.undo()
    props = bpy.context.scene.splannequin
    assert (props.run_name, props.preset) == ("main", "preview")
    bpy.ops.splannequin.pick_take(name="second")
    assert props.take_name == "second"
    for pick in (bpy.ops.splannequin.pick_run, bpy.ops.splannequin.pick_take):
        with pytest.raises(RuntimeError, match="This shot has no"):
            pick(name="nowhere")


def test_removing_a_run_removes_its_folder_and_nothing_else(addon, with_runs, shot):
    kept = sorted(p for p in shot.rglob("*") if "better" not in p.parts)
    watch = addon("process.job_timer").watch_of(shot)
    assert set(watch.state.unfinished) == {"better"}
    assert bpy.ops.splannequin.remove_run(name="better") == {"FINISHED"}
    assert sorted(shot.rglob("*")) == kept, "nor is there a trash left"
    assert watch.state.unfinished == {} and set(watch.state.runs) == {"main"}
    for name in ("better", "", "..", "../solve", "main/../../solve", str(shot / "solve")):
        with pytest.raises(RuntimeError, match="This shot has no run"):
            bpy.ops.splannequin.remove_run(name=name)
    assert sorted(shot.rglob("*")) == kept


def test_a_take_that_the_compositor_shows_is_not_removed(addon, with_runs, shot, new_take):
    new_take(shot, "second")
    bpy.ops.splannequin.insert_freeze()
    with pytest.raises(RuntimeError, match="The compositor shows this take"):
        bpy.ops.splannequin.remove_take(name="freeze")
    assert bpy.ops.splannequin.remove_take(name="second") == {"FINISHED"}
    assert [p.name for p in (shot / "takes").iterdir()] == ["freeze"]
    bpy.ops.splannequin.remove_shot()
    assert bpy.ops.splannequin.remove_take(name="freeze") == {"FINISHED"}
    assert list((shot / "takes").iterdir()) == []


def test_nothing_is_picked_or_removed_while_a_step_runs(addon, contract, with_runs, shot):
    addon("process.jobs").new_job(shot, "train", contract.TrainParams())
    assert addon("process.job_timer").watch_of(shot).running() == "train"
    for name in ("pick_run", "pick_take", "remove_run", "remove_take"):
        assert not getattr(bpy.ops.splannequin, name).poll(), name


def test_extension_curve_continues_the_run_curve(addon):
    record = {"history": [(1.0, 20.0), (2.0, 21.0), (3.0, 22.0)]}
    history = addon("train.training").history
    assert history(record, []) == record["history"]
    assert history(record, [(2.5, 21.5), (4.0, 23.0)]) == [(1.0, 20.0), (2.0, 21.0), (2.5, 21.5), (4.0, 23.0)]
    assert history({}, [(1.0, 9.0)]) == [(1.0, 9.0)]


def test_a_run_that_goes_on_shows_its_last_picture_until_it_has_another(addon, with_runs, shot):
    def shown(now=None):
        return addon("train.training").preview(addon("shot.inventory").read(shot).runs["main"], now)

    def picture(run, name):
        (run / "previews").mkdir(parents=True)
        (run / "previews" / name).write_bytes(b"")
        return run / "previews" / name

    run = shot / "runs" / "main"
    assert shown() is None
    before = picture(run, "000170.png")
    assert shown() == before
    assert shown(str(before.with_name("000350.png"))) == before.with_name("000350.png")
    instead = run / "next" / "0123456789abcdef"
    checkpoint(instead / "checkpoint.safetensors", key="other", iteration=450)
    assert shown() is None, "the run's own is of other settings"
    after = picture(instead, "000020.png")
    assert shown() == after


def test_a_training_is_gone_on_with_paused_and_resumed_by_a_real_backend(addon, scene, frozen_world):
    jobs, shots, shot = addon("process.jobs"), addon("shot.inventory"), frozen_world / "tiny.splannequin"
    scene.splannequin.shot_path = str(shot)
    assert plan(addon, scene).kind == "extend"
    before = shots.read(shot).runs["main"]["iterations"]
    scene.splannequin.extend_steps = 120
    job = addon("process.begin").begin(scene, "train")
    while "preview" not in job.images and not job.ended:
        jobs.poll(job, 0.05)
        time.sleep(0.02)
    steps = int(Path(job.images["preview"]).stem) - before
    assert 0 < steps < 120 and steps % 12 == 0
    jobs.cancel(job)
    job.process.wait()
    assert plan(addon, scene).button == "Resume"
    run = shots.read(shot).runs["main"]
    assert run["iterations"] == before and steps <= run["extension"]["done"] < 120
    addon("process.job_timer").forget()
    assert bpy.ops.splannequin.train() == {"FINISHED"}
    run = shots.read(shot).runs["main"]
    assert (run["iterations"], run["extension"]) == (before + 120, None)
    assert [seconds for seconds, _ in run["history"]] == sorted({seconds for seconds, _ in run["history"]})
    assert run["preview"].name == f"{before + 120:06d}.png"


@pytest.mark.parametrize("link", ["takes/mine", "trash", "takes"])
def test_removing_a_take_deletes_nothing_behind_a_link(addon, shot, new_take, tmp_path, link):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "holiday.png").write_bytes(b"mine")
    new_take(tmp_path / "elsewhere", "mine")
    path = shot / link
    if link == "takes":
        path.rename(shot / "was")
        path.symlink_to(tmp_path / "elsewhere" / "takes", target_is_directory=True)
    else:
        path.symlink_to(mine, target_is_directory=True)
    take = shot / "takes" / ("freeze" if link == "trash" else "mine")
    remove = addon("ui.listing").remove
    if link == "takes":
        with pytest.raises(OSError, match="takes is a link to another folder"):
            remove(shot, take, wait=True)
        assert len(list((tmp_path / "elsewhere" / "takes" / "mine").iterdir())) == 4
    else:
        remove(shot, take, wait=True)
        assert not os.path.lexists(take) and not os.path.lexists(shot / "trash")
    assert [p.name for p in mine.iterdir()] == ["holiday.png"]
