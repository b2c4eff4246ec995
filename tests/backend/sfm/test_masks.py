"""Masks in a solve: excluded features, undistorted masks, and motion at their borders."""

import shutil

import cv2
import numpy as np
import pytest

from torch_backend.contract import CameraPath, JobError, read_json
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import read_png, write_png
from torch_backend.footage.masks import Mask
from torch_backend.motion.mattes import MOVING, STILL, UNKNOWN
from torch_backend.replacing import replacing_solve
from torch_backend.sfm.masks import (
    IGNORE,
    PEOPLE,
    limited,
    load_mask,
    masks_key,
    painted_over,
    recorded_masks,
    write_matching,
)
from torch_backend.sfm.solving import SolveConfig, _matching, solve_shot
from torch_backend.shot import Shot

COUNT, FEATURES = 9, 1000


def board(n):
    """bool [240, 320]: a board that moves across the picture."""
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    return (abs(x - (115 + 9 * n)) < 105) & (abs(y - (110 + 2 * n)) < 92)


@pytest.fixture(scope="module")
def masked(tmp_path_factory, tools):
    """The room with a patterned board in front that covers half of the picture; the solve has a mask of the board."""
    folder = tmp_path_factory.mktemp("masked")
    poses = tools.handheld(COUNT)
    (folder / "clip").mkdir()
    clip = tools.write_clip(folder / "clip", poses)
    pattern = np.random.default_rng(5).integers(0, 256, (80, 107, 3), np.uint8)
    pattern = cv2.resize(pattern, (320, 240), interpolation=cv2.INTER_CUBIC)
    (folder / "mask").mkdir()
    for n in range(COUNT):
        file, on = clip / f"f.{101 + n}.png", board(n)
        write_png(file, np.where(on[..., None], np.roll(pattern, (2 * n, 9 * n), axis=(0, 1)), read_png(file)))
        write_png(folder / "mask" / f"m.{101 + n}.png", np.where(on[..., None], np.uint8(255), np.uint8([0, 0, 0])))
    shot, report = Shot.create(folder / "room.splannequin"), tools.recorder()
    import_footage(shot, str(clip), FootageConfig(step=1), report)
    solve_shot(shot, config(folder / "mask"), report)
    return shot, poses, folder / "mask"


def config(mask):
    return SolveConfig(features=FEATURES, people_mask=str(mask))


def test_the_camera_is_solved_from_what_is_not_masked(masked):
    shot, poses, _ = masked
    record = read_json(shot.solve_record)
    assert record["registered"] == COUNT
    assert record["focal_px"] == pytest.approx(300.0, rel=0.02)  # 983 without the mask
    found = CameraPath.from_json(read_json(shot.cameras)).frames
    turns = [np.reshape(f.viewmat, (4, 4))[:3, :3] for f in found]
    for a, b, true_a, true_b in zip(turns, turns[1:], poses, poses[1:]):
        between = (b @ a.T) @ (true_b[:3, :3] @ true_a[:3, :3].T).T
        assert np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))) < 0.2


def test_the_mask_lies_over_the_undistorted_frames_as_over_the_filmed_ones(masked):
    """The mask ends at the board's outline. With another undistortion map, it would not."""
    shot, *_ = masked
    lens = read_json(shot.solve_record)["lenses"][0]["params"]
    focal, cx, cy, k = lens[0], *lens[1:4]
    for n in (0, 4, 8):
        camera = CameraPath.from_json(read_json(shot.cameras)).frames[n].K
        x, y = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
        u, v = (x - camera[2]) / camera[0], (y - camera[3]) / camera[1]
        bend = 1.0 + k * (u * u + v * v)
        columns, rows = np.floor(u * bend * focal + cx), np.floor(v * bend * focal + cy)
        wanted = board(n)[rows.astype(int).clip(0, 239), columns.astype(int).clip(0, 319)]
        found = load_mask(shot, PEOPLE, 101 + n)
        assert (found != wanted).mean() < 0.002 and wanted.mean() > 0.2
        assert load_mask(shot, IGNORE, 101 + n) is None


