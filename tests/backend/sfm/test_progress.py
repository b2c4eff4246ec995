"""A solve has one progress bar with one estimate, and its cameras are available before it ends."""

import shutil

import pytest

from tests.backend.solved_room import solve_all
from torch_backend.cameras.stored import load_cameras
from torch_backend.contract import CAMERAS_KNOWN, FORECAST, Cancelled, Reporter
from torch_backend.footage import load_frames
from torch_backend.motion.mattes import is_outdated
from torch_backend.sfm.progress import OneBar, weights_of
from torch_backend.sfm.solving import SolveConfig

FRAMES = {"width": 640, "height": 480, "frames": [{"solve": n % 2 == 0} for n in range(40)]}


class Heard(Reporter):
    """Records the progress; with `stop`, cancels when the cameras are known, as a kill would."""

    def __init__(self, stop=False):
        self.bar, self.metrics, self.stop = [], [], stop

    def progress(self, stage, done, total, message=""):
        assert stage == "solve"
        self.bar.append(done / total)

    def metric(self, stage, values):
        self.metrics.append((stage, self.bar[-1], dict(values)))
        if self.stop and stage == CAMERAS_KNOWN:
            raise Cancelled


def stage(bar, name, *shares):
    for share in shares or (0.0, 0.5, 1.0):
        bar.progress(f"solve: {name}", share * 20, 20)


ORDER = ["features", "matches", "cameras", "other features", "other matches", "undistort", "still world", "motion"]


@pytest.mark.parametrize(
    "stages",
    [
        ORDER,
        ["masks", "lens", *ORDER],
        ["features", "matches", "cameras", "undistort", "motion"],
        ["features", "matches", "cameras", "matches", "cameras", "features", "matches", "cameras", *ORDER[3:]],
        ["still world", "motion"],
    ],
    ids=["plain", "masked", "all solved", "tried again", "motion alone"],
)
def test_the_bar_never_falls_and_ends_full(stages):
    heard = Heard()
    bar = OneBar(heard, weights_of(FRAMES))
    for name in stages:
        stage(bar, name)
        assert heard.bar[-1] < 1.0 or name == "motion"
    assert heard.bar == sorted(heard.bar) and heard.bar[-1] == pytest.approx(1.0)
    assert len({round(share, 6) for share in heard.bar}) > len(stages), "it moves in every stage"


def test_a_search_for_motion_that_goes_on_begins_at_nothing_and_what_is_no_stage_moves_nothing():
    heard = Heard()
    bar = OneBar(heard, weights_of(FRAMES))
    bar.progress("solve", 1, 1, "already solved")
    stage(bar, "motion", 0.75, 0.875, 1.0)
    assert heard.bar == pytest.approx([0.0, 0.0, 0.5, 1.0])


def test_the_estimate_is_of_all_that_is_left():
    """Half of the weight is done, so the other half will take as long, independent of its stages."""
    now = [100.0]
    heard = Heard()
    bar = OneBar(heard, {"features": 30.0, "matches": 20.0, "motion": 50.0}, lambda: now[0])
    for name, seconds in (("features", 30), ("matches", 20)):
        for second in range(seconds + 1):
            stage(bar, name, second / seconds)
            now[0] += 2.0 * (second < seconds)
    left = [values["seconds_left"] for kind, _, values in heard.metrics if kind == FORECAST]
    assert sorted(set(left), reverse=True) == pytest.approx(list(range(194, 99, -2))), "two seconds less each time"
    assert heard.bar[-1] == pytest.approx(0.5)


def test_cameras_are_complete_before_the_motion_search(again):
    shot, model = again
    shutil.rmtree(shot.motion)
    shutil.rmtree(shot.solve)
    heard = Heard(stop=True)
    bar = OneBar(heard, weights_of(load_frames(shot)))
    with pytest.raises(Cancelled):
        solve_all(shot, SolveConfig(), bar, model)
    known = [share for kind, share, _ in heard.metrics if kind == CAMERAS_KNOWN]
    assert len(known) == 1 and known[0] < 1.0
    assert len(load_cameras(shot).frames) == 15 and shot.plate(101).is_file()
    assert is_outdated(shot), "whoever needs the mattes finds them first"
