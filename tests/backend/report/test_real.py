"""A textured wall seen by a camera that travels, and a board on it that moves across the epipolar lines."""

import numpy as np
import pytest

from torch_backend.report.real import RigidConfig, epipolar_distance, far_from, rigid_mask

cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")

WIDTH, HEIGHT, FRAMES, DEPTH = 160, 120, 12, 4.0
K = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])


def views() -> np.ndarray:
    viewmats = np.tile(np.eye(4), (FRAMES, 1, 1))
    viewmats[:, 0, 3] = np.linspace(0.5, -0.5, FRAMES)
    return viewmats


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((600, 800, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 5)
    return (255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


def scene(moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plates [F, H, W, 3] and where the board is [F, H, W]; `moves` [F] is its height in world units."""
    wall, board = texture(1), texture(2)
    plates, masks = [], []
    y, x = np.mgrid[0.5:HEIGHT, 0.5:WIDTH]
    for view, up in zip(views(), moves, strict=True):
        place = np.stack([(x - 80) / 150 * DEPTH - view[0, 3], (y - 60) / 150 * DEPTH], -1)
        plate = cv2.remap(wall, (place * 110 + [400, 300]).astype(np.float32), None, cv2.INTER_LINEAR)
        inside = (np.abs(place[..., 0]) < 0.45) & (np.abs(place[..., 1] - up) < 0.45)
        at = ((place - [0, up]) * 110 + [400, 300]).astype(np.float32)
        plates.append(np.where(inside[..., None], cv2.remap(board, at, None, cv2.INTER_LINEAR), plate))
        masks.append(inside)
    return np.array(plates), np.array(masks)


def mask_of(moves: np.ndarray, **changes) -> tuple[np.ndarray, np.ndarray]:
    plates, board = scene(moves)
    config = RigidConfig(keyframes=FRAMES, tolerance=1.0, blob=3, **changes)
    return rigid_mask(plates, views(), np.tile(K, (FRAMES, 1, 1)), config=config), board


def test_what_moves_is_left_out_and_the_wall_is_kept():
    rigid, board = mask_of(0.25 * np.sin(np.linspace(0, 6, FRAMES)))
    inner = slice(2, -2)
    assert rigid[inner][board[inner]].mean() < 0.1
    away = np.ones((FRAMES, HEIGHT, WIDTH), bool)
    away[..., :16] = away[..., -16:] = False  # leaves the picture in some neighbour
    columns = np.array([np.convolve(b.any(0), np.ones(25), "same") > 0 for b in board])
    away &= ~columns[:, None]  # where the board passes, the wall is hidden at times
    assert rigid[inner][away[inner]].mean() > 0.75


def test_a_still_board_is_rigid():
    rigid, board = mask_of(np.zeros(FRAMES))
    assert rigid[3:-3][board[3:-3]].mean() > 0.9


def test_what_moved_at_another_time_is_no_truth_either():
    """The board moves in the first half of the clip only: the plates of the second half do not show where it was."""
    moves = np.concatenate([np.linspace(-0.5, 0, FRAMES // 2), np.zeros(FRAMES - FRAMES // 2)])
    rigid, board = mask_of(moves, baselines=(1, 2))
    assert rigid[-3][board[-3]].mean() < 0.15


def test_epipolar_distance_is_in_pixels_across_the_line():
    view_a, view_b = views()[0], views()[-1]
    y, x = np.mgrid[0.5:HEIGHT, 0.5:WIDTH]
    matches = np.stack([x + (view_b[0, 3] - view_a[0, 3]) / DEPTH * 150, y], -1)
    assert epipolar_distance(matches, view_a, view_b, K, K).max() < 1e-9
    matches[..., 0] += 7  # along the line: another depth
    matches[..., 1] += 3  # across it
    assert epipolar_distance(matches, view_a, view_b, K, K) == pytest.approx(np.full((HEIGHT, WIDTH), 3.0))


def test_epipolar_distance_with_another_focal_length_and_a_turn():
    angle = 0.1
    view = np.eye(4)
    view[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    view[:3, 3] = [0.2, -0.1, 0.3]
    other = np.array([[170.0, 0, 75], [0, 165, 62], [0, 0, 1]])
    y, x = np.mgrid[0.5:HEIGHT, 0.5:WIDTH]
    depth = 3 + np.random.default_rng(0).random((HEIGHT, WIDTH))
    points = np.stack([(x - 80) / 150 * depth, (y - 60) / 150 * depth, depth], -1) @ view[:3, :3].T + view[:3, 3]
    matches = (points @ other.T)[..., :2] / points[..., 2:]
    assert epipolar_distance(matches, np.eye(4), view, K, other).max() < 1e-8


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        rigid_mask(np.zeros((3, 8, 8, 3), np.uint8), np.zeros((2, 4, 4)), np.zeros((3, 3, 3)))


def test_poses_far_from_the_instant():
    assert far_from(range(0, 40, 8), 0, 40) == [16, 24, 32]
    assert far_from([5], 10, 40) == []
