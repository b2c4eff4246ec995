"""A clip with an ST map of its lens is solved undistorted, and a map of another lens is reported."""

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import MASK_FOUND, CameraPath, ExitCode, JobError, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import read_png, write_png
from torch_backend.lens.lens import Lens, load_lens
from torch_backend.lens.lens_verdict import left_px, lens_remarks
from torch_backend.lens.stmap import redistort_map, undistort_map, write_map
from torch_backend.sfm.retries import Attempt, next_strategy
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.sfm.verdict import Fault
from torch_backend.shot import Shot

WIDTH, HEIGHT, COUNT = 320, 240, 8
TRUTH = Lens(WIDTH, HEIGHT, (220.0, 220.0), (220.0, 220.0), (WIDTH / 2, HEIGHT / 2), -0.16)


@pytest.fixture(scope="module")
def clip(tmp_path_factory, tools):
    """(shot, poses, folder of maps): imported clip of a room through a barrel lens."""
    folder, room, poses = tmp_path_factory.mktemp("barrel"), tools.room(), tools.handheld(COUNT)
    rng = np.random.default_rng(2)
    for n, viewmat in enumerate(poses, start=1):
        clean = room.render(viewmat, (220.0, 220.0, WIDTH / 2, HEIGHT / 2), -0.16).astype(float)
        noisy = clean + rng.normal(0.0, 1.0, clean.shape)
        write_png(folder / f"f.{n:03d}.png", np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    write_map(folder / "undistort.exr", undistort_map(TRUTH, WIDTH, HEIGHT))
    write_map(folder / "redistort.exr", redistort_map(TRUTH, WIDTH, HEIGHT))
    logo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    logo[4:30, 4:60] = 255
    shot = Shot.create(folder / "a.splannequin")
    import_footage(shot, str(folder / "f.001.png"), FootageConfig(step=1), tools.recorder())
    write_png(shot.burnt_in, logo)
    return shot, poses, folder


def test_the_clip_is_solved_straight_and_the_map_is_its_lens(clip, tools):
    """Scene points project through the solved cameras and the map's lens to where the real lens showed them.

    Errors stay below a quarter of a pixel, also at the corners. The map also undistorts the import's burnt-in mask.
    """
    shot, poses, folder = clip
    config = SolveConfig(
        features=1000,
        st_map=str(folder / "redistort.exr"),
        st_map_way="redistort",
        ignore_mask=MASK_FOUND,
    )
    report = tools.recorder()
    result = solve_shot(shot, config, report)
    assert result["registered"] == COUNT and not [w for w in report.warnings if "bent" in w]
    record, lens = read_json(shot.solve_record), load_lens(shot)
    assert record["camera_model"] == "ST_MAP" and record["st_map"] == [config.st_map, "redistort", ""]
    scale = 2.0 / sum(lens.slopes_in_the_middle)
    assert result["focal_px"] == pytest.approx(220.0 * scale, rel=0.004)
    frame = read_png(shot.plate(5))
    expected = tools.room().render(
        poses[4], (*(2 * [220.0 * scale]), WIDTH / 2, HEIGHT / 2), 0.0
    )  # the room without lens distortion
    assert np.abs(frame.astype(float) - expected)[8:-8, 8:-8].mean() < 3.0
    assert record["masks"]["ignore"]["source"] == str(shot.burnt_in)
    mask = read_png(shot.mask("ignore", 5))[..., 0] > 127
    assert mask[12, 30] and not mask[60, 100] and 0.5 < mask.sum() / (26 * 56) < 1.3

    # The corners of the camera's view at some depth, in both worlds.
    path = CameraPath.load(shot.solve / "cameras.json")
    solved = np.array([np.reshape(one.viewmat, (4, 4)) for one in path.frames])
    u, v = np.meshgrid([12.0, 160.0, 308.0], [12.0, 120.0, 228.0])
    at = np.stack([u.ravel(), v.ravel()], 1)
    centres = [np.array([-p[:3, :3].T @ p[:3, 3] for p in group]) for group in (solved, np.array(poses))]
    mean = [c.mean(0) for c in centres]
    size = np.linalg.norm(centres[0] - mean[0]) / np.linalg.norm(centres[1] - mean[1])
    for n in (0, 4, 7):
        rays = np.concatenate([(TRUTH.to_plate(at) - TRUTH.centre) / 220.0, np.ones((9, 1))], 1)
        seen = rays * 3.0  # camera axes of frame n, metres
        neighbours = [k for k in (0, 4, 7) if k != n]
        for k in neighbours:
            true = between(poses[n], poses[k], seen)
            mine = between(solved[n], solved[k], seen * size)
            fx, fy, cx, cy = lens.intrinsics
            plate = mine[:, :2] / mine[:, 2:] * [fx, fy] + [cx, cy]
            true_pixels = TRUTH.to_original(true[:, :2] / true[:, 2:] * 220.0 + TRUTH.centre)
            inside = ((true_pixels > 0) & (true_pixels < [WIDTH, HEIGHT])).all(1)
            error = np.hypot(*(lens.to_original(plate) - true_pixels)[inside].T)
            assert error.max() < 0.25

    again = tools.recorder()
    assert solve_shot(shot, config, again)["focal_px"] == result["focal_px"]
    assert again.steps[-1][0] != "solve: undistort", "the same map: nothing is done again"


def between(one, two, points):
    """Map points from the axes of one camera to another's; `one` and `two` are world-to-camera poses."""
    world = (points - one[:3, 3]) @ one[:3, :3]
    return world @ two[:3, :3].T + two[:3, 3]


def test_a_map_the_wrong_way_round_is_noticed(clip, tools, tmp_path):
    shot, _, folder = clip
    report = tools.recorder()
    config = SolveConfig(features=500, st_map=str(folder / "redistort.exr"), retry=False)
    solve_shot(Shot(shot.root), config, report)
    assert [w for w in report.warnings if "The ST map does not straighten the frames: they are still bent by" in w]


def test_imported_cameras_and_a_map_together_are_refused(clip, tools):
    shot, _, folder = clip
    with pytest.raises(JobError, match="already have a lens") as refused:
        solve_shot(shot, SolveConfig(st_map=str(folder / "undistort.exr")), tools.recorder(), cameras=str(folder))
    assert refused.value.exit_code == ExitCode.USAGE
    with pytest.raises(ValueError, match="st_map_way"):
        solve_shot(shot, SolveConfig(st_map="a.exr", st_map_way="both"), tools.recorder())
    with pytest.raises(JobError, match="cannot be read"):
        solve_shot(shot, SolveConfig(st_map=str(folder / "gone.exr")), tools.recorder())


def test_map_is_identified_by_content_not_path(clip, tools):
    """A copy of the file keeps the solve; another direction of the map does not."""
    from torch_backend.sfm.solving import _key  # pyright: ignore[reportPrivateUsage]

    frames = {"key": "k"}
    plain, one = SolveConfig(), SolveConfig(st_map="a.exr")
    assert _key(one, frames, ["x"], {}) == _key(SolveConfig(st_map="b/a.exr"), frames, ["x"], {})
    assert _key(one, frames, ["x"], {}) != _key(SolveConfig(st_map="a.exr", st_map_way="redistort"), frames, ["x"], {})
    assert _key(plain, frames, [], {}) == _key(SolveConfig(st_map_way="redistort"), frames, [], {})


def test_map_lens_disables_lens_retries(tmp_path):
    lens = {"doubt": "bent", "found_bend": -0.4, "found_deg": 140.0, "view_deg": 70.0, "held": True}
    answer = {"result": {"registered": 9, "lens": lens}}
    best = Attempt("first", tmp_path, answer, Fault("bent", JobError("a")), 9)
    request = {"camera_model": "SIMPLE_RADIAL", "features": 800}
    assert next_strategy(best, request, set()) is not None
    assert next_strategy(best, {**request, "hold_bend": True}, set()) is None


def test_what_is_left_of_the_lens_is_measured_at_the_corner():
    lens = {"doubt": "", "held": False, "found_px": 500.0, "width": 640, "height": 480, "left_bend": -0.1}
    answer = {"focal_px": 500.0, "lens": lens}
    assert left_px(answer) == pytest.approx(0.1 * 0.8**3 * 500.0)
    assert "by 25.6 pixels" in lens_remarks(answer)[0][0] and "--st-map-way" in lens_remarks(answer)[0][1]
    assert lens_remarks({**answer, "lens": {**lens, "left_bend": 0.004}}) == []


def test_the_map_of_the_test_is_what_nuke_reads(clip):
    """s increases to the right, t upwards."""
    pixels = oiio.ImageBuf(str(clip[2] / "undistort.exr")).get_pixels(oiio.FLOAT)
    assert pixels[0, 0, 0] < pixels[0, -1, 0] and pixels[0, 0, 1] > pixels[-1, 0, 1]