def test_solve_key_depends_on_mask_content_not_path(masked, tmp_path, tools):
    shot, _, mask = masked
    copy = Shot(shutil.copytree(shot.root, tmp_path / "copy.splannequin"))
    shutil.copytree(mask, tmp_path / "moved")
    report = tools.recorder()
    solve_shot(copy, config(tmp_path / "moved"), report)
    assert not any(stage == "solve: features" for stage, *_ in report.steps)
    for file in (tmp_path / "moved").iterdir():
        write_png(file, np.roll(read_png(file), 12, axis=1))
    again = tools.recorder(cancel_at=("solve: features", 0.0))
    with pytest.raises(tools.cancelled):
        solve_shot(copy, config(tmp_path / "moved"), again)


def test_a_solve_without_masks_leaves_none_behind(masked, tmp_path):
    copy = Shot(shutil.copytree(masked[0].root, tmp_path / "copy.splannequin"))
    assert copy.mask(PEOPLE, 101).is_file()
    with replacing_solve(copy) as staged:
        (staged.solve / "solve.json").write_text("{}")
    assert not copy.mask(PEOPLE, 101).is_file() and recorded_masks(copy) == {} and masks_key(copy) == []


def test_missing_mask_is_named(masked, tmp_path):
    copy = Shot(shutil.copytree(masked[0].root, tmp_path / "copy.splannequin"))
    copy.mask(PEOPLE, 104).unlink()
    with pytest.raises(JobError, match=r"000104\.png is damaged or missing"):
        load_mask(copy, PEOPLE, 104)


def test_masks_let_nothing_move_that_is_ignored_or_not_people():
    labels = np.array([[MOVING, MOVING, UNKNOWN, MOVING]], np.uint8)
    limited(labels, np.array([[True, False, False, False]]), np.array([[True, True, False, False]]))
    assert labels.tolist() == [[STILL, MOVING, STILL, STILL]]


def test_nothing_is_matched_a_little_around_a_mask(tmp_path):
    covered = np.zeros((480, 640), bool)
    covered[100:200, 300:400] = True
    mask = Mask("ignore", (640, 480))
    mask.add(7, covered)
    write_matching({"ignore": mask}, {7: "000007.png"}, tmp_path / "masks")
    written = cv2.imread(str(tmp_path / "masks" / "000007.png.png"), cv2.IMREAD_GRAYSCALE)
    assert (written[97:203, 340] == 0).all() and (written[[96, 203], 340] == 255).all()


def test_frames_that_are_largely_masked_are_matched_with_more_than_their_neighbours(tmp_path):
    def features_for(share):
        covered = np.zeros((48, 64), bool)
        covered[:, : round(64 * share)] = True
        mask = Mask("people", (64, 48))
        for frame in (1, 2):
            mask.add(frame, covered)
        mask.share = share
        frames = {"frames": [{"frame": n, "file": f"00000{n}.png"} for n in (1, 2)]}
        return _matching(frames, SolveConfig(), {"people": mask}, tmp_path / f"{share}")

    assert "wide" not in features_for(0.2) and features_for(0.5)["wide"] is True
    assert features_for(0.5)["features"] == 2 * SolveConfig().features


def test_a_logo_is_painted_over_before_flow_looks_and_nothing_moves_at_its_rim():
    plain = np.full((240, 320, 3), 90, np.uint8)
    logo = np.zeros((240, 320), bool)
    logo[100:140, 200:260] = True
    burnt = np.where(logo[..., None], np.uint8(255), plain)
    burnt[99:141, 199:261] |= 32  # soft edge of the logo
    assert np.abs(painted_over(burnt, logo).astype(int) - plain).max() < 8
    labels = np.full((240, 320), MOVING, np.uint8)
    limited(labels, logo, None)
    assert (labels[97:143, 230] == STILL).all() and (labels[[94, 145], 230] == MOVING).all()
