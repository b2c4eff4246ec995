"""Motion mattes of small worlds with exact cameras: a textured wall, and a static or moving board in front."""

import functools
import itertools
import json
import os
import shutil
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from torch_backend.contract import CameraFrame, CameraPath, Cancelled, JobError
from torch_backend.footage.images import is_whole_png, read_png, write_png
from torch_backend.motion.mattes import (
    MOVING,
    PAINTED,
    STILL,
    UNKNOWN,
    is_found,
    is_outdated,
    load_motion,
    load_surface,
    motion_key,
)
from torch_backend.motion.moving import Clip
from torch_backend.motion.surface import PER_KEY
from torch_backend.motion_search import find_motion, motion_after_solve
from torch_backend.shot import Shot, write_json

WIDTH, HEIGHT, FRAMES, FIRST = 192, 144, 10, 1001
FOCAL, WALL, BOARD = 180.0, 4.0, 3.0
NUMBERS = [FIRST + 3 * n for n in range(FRAMES)]


@functools.cache
def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((900, 1200)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3) + cv2.GaussianBlur(noise, (0, 0), 8)
    return (255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


def still(n: float) -> tuple[float, float]:
    return 0.0, 0.0


def up_and_down(share: float) -> tuple[float, float]:
    return 0.0, 0.08 * np.sin(7 * share)


def build(
    root, where=still, travel=0.8, sway=1.0, wall: np.ndarray | None = None, numbers=NUMBERS, fps=10
) -> tuple[Shot, np.ndarray]:
    """(solved shot, board mask bool [F, H, W]); `where(share)` is the board's position in world units at a time."""
    shot = Shot.create(root / "world.splannequin")
    wall, board = texture(1) if wall is None else wall, texture(2)
    y, x = np.mgrid[0.5:HEIGHT, 0.5:WIDTH].astype(np.float32)
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL], -1)
    cameras, rows, masks = [], [], []
    for n, number in enumerate(numbers):
        share = n / (len(numbers) - 1)
        centre = travel * np.array([share - 0.5, 0.2 * sway * np.sin(5 * share), 0.3 * sway * share])
        plate = look(wall, rays * (WALL - centre[2]) + centre[:2])
        at = rays * (BOARD - centre[2]) + centre[:2] - where(share)
        inside = (np.abs(at) < 0.32).all(-1)
        masks.append(inside)
        pixels = np.where(inside, look(board, at), plate)
        write_png(shot.frames / f"{number:06d}.png", np.repeat(pixels[..., None], 3, -1))
        viewmat = np.eye(4)
        viewmat[:3, 3] = -centre
        cameras.append(
            CameraFrame(number, viewmat.ravel().tolist(), [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], "registered")
        )
        rows.append({"frame": number, "seconds": n / fps, "file": f"raw/{number:06d}.png", "solve": True})
    write_json(shot.frames / "frames.json", {"version": 1, "width": WIDTH, "height": HEIGHT, "frames": rows})
    write_json(shot.solve / "cameras.json", CameraPath(WIDTH, HEIGHT, cameras).to_json())
    points = np.random.default_rng(0).uniform([-1, -0.7, WALL], [1, 0.7, WALL], (200, 3)).astype(np.float32)
    np.savez(
        shot.solve / "points.npz",
        xyz=points,
        rgb=np.zeros((200, 3), np.uint8),
        error=np.zeros(200, np.float32),
        track=np.full(200, 9, np.uint16),
    )
    shot.update(width=WIDTH, height=HEIGHT, first=numbers[0], last=numbers[-1])
    return shot, np.array(masks)


