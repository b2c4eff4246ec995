"""The motion matte of small worlds with exact cameras: a textured wall, and a board before it that stands or moves."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import cv2
import numpy as np
import pytest

from torch_backend.contract import CameraFrame, CameraPath, Cancelled, JobError
from torch_backend.footage.images import is_whole_png, read_png, write_png
from torch_backend.shot import Shot, write_json
from torch_backend.solve.motion import (
    MOVING,
    PAINTED,
    STILL,
    UNKNOWN,
    find_motion,
    is_found,
    load_motion,
    motion_key,
    write_matte,
)


WIDTH, HEIGHT, FRAMES, FIRST = 192, 144, 14, 1001
FOCAL, WALL, BOARD = 180.0, 4.0, 3.0
NUMBERS = [FIRST + 3 * n for n in range(FRAMES)]


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((900, 1200)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3) + cv2.GaussianBlur(noise, (0, 0), 8)
    return (255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


def still(n: float) -> tuple[float, float]:
    return 0.0, 0.0


def build(root, where=still, travel: float = 0.8, wall: np.ndarray | None = None) -> tuple[Shot, np.ndarray]:
    """A solved shot and where the board is, bool [F, H, W]; `where(share)` is its place in world units at a time."""
    shot = Shot.create(root / "world.splannequin")
    wall, board = texture(1) if wall is None else wall, texture(2)
    y, x = np.mgrid[0.5:HEIGHT, 0.5:WIDTH].astype(np.float32)
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL], -1)
    cameras, rows, masks = [], [], []
    for n, number in enumerate(NUMBERS):
        share = n / (FRAMES - 1)
        # Not a straight path: an even drift is a still thing at another depth.
        centre = np.array([travel * (share - 0.5), travel * 0.2 * np.sin(5 * share), travel * 0.3 * share])
        plate = look(wall, rays * (WALL - centre[2]) + centre[:2])
        at = rays * (BOARD - centre[2]) + centre[:2] - where(share)
        inside = (np.abs(at) < 0.32).all(-1)
        masks.append(inside)
        pixels = np.where(inside, look(board, at), plate)
        write_png(shot.frames / f"{number:06d}.png", np.repeat(pixels[..., None], 3, -1))
        viewmat = np.eye(4)
        viewmat[:3, 3] = -centre
        cameras.append(CameraFrame(number, viewmat.ravel().tolist(), [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], "registered"))
        rows.append({"frame": number, "seconds": n / 10, "file": f"raw/{number:06d}.png", "solve": True})
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
    shot.update(width=WIDTH, height=HEIGHT, first=NUMBERS[0], last=NUMBERS[-1])
    return shot, np.array(masks)


def look(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    place = (at * 170 + [600, 450]).astype(np.float32)
    return cv2.remap(picture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def mattes(shot: Shot) -> np.ndarray:
    found = [load_motion(shot, number) for number in NUMBERS]
    assert all(f is not None and f.shape == (HEIGHT, WIDTH) and f.dtype == np.uint8 for f in found)
    return np.array(found)


def inner(mask: np.ndarray, by: int = 3) -> np.ndarray:
    """Without a margin; outside of it, `~grown(mask)`, the rest has one too."""
    return np.array([cv2.erode(m.astype(np.uint8), np.ones((2 * by + 1,) * 2, np.uint8)) > 0 for m in mask])


def grown(mask: np.ndarray, by: int) -> np.ndarray:
    return ~inner(~mask, by)


@pytest.fixture(scope="module")
def swaying(tmp_path_factory, quiet):
    """The board sways up and down by 0.08 units, 5 pixels."""
    shot, board = build(tmp_path_factory.mktemp("sway"), lambda share: (0.0, 0.08 * np.sin(7 * share)))
    return shot, board, find_motion(shot, quiet())


def test_what_moves_is_found_and_the_wall_is_still(swaying):
    shot, board, result = swaying
    labels = mattes(shot)
    assert set(np.unique(labels)) <= {STILL, UNKNOWN, MOVING}
    assert (labels[inner(board)] == MOVING).mean() > 0.95
    assert (labels[~grown(board, 8)] == MOVING).mean() < 0.01
    assert (labels == UNKNOWN).mean() < 0.1
    assert result["motion_pixels_share"] == pytest.approx((labels == MOVING).mean(), abs=1e-3)
    assert result["unknown_share"] == pytest.approx((labels == UNKNOWN).mean(), abs=1e-3)


def test_motion_along_epipolar_lines_is_found(tmp_path, quiet):
    """The camera travels sideways, and so does the board, to and fro: every match lies on its line."""
    shot, board = build(tmp_path, lambda share: (0.1 * np.sin(7 * share), 0.0))
    find_motion(shot, quiet())
    labels = mattes(shot)
    assert (labels[inner(board)] == MOVING).mean() > 0.9
    assert (labels[~grown(board, 8)] == MOVING).mean() < 0.01


def test_a_still_world_is_still(tmp_path, quiet):
    shot, _ = build(tmp_path)
    result = find_motion(shot, quiet())
    assert result["motion_pixels_share"] < 0.01 and result["unknown_share"] < 0.05


def test_a_bare_wall_before_which_something_moves_is_still(tmp_path, quiet):
    """Flow is smooth: on a bare wall it is that of what moves before it."""
    rng = np.random.default_rng(3)
    bare = (128 + rng.normal(0, 1, (900, 1200))).astype(np.uint8)
    shot, board = build(tmp_path, lambda share: (0.0, 0.08 * np.sin(7 * share)), wall=bare)
    find_motion(shot, quiet())
    labels = mattes(shot)
    assert (labels[inner(board)] == MOVING).mean() > 0.9
    assert (labels[~grown(board, 10)] == MOVING).mean() < 0.02


def test_a_tripod_has_a_matte_too(tmp_path, quiet):
    shot, board = build(tmp_path, lambda share: (0.0, 0.08 * np.sin(7 * share)), travel=0.0)
    find_motion(shot, quiet())
    labels = mattes(shot)
    assert (labels[inner(board)] == MOVING).mean() > 0.95
    assert (labels[~grown(board, 8)] == MOVING).mean() < 0.01
