"""The whole solve with COLMAP on a rendered room, compared with the cameras that rendered it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.backend.solved_room import solve_all
from torch_backend.cameras.floor import floor_of
from torch_backend.cameras.poses import camera_centre
from torch_backend.cameras.stored import load_points
from torch_backend.contract import CameraPath, Cancelled, ExitCode, JobError, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import read_png
from torch_backend.lens.lens_verdict import lens_remarks
from torch_backend.motion.mattes import load_motion
from torch_backend.sfm import child
from torch_backend.sfm.child import run_worker
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.sfm.verdict import fault_of, quality_words
from torch_backend.shot import Shot, write_json

ROOT = Path(__file__).resolve().parents[3]


def cameras(shot):
    return CameraPath.load(shot.solve / "cameras.json")


def align(viewmats, truths):
    """(scale, rotation, translation) from the solve's world to the true one; the rotation uses all orientations."""
    u, _, vt = np.linalg.svd(sum(true[:3, :3].T @ got[:3, :3] for got, true in zip(viewmats, truths)))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    source, target = (np.array([camera_centre(v) for v in group]) for group in (viewmats, truths))
    turned = (source - source.mean(0)) @ rotation.T
    scale = ((target - target.mean(0)) * turned).sum() / (turned**2).sum()
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def test_every_frame_has_a_camera_and_a_picture(solved):
    path = cameras(solved.shot)
    assert [f.frame for f in path.frames] == list(range(101, 116))
    assert (path.width, path.height) == (320, 240)
    sources = [f.source for f in path.frames]
    assert sources[0::2] == ["registered"] * 8
    assert sources[1::2] == ["localised"] * 7
    assert all(read_png(solved.shot.frames / f"{f.frame:06d}.png").shape == (240, 320, 3) for f in path.frames)


def test_cameras_are_those_it_was_rendered_from(solved):
    path = cameras(solved.shot)
    viewmats = np.array([np.reshape(f.viewmat, (4, 4)) for f in path.frames])
    scale, rotation, shift = align(viewmats, solved.poses)
    centres = scale * np.array([camera_centre(v) for v in viewmats]) @ rotation.T + shift
    # The camera path is 1.5 long.
    assert np.abs(centres - [camera_centre(v) for v in solved.poses]).max() < 0.01
    for viewmat, true in zip(viewmats, solved.poses):
        between = viewmat[:3, :3] @ rotation.T @ true[:3, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))) < 0.2


def test_the_lens_is_found(solved):
    record = read_json(solved.shot.solve / "solve.json")
    assert record["focal_px"] == pytest.approx(300.0, rel=0.01)
    assert record["distortion"] == [pytest.approx(-0.06, abs=0.01)]
    assert record["camera_model"] == "SIMPLE_RADIAL"


def test_undistorted_frames_are_what_a_pinhole_sees(solved, tools):
    def rms(a, b):
        return np.sqrt(((a.astype(float) - b) ** 2).mean())

    path = cameras(solved.shot)
    # On a sideways path, focal length and depth are slightly ambiguous; frames show the lens that rendered them.
    bias = 300.0 / read_json(solved.shot.solve / "solve.json")["focal_px"]
    for i in (0, 7, 14):
        fx, fy, cx, cy = np.array(path.frames[i].K) * [bias, bias, 1.0, 1.0]
        ideal = tools.room().render(solved.poses[i], (fx, fy, cx, cy))
        half_a_pixel = rms(tools.room().render(solved.poses[i], (fx, fy, cx + 0.5, cy)), ideal)
        assert rms(read_png(solved.shot.frames / f"{path.frames[i].frame:06d}.png"), ideal) < half_a_pixel
        assert rms(read_png(solved.shot.frames / f"raw/{path.frames[i].frame:06d}.png"), ideal) > half_a_pixel


def test_points_lie_on_the_walls(solved):
    path, points = cameras(solved.shot), load_points(solved.shot)
    scale, rotation, shift = align([np.reshape(f.viewmat, (4, 4)) for f in path.frames], solved.poses)
    xyz = scale * points["xyz"] @ rotation.T + shift
    walls = np.minimum(np.abs(xyz - [-2.0, -1.5, -1.0]), np.abs(xyz - [2.0, 1.5, 5.0])).min(1)
    block = np.minimum(np.abs(xyz - [-0.9, 0.1, 1.8]), np.abs(xyz - [0.1, 1.5, 2.8])).min(1)
    assert len(xyz) > 300
    assert np.median(np.minimum(walls, block)) < 0.03
    assert (points["error"] < 2).all() and (points["track"] >= 3).all()
    kinds = {name: str(points[name].dtype) for name in points}
    assert kinds == {"xyz": "float32", "rgb": "uint8", "error": "float32", "track": "uint16"}


