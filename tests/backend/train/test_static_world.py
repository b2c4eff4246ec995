"""Renders of a static model of a clip, and their use for mattes."""

import numpy as np
import pytest
import torch

from tests.backend.conftest import FIRST, FRAMES, HEIGHT, WIDTH, build_world
from torch_backend.contract import Cancelled, JobError, TrainParams, read_json
from torch_backend.footage.images import read_png
from torch_backend.job import RUNNERS
from torch_backend.motion.mattes import is_found, is_outdated
from torch_backend.motion_search import find_motion
from torch_backend.shot import Shot, write_json
from torch_backend.train import static_views
from torch_backend.train.static_world import STAGE, steps_for


@pytest.fixture(scope="module")
def learnt(world, quiet):
    report, before = quiet(), sorted(world.shot.root.rglob("*"))
    shown = static_views(world.shot, report)
    assert sorted(world.shot.root.rglob("*")) == before
    return shown, report


def test_it_shows_the_wall_at_every_frame_and_not_the_patch_where_it_is_for_a_moment(world, learnt):
    shown, _ = learnt
    clear, passed = [], []
    for n in range(FRAMES):
        picture = shown(FIRST + n)
        assert picture.shape == (HEIGHT, WIDTH, 3) and picture.dtype == np.uint8
        error = np.abs(picture.astype(int) - read_png(world.shot.plate(FIRST + n))).max(-1)
        now, mirrored = (world.patch(n, time) for time in (n / (FRAMES - 1), 1.0 - n / (FRAMES - 1)))
        clear.append(error[(now < 0.01) & (mirrored < 0.01)])
        passed.append(error[(now > 0.9) & (mirrored < 0.1)])
    clear, passed = np.concatenate(clear), np.concatenate(passed)
    assert np.median(clear) < 4 and np.quantile(clear, 0.95) < 20
    assert len(passed) > 200 and np.median(passed) > 32


def test_its_training_is_a_stage_of_the_solve_and_says_nothing_else(learnt):
    _, report = learnt
    assert {event[0] for event in report.events} == {"progress"}
    assert {event[1] for event in report.events} == {STAGE}
    assert report.events[-1][2:4] == (steps_for(FRAMES), steps_for(FRAMES))


def test_it_is_the_same_each_time_and_whatever_was_drawn_before(world, learnt, quiet):
    torch.manual_seed(5)
    again = static_views(world.shot, quiet())
    for frame in (FIRST, FIRST + 7):
        assert (again(frame) == learnt[0](frame)).all()


def test_it_can_be_cancelled(world, quiet):
    with pytest.raises(Cancelled):
        static_views(world.shot, quiet(cancel_at=(STAGE, 0.2)))


def test_a_shot_that_is_not_solved_is_one_sentence(tmp_path, quiet):
    with pytest.raises(JobError, match="has no cameras yet"):
        static_views(Shot.create(tmp_path / "empty.splannequin"), quiet())


def test_a_training_finds_mattes_of_an_earlier_version_again(tmp_path, quiet):
    """Without new mattes, the training would guess moving areas and give no warning."""
    shot = build_world(tmp_path).shot
    find_motion(shot, quiet(), static_model=None)
    record = shot.motion / "motion.json"
    write_json(record, {**read_json(record), "version": 4})
    assert is_outdated(shot)
    report = quiet()
    RUNNERS["train"](shot, TrainParams(iterations=20, max_gaussians=900), report)
    assert is_found(shot) and not is_outdated(shot)
    assert STAGE in {event[1] for event in report.events}
    assert read_json(shot.run("main") / "config.json")["motion"]