def look(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    place = (at * 170 + [600, 450]).astype(np.float32)
    return cv2.remap(picture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def mattes(shot: Shot, numbers=NUMBERS) -> np.ndarray:
    found = [load_motion(shot, number) for number in numbers]
    assert all(f is not None and f.shape == (HEIGHT, WIDTH) and f.dtype == np.uint8 for f in found)
    return np.array(found)


def stamps(shot: Shot) -> dict[Path, int]:
    return {p: p.stat().st_mtime_ns for p in shot.root.rglob("*") if p.is_file()}


def middle(mask: np.ndarray) -> np.ndarray:
    return np.argwhere(mask).mean(0)


def inner(mask: np.ndarray, by: int = 3) -> np.ndarray:
    """Masks eroded by a margin. `~grown(mask)` keeps the same kind of margin outside the mask."""
    return np.array([cv2.erode(m.astype(np.uint8), np.ones((2 * by + 1,) * 2, np.uint8)) > 0 for m in mask])


def grown(mask: np.ndarray, by: int) -> np.ndarray:
    return ~inner(~mask, by)


@pytest.fixture(scope="module")
def swaying(tmp_path_factory, quiet):
    """The board sways up and down by 0.08 units, which are 5 pixels."""
    shot, board = build(tmp_path_factory.mktemp("sway"), up_and_down)
    return shot, board, find_motion(shot, quiet(), static_model=None)


@pytest.fixture
def shot(swaying, tmp_path):
    return Shot(shutil.copytree(swaying[0].root, tmp_path / "own.splannequin"))


@pytest.fixture(scope="module")
def static(tmp_path_factory, quiet):
    shot, board = build(tmp_path_factory.mktemp("static"))
    return shot, board, find_motion(shot, quiet(), static_model=None)


def of_new_pictures(shot: Shot, root: Path) -> Shot:
    """Copy of a shot without its mattes, for a test that changes its frames."""
    return Shot(shutil.copytree(shot.root, root / "own.splannequin", ignore=shutil.ignore_patterns("motion")))


def test_what_moves_is_found_and_the_wall_is_still(swaying):
    shot, board, result = swaying
    labels = mattes(shot)
    assert set(np.unique(labels)) <= {STILL, UNKNOWN, MOVING}
    assert (labels[inner(board)] == MOVING).mean() > 0.95
    assert (labels[~grown(board, 8)] == MOVING).mean() < 0.01
    assert (labels == UNKNOWN).mean() < 0.1
    assert result["motion_pixels_share"] == pytest.approx((labels == MOVING).mean(), abs=1e-3)
    assert result["unknown_share"] == pytest.approx((labels == UNKNOWN).mean(), abs=1e-3)


BARE = (128 + np.random.default_rng(3).normal(0, 1, (900, 1200))).astype(np.uint8)


@pytest.mark.parametrize(
    ("world", "found", "margin", "mistaken"),
    [
        # Camera and board move only sideways, so every match lies on its epipolar line.
        (dict(where=lambda share: (0.1 * np.sin(7 * share), 0.0), sway=0.0), 0.9, 8, 0.01),
        # A slow sway: between neighbouring frames the motion is below the noise of optical flow.
        (
            dict(where=lambda share: (0.004 * np.sin(4 * share), 0.008 * np.sin(6 * share)), numbers=[*range(1, 21)]),
            0.8, 8, 0.01,
        ),
        # Optical flow is smooth: on a bare wall it copies the motion of the object in front.
        (dict(where=up_and_down, wall=BARE), 0.7, 10, 0.02),
        (dict(where=up_and_down, travel=0.0), 0.95, 8, 0.01),
    ],
    ids=["along epipolar lines", "half a pixel", "before a bare wall", "tripod"],
)  # fmt: skip
def test_motion_is_found(tmp_path, quiet, world, found, margin, mistaken):
    shot, board = build(tmp_path, **world)
    find_motion(shot, quiet(), static_model=None)
    labels = mattes(shot, world.get("numbers", NUMBERS))
    assert (labels[inner(board)] == MOVING).mean() > found
    assert (labels[~grown(board, margin)] == MOVING).mean() < mistaken
    assert (len(load_surface(shot).xyz) > 0) == (world.get("travel") != 0.0), "a tripod shows no depth"


def test_a_still_world_is_still(static):
    result = static[2]
    assert result["motion_pixels_share"] < 0.01 and result["unknown_share"] < 0.05


def test_a_guessed_pose_and_a_picture_lost_in_blur_do_not_move(static, quiet, tmp_path):
    """The guessed pose moves a whole frame by some pixels. One frame of a fast pan differs from its neighbours."""
    shot = of_new_pictures(static[0], tmp_path)
    path = CameraPath.load(shot.cameras)
    path.frames[3].source = "interpolated"
    path.frames[3].viewmat[7] += 0.08
    write_json(shot.cameras, path.to_json())
    plate = shot.plate(NUMBERS[7])
    write_png(plate, cv2.blur(read_png(plate), (13, 1)))
    assert find_motion(shot, quiet(), static_model=None)["motion_pixels_share"] < 0.01


def test_frames_between_keys_have_a_matte_too(tmp_path, quiet):
    """At 40 frames per second every second frame of such a short clip is a key; flow carries mattes to the others."""
    numbers = list(range(1, 33))
    shot, board = build(tmp_path, lambda share: (0.0, 0.15 * np.sin(14 * share)), travel=2.4, numbers=numbers, fps=40)
    assert Clip(shot).keys == [*range(0, 32, 2), 31]
    find_motion(shot, quiet(), static_model=None)
    labels = mattes(shot, numbers) == MOVING
    between = range(7, 25, 2)  # while the board is in the picture
    assert min(labels[n][inner(board)[n]].mean() for n in between) > 0.7
    # The key's unmoved matte would be 7 pixels away.
    assert np.mean([np.linalg.norm(middle(labels[n]) - middle(board[n])) for n in between]) < 3.0


def test_existing_mattes_are_kept(swaying, quiet):
    shot, _, result = swaying
    before = stamps(shot)
    assert find_motion(shot, quiet(), static_model=None) == result
    assert stamps(shot) == before


def test_what_neither_a_static_model_nor_most_frames_show_moves_where_the_masks_allow_it(static, quiet, tmp_path):
    """A patch of the wall differs in one frame, and optical flow sees no motion. The right half is ignored."""
    shot = of_new_pictures(static[0], tmp_path)
    plain = {number: read_png(shot.plate(number)) for number in NUMBERS}
    pixels = plain[NUMBERS[6]].copy()
    pixels[10:30, 20:60] = 255 - pixels[10:30, 20:60]
    write_png(shot.plate(NUMBERS[6]), pixels)
    columns = np.arange(WIDTH)[None].repeat(HEIGHT, 0)
    for kind, covered in (("ignore", columns >= WIDTH // 2), ("people", columns < 50)):
        for number in NUMBERS:
            path = shot.mask(kind, number)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(cv2.imencode(".png", 255 * covered.astype(np.uint8))[1].tobytes())
    write_json(shot.solve_record, {"version": 1, "masks": {"ignore": {"key": "half"}, "people": {"key": "left"}}})
    find_motion(shot, quiet(), static_model=lambda shot, report: plain.get)
    labels = mattes(shot)
    assert (labels[6][14:26, 24:46] == MOVING).mean() > 0.5, "where its greys differ by enough"
    assert (np.delete(labels, 6, axis=0) == MOVING).mean() < 0.01 and (labels[:, :, 50:] == STILL).all()
    found = load_surface(shot)
    x = np.concatenate([seen_at(shot, n, found.xyz[found.frames == n])[:, 0] for n in NUMBERS])
    assert len(x) > 1500 and (x <= WIDTH // 2 + 2).all()


def test_damaged_files_are_reported_and_found_again(swaying, shot, quiet):
    before = {path: path.read_bytes() for path in sorted(shot.motion.iterdir())}
    matte, points = shot.matte(NUMBERS[3]), shot.surface(NUMBERS[4])
    for path in (matte, points):
        path.write_bytes(before[path][: len(before[path]) // 2])
    with pytest.raises(JobError, match=rf"{NUMBERS[3]:06d}\.png is damaged"):
        load_motion(shot, NUMBERS[3])
    left, whole = load_surface(shot), load_surface(swaying[0])
    assert (left.xyz == whole.xyz[whole.frames != NUMBERS[4]]).all(), "a damaged file is done without"
    assert find_motion(shot, quiet(), static_model=None) == swaying[2]
    assert {path: path.read_bytes() for path in sorted(shot.motion.iterdir())} == before


def test_of_an_older_version_or_solve_only_paint_is_read(shot, quiet):
    """A training that found outdated mattes and was then paused must not continue without any."""
    key, file = motion_key(shot), shot.motion / "motion.json"
    record = json.loads(file.read_text())
    write_json(file, {**record, "version": record["version"] - 1})
    assert is_outdated(shot) and not is_found(shot)
    write_json(file, record)
    path = CameraPath.load(shot.cameras)
    path.frames[0].K[0] += 1.0
    write_json(shot.cameras, path.to_json())
    assert is_outdated(shot) and load_motion(shot, NUMBERS[1]) is None and motion_key(shot) != key
    assert not len(load_surface(shot).xyz)
    paint(shot, np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.raises(Cancelled):
        find_motion(shot, quiet(cancel_at=("solve: motion", 0.3)), static_model=None)
    assert is_outdated(shot) and load_motion(shot, NUMBERS[1]) is None, "not all mattes are of these cameras"
    assert (load_motion(shot, NUMBERS[0]) == MOVING).all(), "what is painted"
    find_motion(shot, quiet(), static_model=None)
    assert is_found(shot) and not is_outdated(shot) and set(load_surface(shot).frames) == set(NUMBERS)
    assert (load_motion(shot, NUMBERS[0]) == MOVING).all() and (load_motion(shot, NUMBERS[1]) == STILL).any()


def test_a_stopped_search_goes_on_where_it_was_without_a_model_if_none_can_be_learnt(swaying, shot, quiet):
    """Files written before the stop stay; the later ones equal those of an undisturbed search."""

    def refuse(shot, report):
        raise JobError("The camera hardly moves.", "Walk.")

    report = quiet()
    find_motion(shot, report, static_model=refuse)
    assert not report.events, "mattes that are there need no model"
    shutil.rmtree(shot.motion)
    with pytest.raises(Cancelled):
        find_motion(shot, quiet(cancel_at=("solve: motion", 0.5)), static_model=None)
    left = sorted((shot.solve / "motion").glob("0*.png"))
    assert 5 <= len(left) < FRAMES and all(is_whole_png(p) for p in left)
    assert load_motion(shot, NUMBERS[0]) is None
    before = {p: p.stat().st_mtime_ns for p in left}
    report = quiet()
    assert find_motion(shot, report, static_model=refuse) == swaying[2]
    assert [event[1:] for event in report.events if event[0] == "warning"] == [
        ("Motion is found by optical flow only: The camera hardly moves.", "Walk.")
    ]
    assert {p: p.stat().st_mtime_ns for p in left} == before
    assert [event[2] for event in report.events if event[0] == "progress"] == list(range(len(left) + 1, FRAMES + 1))
    assert (mattes(shot) == mattes(swaying[0])).all()
    names = [f"{n:06d}{suffix}" for n in NUMBERS for suffix in (".png", ".npz")]  # with so few frames, each is a key
    assert {p.name for p in (shot.solve / "motion").iterdir()} == {"motion.json", *names}
    first, second = load_surface(shot), load_surface(swaying[0])
    assert (first.xyz == second.xyz).all() and (first.frames == second.frames).all()


def test_missing_cameras_are_reported(tmp_path, quiet):
    shot = Shot.create(tmp_path / "empty.splannequin")
    with pytest.raises(JobError, match="has no cameras yet"):
        find_motion(shot, quiet(), static_model=None)
    assert load_motion(shot, 1) is None


# ------------------------------------------------------------------------------------------- points of static surfaces


def seen_at(shot: Shot, number: int, xyz: np.ndarray) -> np.ndarray:
    """[S, 2] int64: pixels (x, y) of points in a frame."""
    camera = next(c for c in CameraPath.load(shot.solve / "cameras.json").frames if c.frame == number)
    local = xyz - -np.array(camera.viewmat).reshape(4, 4)[:3, 3]
    return np.floor(FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]).astype(int)


def test_points_of_a_still_world_lie_on_its_surfaces_and_cover_them(static):
    shot, board, _ = static
    found = load_surface(shot)
    assert set(found.frames) == set(NUMBERS) and found.rgb.dtype == np.uint8
    for n in (2, 5, 8):
        of = found.frames == NUMBERS[n]
        xyz = found.xyz[of]
        x, y = seen_at(shot, NUMBERS[n], xyz).T
        assert 500 < len(xyz) <= PER_KEY and ((x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)).all()
        near, far = inner(board)[n][y, x], ~grown(board, 4)[n][y, x]
        assert near.sum() > 30 and far.sum() > 300
        assert np.median(np.abs(xyz[near, 2] - BOARD)) < 0.03 and np.median(np.abs(xyz[far, 2] - WALL)) < 0.04
        assert np.quantile(np.abs(xyz[far, 2] - WALL), 0.95) < 0.2
        tiles = np.unique(np.stack([x // 24, y // 24]), axis=1).shape[1]
        assert tiles > 0.7 * (WIDTH // 24) * (HEIGHT // 24)
        plate = read_png(shot.plate(NUMBERS[n]))[y, x].astype(int)
        assert np.abs(plate - found.rgb[of]).mean() < 8


def test_what_moves_gives_no_points(swaying):
    """By chance, a static point in empty space can explain the matches of a moving object."""
    shot, board, _ = swaying
    found = load_surface(shot)
    for n in range(2, 8):
        x, y = seen_at(shot, NUMBERS[n], found.xyz[found.frames == NUMBERS[n]]).T
        assert len(x) > 500 and inner(board)[n][y, x].mean() < 0.01


def test_a_shot_solved_before_points_were_kept_has_them_when_it_is_solved_again(swaying, shot, quiet):
    for file in shot.motion.glob("*.npz"):
        file.unlink()
    key, pictures = motion_key(shot), {p: p.read_bytes() for p in shot.motion.glob("*.png")}
    assert find_motion(shot, quiet(), static_model=None) == swaying[2] and not len(
        load_surface(shot).xyz
    )  # a freeze requests no points
    assert find_motion(shot, quiet(), with_points=True, static_model=None) == swaying[2]
    assert (load_surface(shot).xyz == load_surface(swaying[0]).xyz).all()
    assert motion_key(shot) == key and {p: p.read_bytes() for p in shot.motion.glob("*.png")} == pictures
    before = stamps(shot)
    find_motion(shot, quiet(), with_points=True, static_model=None)
    assert stamps(shot) == before


# ------------------------------------------------------------------------------------------------- painted mattes


def paint(shot: Shot, pixels: np.ndarray, number: int = NUMBERS[0]) -> None:
    path = shot.root / PAINTED / f"{number:06d}.png"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def ramp(dtype) -> np.ndarray:
    """Three bands of grey: still, unknown, moving."""
    top = np.iinfo(dtype).max
    return np.repeat(np.array([0.32, 0.5, 0.68]) * top, WIDTH // 3).astype(dtype)[None].repeat(HEIGHT, 0)


def test_paint_of_any_depth_goes_before_what_was_found(shot):
    key = motion_key(shot)
    for dtype, channels in itertools.product((np.uint8, np.uint16), (1, 3, 4)):
        pixels = ramp(dtype)
        if channels > 1:
            pixels = np.repeat(pixels[..., None], channels, -1)
            if channels == 4:
                pixels[..., 3] = np.iinfo(dtype).max
        paint(shot, pixels)
        labels = load_motion(shot, NUMBERS[0])
        assert labels is not None and motion_key(shot) != key
        assert (labels == np.repeat(np.array([STILL, UNKNOWN, MOVING], np.uint8), WIDTH // 3)[None]).all()


def test_paint_of_another_size_is_fitted_without_in_between_values(shot):
    pixels = np.zeros((190, 251), np.uint8)
    pixels[:, 125:] = 255
    paint(shot, pixels)
    labels = load_motion(shot, NUMBERS[0])
    assert labels is not None and labels.shape == (HEIGHT, WIDTH)
    edge = int(125 * WIDTH / 251)
    assert (labels[:, :edge] == STILL).all() and (labels[:, edge + 1 :] == MOVING).all()
    assert set(np.unique(labels)) == {STILL, MOVING}


def test_where_paint_is_transparent_the_found_matte_shows(shot):
    found = load_motion(shot, NUMBERS[0])
    pixels = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    pixels[:, 60:, 3] = 120
    paint(shot, pixels)
    labels = load_motion(shot, NUMBERS[0])
    assert labels is not None and found is not None
    assert (labels[:, :60] == MOVING).all() and (labels[:, 60:] == found[:, 60:]).all()


def test_damaged_paint_is_named(shot):
    (shot.root / PAINTED).mkdir()
    (shot.root / PAINTED / f"{NUMBERS[0]:06d}.png").write_bytes(b"\x89PNG\r\n\x1a\nnot more")
    with pytest.raises(JobError, match=r"painted motion matte .*001001\.png is damaged"):
        load_motion(shot, NUMBERS[0])


def test_oversized_paint_is_refused_before_decoding(shot):
    paint(shot, np.full((HEIGHT, WIDTH), 255, np.uint8))
    file = shot.painted_matte(NUMBERS[0])
    content = bytearray(file.read_bytes())
    content[16:24] = struct.pack(">II", 16000, 16000)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    file.write_bytes(content)
    with pytest.raises(JobError, match=r"001001\.png is 16000 x 16000 pixels according to its header"):
        load_motion(shot, NUMBERS[0])


# --------------------------------------------------------------------------------------------------- in one process


def test_opencv_coexists_with_other_image_readers(tmp_path):
    """Each library brings its own zlib, libpng or FFmpeg. These tests import OpenCV first, this process last."""
    clip = Path(__file__).resolve().parents[3] / "examples" / "sitting.mp4"
    code = f"""
import OpenImageIO, av, cv2, numpy as np
from torch_backend.footage.images import read_png, write_png
with av.open({str(clip)!r}) as video:
    frames = [f.to_ndarray(format="rgb24") for f, _ in zip(video.decode(video=0), range(3))]
dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
for turn in range(3):
    for n, frame in enumerate(frames):
        write_png({str(tmp_path)!r} + f"/{{n}}.png", frame)
        packed = cv2.imencode(".png", frame[..., ::-1])[1]
        assert (cv2.imdecode(packed, cv2.IMREAD_COLOR)[..., ::-1] == read_png({str(tmp_path)!r} + f"/{{n}}.png")).all()
    dis.calc(frames[0][..., 0].copy(), frames[1][..., 0].copy(), None)
print("whole")
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    ran = subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stdout.strip()) == (0, "whole"), ran.stderr[-2000:]


def test_cameras_by_which_everything_moves_are_doubted(static, tmp_path, quiet):
    shot = Shot(shutil.copytree(static[0].root, tmp_path / "own.splannequin"))
    good, bad = quiet(), quiet()
    motion_after_solve(shot, good, static_model=None)
    assert not [event for event in good.events if event[0] == "warning"]
    # The cameras hardly move, as in a solve without depth, so both the wall and the board in front seem to move.
    cameras = json.loads((shot.solve / "cameras.json").read_text())
    for n, frame in enumerate(cameras["frames"]):
        frame["viewmat"][3] *= 0.3
        frame["viewmat"][7] = 0.05 * (-1) ** n
    write_json(shot.solve / "cameras.json", cameras)
    found = motion_after_solve(shot, bad, static_model=None)
    assert found is not None and found["motion_pixels_share"] > 0.2
    (warning,) = [event for event in bad.events if event[0] == "warning"]
    assert "the cameras are wrong" in warning[1]