def test_solve_json_says_how_good_it_is(solved):
    record = read_json(solved.shot.solve / "solve.json")
    assert (record["registered"], record["solved_frames"], record["total_frames"]) == (8, 8, 15)
    assert record["reprojection_error_px"] < 1.0
    assert record["quality"] == f"Good: 8 of 8 frames registered, {record['reprojection_error_px']:.2f} px."
    assert record["points"] == len(load_points(solved.shot)["xyz"])
    assert record["warnings"] == []
    shares = {"motion_pixels_share", "unknown_share"}
    assert {name: value for name, value in solved.result.items() if name not in shares} == record["result"]
    path = CameraPath.load(solved.shot.solve / "cameras.json")
    assert record["floor"] == floor_of(path, load_points(solved.shot)["xyz"])


def test_the_model_is_kept_and_the_scratch_is_not(solved):
    names = {p.name for p in solved.shot.solve.iterdir()}
    assert names == {"cameras.json", "points.npz", "solve.json", "colmap", "colmap.log", "motion"}
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {p.name for p in (solved.shot.solve / "colmap").iterdir()}


def test_progress_names_the_stages_in_order(solved):
    stages = list(dict.fromkeys(stage for stage, _, _ in solved.report.steps))
    assert [s.removeprefix("solve: ") for s in stages] == [
        "import",
        "features",
        "matches",
        "cameras",
        "other features",
        "other matches",
        "undistort",
        "motion",
    ]
    assert all(0 <= done <= total for _, done, total in solved.report.steps)


def test_solved_shot_is_not_solved_again(solved, tools):
    before = {p: p.stat().st_mtime_ns for p in solved.shot.root.rglob("*") if p.is_file()}
    report = tools.recorder()
    assert solve_all(solved.shot, SolveConfig(features=1500), report) == solved.result
    assert {p: p.stat().st_mtime_ns for p in solved.shot.root.rglob("*") if p.is_file()} == before


def test_every_frame_of_a_solve_has_a_motion_matte(solved):
    """This includes frames that the step left out. Nothing moves in the room."""
    path = cameras(solved.shot)
    for camera in path.frames:
        labels = load_motion(solved.shot, camera.frame)
        assert labels is not None and labels.shape == (path.height, path.width)
    assert solved.result["motion_pixels_share"] < 0.01


def test_a_solve_holds_without_its_motion_matte(solved, tools, tmp_path):
    shot = Shot(shutil.copytree(solved.shot.root, tmp_path / "a.splannequin"))
    shutil.rmtree(shot.solve / "motion")
    (shot.solve / "motion").write_bytes(b"in the way")
    report = tools.recorder()
    result = solve_all(shot, SolveConfig(features=1500), report)
    assert "motion_pixels_share" not in result and result["registered"] == 8
    (said,) = report.warnings
    assert said.startswith("Moving areas could not be found: ") and "is not a folder" in said


def test_the_same_frames_give_the_same_cameras(solved, tools, tmp_path):
    """Bit-identical: seeds are fixed, and no sums or matches are computed in two threads. Frames that are not localised
    are interpolated."""
    shot = Shot.create(tmp_path / "again.splannequin")
    import_footage(shot, solved.shot.info().source, FootageConfig(step=2), tools.recorder())
    solve_shot(shot, SolveConfig(features=1500, localise=False), tools.recorder())
    one, second = cameras(solved.shot).frames, cameras(shot).frames
    assert [(f.viewmat, f.K) for f in second[::2]] == [(f.viewmat, f.K) for f in one[::2]]
    assert [f.source for f in second[1::2]] == ["interpolated"] * 7
    assert (shot.solve / "points.npz").read_bytes() == (solved.shot.solve / "points.npz").read_bytes()


def imported(tmp_path, tools, poses, **options):
    shot = Shot.create(tmp_path / "a.splannequin")
    clip = tools.write_clip(tmp_path, poses, **options)
    import_footage(shot, str(clip), FootageConfig(step=1), tools.recorder())
    return shot


