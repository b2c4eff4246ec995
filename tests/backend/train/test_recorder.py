"""When a step is recorded, replayed or launched, depending on its facts (`step_facts`).

`card/test_card.py` tests that a replay equals the recorded step.
"""

import contextlib
import dataclasses
import gc
import weakref

import pytest
import torch

from torch_backend.contract import JobError, TrainParams
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params
from torch_backend.train.events import schedule_events
from torch_backend.train.loop import TrainingLoop
from torch_backend.train.recorder import Recorder
from torch_backend.train.trainer import Trainer


class Again:
    """Executes the work at each replay, on the current facts."""

    def __init__(self, fails=False, room=True, short=0):
        self.fails, self.room, self.short, self.recorded, self.dropped = fails, room, short, 0, 0

    def watched(self):
        return contextlib.nullcontext()

    def fits(self):
        return self.room

    def drop(self):
        self.dropped += 1

    def record(self, work):
        if self.fails:
            raise RuntimeError("operation not permitted when stream is capturing\nsee the log")
        self.short -= 1
        if self.short >= 0:
            raise torch.OutOfMemoryError("CUDA out of memory")
        self.recorded += 1
        result = torch.zeros(())
        return lambda: result.copy_(work()), result


@pytest.fixture(scope="module")
def trained(world, quiet):
    scene = load_scene(world.shot)
    images = load_images(scene, scene.solved, 32, 24)

    def run(recording, steps=24, break_at=-1, method="hexplane", targets=None):
        config = config_from_params(TrainParams(iterations=40, max_gaussians=330, method=method, width=32))
        config.field.resolution = 16  # a step takes a third of the time
        config.densify.every, config.init.seeds, config.field.start, config.densify.start = 10, 0, 0.1, 0.2
        trainer = Trainer(scene, images, scene.solved, config, quiet(), {}, "cpu")
        trainer.targets = targets
        if recording is not None:
            trainer.recorder = Recorder(trainer, torch.device("cpu"), recording)
        for _ in range(steps):
            schedule_events(trainer)
            if trainer.iteration == break_at:
                trainer.soundness.troubled = True
            trainer.step()
            trainer.iteration += 1
        return trainer

    return run


@pytest.fixture(scope="module")
def plain(trained):
    """A run without recordings; tests must not change it."""
    return trained(None)


def equal(one, two):
    return all(
        torch.equal(p, q) for p, q in zip(one.named_tensors().values(), two.named_tensors().values(), strict=True)
    )


class EveryOther:
    """Depth maps of every second trained frame, with a different depth in each."""

    every, weight = 2, 0.02

    def at(self, frame):
        wanted = torch.full((24, 32), 0.1 + 0.01 * frame)
        return None if frame % 2 else torch.stack([wanted, torch.full_like(wanted, 0.01)])


def test_depth_maps_reach_a_replayed_step_with_its_facts(trained, plain):
    launched, recorded = trained(None, targets=EveryOther()), trained(Again(), targets=EveryOther())
    assert equal(launched, recorded) and not equal(launched, plain)
    assert {kind.depth for kind, _ in recorded.recorder._seen} == {True, False}


def test_a_kind_is_launched_once_and_then_replayed_until_growth(trained, plain):
    recording = Again()
    recorded = trained(recording)
    assert equal(plain, recorded)
    kinds = {kind for kind, _ in recorded.recorder._seen}
    assert {(kind.moves, kind.hidden) for kind in kinds} == {(False, False), (True, False), (True, True)}
    assert recorded.recorder.replayed == 24 - len(kinds) and recorded.recorder.refused == ""
    assert recording.recorded > 3 and recording.dropped >= 2, "growth at 10 and 20"


def test_while_nothing_moves_a_kind_is_recorded_once(trained):
    recording = Again()
    recorder = trained(recording, steps=10, method="static").recorder
    assert recorder.replayed == 10 - len(recorder._seen) > 0
    assert recording.recorded <= len(recorder._seen) < 5 and recording.dropped == 0, "a kind has other harmonics"


