"""Clips without a camera solution, each refused with a specific message.

They use real pictures (examples/sitting.mp4) if possible: a tripod and a rotating camera show one place, so one warped
frame is enough. The others show the rendered room.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from torch_backend.contract import EVENTS_FILE, ExitCode, JobError, SolveParams, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import read_png, write_png
from torch_backend.job import new_job, run_job
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot

SITTING = Path(__file__).resolve().parents[3] / "examples" / "sitting.mp4"


@pytest.fixture(scope="module")
def sitting(tmp_path_factory, tools):
    """The first eight frames of the example at 320 x 240: 0.7 s, in which the camera hardly moves."""
    shot = Shot.create(tmp_path_factory.mktemp("sitting") / "short.splannequin")
    import_footage(shot, str(SITTING), FootageConfig(first=1, last=8, step=1, working_height=240), tools.recorder())
    return shot


def clip(folder, pictures):
    (folder / "clip").mkdir()
    for n, pixels in enumerate(pictures, 1):
        write_png(folder / "clip" / f"f.{n:04d}.png", np.clip(np.rint(pixels), 0, 255).astype(np.uint8))
    return str(folder / "clip")


def refused(tools, folder, source, fps=8.0, **settings):
    """(message, hint, warnings) of the refusal of a clip."""
    shot, report = Shot.create(folder / "a.splannequin"), tools.recorder()
    import_footage(shot, source, FootageConfig(step=1, fps=fps), tools.recorder())
    return refusal(shot, report, **settings)


def refusal(shot, report, **settings):
    with pytest.raises(JobError) as error:
        solve_shot(shot, SolveConfig(features=700, **settings), report)
    assert error.value.exit_code == ExitCode.SOLVE and not (shot.solve / "scratch").exists()
    assert not shot.cameras.exists()
    return error.value.message, error.value.hint, report.warnings


def still(sitting):
    return read_png(next(sitting.raw.iterdir())).astype(np.float64)


def test_a_tripod(tmp_path, tools, sitting):
    rng, picture = np.random.default_rng(0), still(sitting)
    source = clip(tmp_path, [picture + rng.normal(0.0, 4.0, picture.shape) for _ in range(8)])
    message, hint, warnings = refused(tools, tmp_path, source, fps=6.0)
    assert message.startswith("The camera does not move: features shift by at most ")
    assert "sideways by a step" in hint and warnings == []


def test_a_camera_that_pans_on_its_tripod(tmp_path, tools, sitting):
    """One frame, warped by the homographies of a rotating camera, with independent sensor noise in each picture."""
    picture, lens = still(sitting), np.array([[287.0, 0.0, 160.0], [0.0, 287.0, 120.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    pictures = []
    for n in range(9):
        turn = tools.look([0, 0, 0], yaw=0.03 * (n - 4), pitch=0.01 * n)[:3, :3]
        moved = cv2.warpPerspective(picture, lens @ turn @ np.linalg.inv(lens), (320, 240), flags=cv2.INTER_CUBIC)
        pictures.append((moved + rng.normal(0.0, 2.0, moved.shape))[36:204, 48:272])
    message, _, warnings = refused(tools, tmp_path, clip(tmp_path, pictures))
    assert message == "The camera only turns on the spot, so depth cannot be estimated." and warnings == []


def test_a_range_that_is_too_short(tools, sitting):
    message, hint, warnings = refusal(sitting, tools.recorder())
    assert message.startswith("The range of 8 frames (0.7 s) is too short: ")
    assert hint == "Import a longer range, in which the camera moves sideways by a step or more." and warnings == []


def test_shake(tmp_path, tools):
    """The camera shakes after the first frames. The job has one progress bar, and its log COLMAP's last words."""
    poses, noise = tools.handheld(11), np.random.default_rng(1)
    pictures = [tools.room().render(pose, (300.0, 300.0, 160.0, 120.0)).astype(np.float64) for pose in poses]
    for n in range(5, 11):
        wide = min(41, 14 * (n - 4))  # increases gradually, because a sudden change would be detected as a cut
        pictures[n] = uniform_filter1d(uniform_filter1d(pictures[n], wide, axis=1), wide, axis=0)
    source = clip(tmp_path, [picture + noise.normal(0.0, 0.5, picture.shape) for picture in pictures])
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, source, FootageConfig(step=1, fps=8.0), tools.recorder())
    folder = new_job(shot, "solve", SolveParams(retry=False))
    assert run_job(folder)[0] == ExitCode.SOLVE
    status, log = read_json(folder / "status.json"), (folder / "log.txt").read_text()
    assert status["message"].startswith("Cameras were found for only 6 of 11 frames")
    assert status["message"].endswith("; 5 of the other 5 are smeared by shake or fast motion.")
    assert "without fast pans or blur" in status["hint"] and "Tried" not in status["hint"]
    assert status["message"] in log and "colmap.log:" in log and "Registering image" in log
    assert "Traceback" not in log
    events = [json.loads(line) for line in (folder / EVENTS_FILE).read_text().splitlines()]
    progress = [event["data"] for event in events if event["type"] == "progress"]
    shares = [data["done"] / data["total"] for data in progress]
    assert {data["stage"] for data in progress} == {"solve"} and shares == sorted(shares)