def test_frames_that_cannot_be_placed_are_filled_in_and_said(tmp_path, tools):
    poses = [tools.look([0.12 * i - 0.7, 0.02 * i, 0.0], yaw=-0.03 * i) for i in range(14)]
    shot = imported(tmp_path, tools, poses, blurred=(105, 114))
    report = tools.recorder()
    result = solve_shot(shot, SolveConfig(features=1000), report)
    path = cameras(shot)
    sources = {f.frame: f.source for f in path.frames}
    assert [n for n, source in sources.items() if source == "interpolated"] == [105, 114]
    viewmats = {f.frame: np.reshape(f.viewmat, (4, 4)) for f in path.frames}
    centres = {n: camera_centre(v) for n, v in viewmats.items()}
    assert np.allclose(centres[105], (centres[104] + centres[106]) / 2, atol=1e-9)
    assert (viewmats[114] == viewmats[113]).all()
    assert (result["registered"], result["interpolated"]) == (12, 2)
    assert result["quality"].startswith("Fair: 12 of 14 frames registered")
    assert report.warnings == [
        "The mapper did not register 2 solved frames: frames 105, 114.",
        "The camera holds its pose before the first or after the last solved frame: frame 114.",
    ]


def listed(count, step=1):
    """frames.json of frames 1 to `count`, every `step`-th solved."""
    rows = [
        {"frame": n, "solve": (n - 1) % step == 0, "seconds": n / 24, "sharpness": 100.0} for n in range(1, count + 1)
    ]
    return {"step": step, "frames": rows}


def names(*frames):
    return [f"{n:06d}.png" for n in frames]


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        (
            {"triangulation_angle_deg": 1.6},
            "narrow",
            "The camera moves too little for depth: the parallax of half of the points is 1.6 degrees or less.",
        ),
        (
            {"registered": 13, "turning": True, "parts": [names(*range(3, 16))]},
            "turning",
            "The camera only turns on the spot, so depth cannot be estimated.",
        ),
        (
            {"points": 40},
            "bare",
            "Only 40 points of the scene could be placed: the clip is too blurred or has too little texture.",
        ),
        ({"focal_px": 60.0}, "lens", "The solve found an impossible lens: 158.8 degrees wide (60 px)."),
    ],
)
def test_models_that_nothing_could_be_trained_on_are_refused(changes, kind, message):
    good = {"registered": 74, "parts": [names(*range(1, 75))], "triangulation_angle_deg": 12.0, "points": 5000}
    good |= {"reprojection_error_px": 0.8, "focal_px": 500.0, "lens": {"width": 640, "height": 480}}
    assert fault_of({"result": good}, listed(74)) is None
    fault = fault_of({"result": {**good, **changes}}, listed(74))
    assert (fault.kind, fault.error.message, fault.error.exit_code) == (kind, message, ExitCode.SOLVE)


@pytest.mark.parametrize(
    ("step", "parts", "message", "hint"),
    [
        (
            1,
            [names(*range(12, 42))],
            "Cameras were found for only 30 of 74 frames: 12 to 41.",
            "Frames 12 to 41 worked: import that range, or one without fast pans or blur.",
        ),
        (
            1,
            [names(*range(1, 13), *range(20, 35)), names(*range(50, 75)), names(36, 37, 38)],
            "Cameras were found for only 27 of 74 frames: 1 to 12, 20 to 34; 2 parts of the clip do not connect.",
            "Frames 50 to 74 worked: import that range, or one without fast pans or blur.",
        ),
        (
            3,
            [names(*range(13, 38, 3))],
            "Cameras were found for only 9 of 25 frames: 13 to 37.",
            "Frames 13 to 37 worked: import that range, or one without fast pans or blur. A smaller step makes "
            "neighbouring frames overlap more.",
        ),
        (
            1,
            [names(5, 6, 7)],
            "Cameras were found for only 3 of 74 frames.",
            "Choose a range without fast pans or blur.",
        ),
    ],
)
def test_a_poor_solve_says_which_frames_worked_and_only_what_can_help(step, parts, message, hint):
    answer = {"registered": len(parts[0]), "parts": parts, "triangulation_angle_deg": 12.0, "points": 5000}
    error = fault_of({"result": answer}, listed(74, step)).error
    assert (error.message, error.hint, error.exit_code) == (message, hint, ExitCode.SOLVE)


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        ({"doubt": "", "held": False}, []),
        ({"doubt": "narrow", "held": False}, ["is unusual: 10 degrees wide."]),
        ({"doubt": "bent", "held": False}, ["The distortion of the solved lens is unusually strong."]),
        (
            {"doubt": "narrow", "held": True},
            ["(the solve diverged to 3 degrees): a typical lens of 10 degrees is used."],
        ),
    ],
)
def test_a_doubtful_lens_is_said(lens, words):
    answer = {"focal_px": 7526.0, "lens": {**lens, "found_px": 24_000.0, "width": 1280, "height": 720}}
    found = [message for message, _ in lens_remarks(answer)]
    assert len(found) == len(words) and all(a.endswith(b) for a, b in zip(found, words, strict=True))