def test_a_run_goes_on_where_a_recording_fails_or_finds_no_room(trained, plain):
    failed = trained(Again(fails=True))
    assert failed.recorder.refused == "operation not permitted when stream is capturing"
    assert failed.recorder.replayed == 0 and equal(plain, failed)
    full = trained(Again(room=False))
    assert full.recorder.refused == "" and full.recorder.replayed == 0 and equal(plain, full)


def test_a_recording_that_found_too_little_room_is_tried_again(trained, plain):
    recording = Again(short=2)
    recorded = trained(recording)
    assert recorded.recorder.refused == "" and recorded.recorder.replayed > 0 and equal(plain, recorded)
    assert recording.short < 0 and recording.dropped >= 2
    never = trained(Again(short=100), steps=12, method="static")
    assert "too little memory" in never.recorder.refused and never.recorder.recording.short == 96


def test_a_longer_list_of_hits_is_recorded_anew(trained, plain, monkeypatch):
    rooms = [100] * 9 + [200] * 999  # for example, a held-out frame needs more
    monkeypatch.setattr("torch_backend.train.recorder.listed", lambda *_: rooms.pop(0))
    recording = Again()
    recorded = trained(recording)
    assert equal(plain, recorded) and len(rooms) < 999
    assert {entry.listed for entry in recorded.recorder._recorded.values()} == {200}
    usual = Again()
    monkeypatch.setattr("torch_backend.train.recorder.listed", lambda *_: 100)
    trained(usual)
    assert recording.recorded > usual.recorded


def test_recordings_go_when_steps_come_that_cannot_be_recorded(trained):
    recording = Again()
    recorded = trained(recording, steps=9)
    assert recorded.recorder._recorded
    kind, facts = recorded._step_inputs(0)
    recorded.model.gaussians.rebuild(
        torch.arange(len(recorded.model.gaussians)), torch.zeros(len(recorded.model.gaussians), dtype=torch.bool),
        recorded.optimizer,
    )  # fmt: skip
    recorded.recorder.step(dataclasses.replace(kind, recordable=False), facts, 0)
    assert not recorded.recorder._recorded, "what they read is no part of the run any more"


def test_a_finished_run_goes_with_the_last_who_knows_it(trained):
    gc.collect()
    gc.disable()
    try:
        run = trained(Again(), steps=1)  # this stand-in's recordings reference the run
        gone = weakref.ref(run.recorder)
        del run
        assert gone() is None
    finally:
        gc.enable()


def test_work_between_steps_has_the_room_of_recordings(trained):
    recorded, tries = trained(Again(), steps=9), []

    def work():
        tries.append(bool(recorded.recorder._recorded))
        if len(tries) == 1:
            raise torch.OutOfMemoryError("CUDA out of memory")

    TrainingLoop(recorded, None, lambda _: None)._with_room(work)
    assert tries == [True, False] and recorded.recorder.refused != ""


def test_where_memory_ends_the_recordings_go_first_and_the_run_stays_as_it_is(trained, tmp_path):
    recorded = trained(Again(), steps=19)
    before, event_count = len(recorded.model.gaussians), len(recorded.report.events)
    loop = TrainingLoop(recorded, tmp_path / "c.safetensors", lambda _: None)
    loop._make_room()
    assert recorded.recorder.refused != "" and recorded.pieces is None
    assert len(recorded.model.gaussians) == before and len(recorded.report.events) == event_count
    with pytest.raises(JobError, match="too little memory"):  # so few Gaussians cannot be reduced further
        loop._make_room()


def test_after_a_step_that_was_left_out_the_next_are_launched(trained):
    recorded = trained(Again(), steps=20, break_at=14)
    assert recorded.recorder.replayed == trained(Again(), steps=14).recorder.replayed > 0
    means = recorded.model.gaussians.params["means"]
    assert means.grad is not None, "a look finds the gradients of the last step"