def test_failed_worker_gives_a_readable_error(tmp_path, tools):
    (tmp_path / "request.json").write_text(json.dumps({"images": str(tmp_path)}))
    with pytest.raises(JobError, match="The camera solve failed") as error:
        run_worker(tmp_path / "request.json", tmp_path / "log.txt", tools.recorder())
    assert error.value.exit_code == ExitCode.SOLVE
    assert "KeyError" in error.value.message


def test_a_worker_that_is_stopped_with_its_job_is_no_failure(tmp_path, tools, monkeypatch):
    """Ctrl-C of a console may reach both processes, so the worker is dead when its parent checks."""
    report, listen = tools.recorder(), child._listen

    def interrupted(*words):
        answer = listen(*words)
        report.cancelled = True
        return answer

    monkeypatch.setattr(child, "_listen", interrupted)
    (tmp_path / "request.json").write_text(json.dumps({"images": str(tmp_path)}))
    with pytest.raises(Cancelled):
        run_worker(tmp_path / "request.json", tmp_path / "log.txt", report)


def test_a_worker_ends_with_its_parent(tmp_path):
    """It loads COLMAP without what collides with it. With two threads a process, OpenBLAS occasionally returns wrong
    products, too rarely for a test."""
    code = """
import sys, time
from torch_backend.sfm.worker import _die_with_parent, detach_standard_input
from torch_backend.sfm.pairs import one_thread
print("pycolmap" in sys.modules, "OpenImageIO" in sys.modules, one_thread().num_threads, flush=True)
_die_with_parent(detach_standard_input())
time.sleep(60)
"""
    command = [sys.executable, "-c", code]
    worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert worker.stdout.readline() == "True False 1\n" and worker.poll() is None
    worker.stdin.close()
    assert worker.wait(timeout=50) == 1
    worker.stdout.close()


def test_solving_before_import_is_refused_readably(tmp_path, tools):
    with pytest.raises(JobError, match="has no frames yet"):
        solve_shot(Shot.create(tmp_path / "a.splannequin"), SolveConfig(), tools.recorder())


@pytest.mark.parametrize("config", [SolveConfig(camera_model="FISHEYE"), SolveConfig(overlap=0)])
def test_settings_that_make_no_sense_name_their_values(tmp_path, tools, config):
    with pytest.raises(ValueError, match=r"FISHEYE|got 0"):
        solve_shot(Shot.create(tmp_path / "a.splannequin"), config, tools.recorder())


@pytest.mark.parametrize(
    ("registered", "error", "expected"),
    [
        (74, 0.8, "Good: 74 of 74 frames registered, 0.80 px."),
        (62, 0.8, "Fair: 62 of 74 frames registered, 0.80 px."),
        (74, 1.5, "Fair: 74 of 74 frames registered, 1.50 px."),
        (40, 0.8, "Poor: 40 of 74 frames registered, 0.80 px."),
    ],
)
def test_quality_in_words(registered, error, expected):
    assert quality_words(registered, 74, error) == expected


def test_the_worker_takes_no_module_from_where_the_request_lies(hostile, tmp_path, tools):
    scratch = tmp_path / "scratch"
    marker = hostile(scratch)
    request = {"images": str(tmp_path / "none"), "solved": [], "others": [], "camera_model": "SIMPLE_RADIAL"}
    request |= {"overlap": 1, "features": 128, "neighbours": 1, "threads": 1}
    write_json(scratch / "request.json", request)
    try:
        result = run_worker(scratch / "request.json", scratch / "log.txt", tools.recorder())
    except JobError as error:
        result = error.message
    assert "COLMAP" in str(result) or "failure" in result, "the worker itself answered"
    assert not marker.exists(), marker.read_text()
