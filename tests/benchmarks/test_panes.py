"""Glass and mirrors in a world of a few rectangles, where each pixel's content is known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic.cameras import _look_at, intrinsics
from benchmarks.synthetic.geometry import Builder
from benchmarks.synthetic.panes import GLASS, MIRROR, Pane
from benchmarks.synthetic.regions import OBJECT_PREFIX, Geometry, View, region_maps

EYE = np.array([0.0, 0.0, 1.5])
FRAMES = 3


@pytest.fixture(scope="module")
def world() -> Geometry:
    """A wall at y = 3 with a mirror and a pane in a hole; a wall beyond at 6, and one behind the camera at -3.

    A board hangs in front of the wall behind the camera, at y = -1.5, and moves 0.3 up per frame.
    """
    still, board = Builder([1.0]), Builder([1.0])
    for left, right in ((-4.0, 0.3), (1.3, 4.0)):
        still.rect([left, 3.0, 0.0], [right - left, 0, 0], [0, 0, 3.0], 0)
    still.rect([-8.0, 6.0, -2.0], [16.0, 0, 0], [0, 0, 8.0], 0)
    still.rect([8.0, -3.0, -2.0], [-16.0, 0, 0], [0, 0, 8.0], 0)
    board.rect([-0.9, -1.5, 1.3], [-0.4, 0, 0], [0, 0, 0.4], 0)
    fixed, loose = still.mesh(), board.mesh()
    vertices = np.stack([loose.vertices + np.array([0, 0, 0.3 * t]) for t in range(FRAMES)]).astype(np.float32)
    triangles = np.concatenate([fixed.triangles, loose.triangles + len(fixed.vertices)])
    panes = [
        Pane.of(MIRROR, [-1.2, 2.98, 0.9], [1.0, 0, 0], [0, 0, 1.2]),
        Pane.of(GLASS, [0.3, 3.0, 0.9], [1.0, 0, 0], [0, 0, 1.2]),
    ]
    return Geometry(fixed.vertices, vertices, triangles, panes, {})


def with_board(world: Geometry, moved: list[float]) -> Geometry:
    """The same world with the board displaced."""
    moving = world.moving + np.array(moved, np.float32)
    return Geometry(world.static, moving, world.triangles, world.panes, world.objects)


def view(yaw: float = 0.0, eye: np.ndarray = EYE) -> View:
    """View along y, rotated to the right by `yaw` radians."""
    forward = np.array([np.sin(yaw), np.cos(yaw), 0.0])
    return View(_look_at(eye, eye + forward, np.zeros(3)), intrinsics(160, 90), 160, 90)


def box(of: View, low: list[float], high: list[float]) -> np.ndarray:
    """[H, W] mask between the projections of two corners, without a border of one pixel."""
    (x0, y1), (x1, y0) = (of.project(np.array(corner))[0] for corner in (low, high))
    x, y = np.meshgrid(np.arange(of.width) + 0.5, np.arange(of.height) + 0.5)
    return (x > x0 + 1) & (x < x1 - 1) & (y > y0 + 1) & (y < y1 - 1)


def test_a_ray_is_turned_back_as_a_mirror_does():
    pane = Pane.of(MIRROR, [-1, 2, -1], [2, 0, 0], [0, 0, 2])
    assert pane.normal.tolist() == [0, -1, 0]
    rays = np.array([[0.0, 1, 0], [0.4, 1, 0], [0.6, 1, 0], [0, -1, 0], [1, 0, 0]])
    assert pane.distance_to(np.zeros(3), rays).tolist() == [2, 2, np.inf, np.inf, np.inf]
    assert pane.distance_to(np.array([0.0, 5, 0]), -rays[:1]).tolist() == [np.inf], "its back reflects nothing"
    assert pane.turned_back(rays[1]).tolist() == [0.4, -1, 0]
    assert pane.mirrored(np.array([0.5, -3, 1])).tolist() == [0.5, 7, 1]


def test_masks_are_of_panes_in_which_nothing_moves(world):
    of = view()
    maps = region_maps(world, world.at(1), 1, of, of)
    mirror, glass, wall = (maps[OBJECT_PREFIX + name] for name in ("mirror", "glass", "wall"))
    whole = box(of, [-1.2, 2.98, 0.9], [-0.2, 2.98, 2.1])
    image = box(of, [-1.3, 2 * 2.98 + 1.5, 1.6], [-0.9, 2 * 2.98 + 1.5, 2.0])  # mirror image of the board at frame 1
    assert image.any() and maps["moving"][image].all() and not mirror[image].any()
    assert mirror[whole].mean() > 0.8 and (mirror | maps["moving"])[whole].all()
    assert glass[box(of, [0.3, 3.0, 0.9], [1.3, 3.0, 2.1])].all(), "no mover is reflected there"
    assert not (mirror & glass).any() and not (wall & (mirror | glass | maps["moving"])).any()
    assert (maps["depth_mm"][mirror] == 2980).all() and (maps["depth_mm"][glass] == 6000).all()
    assert (maps["depth_mm"][wall] == 3000).all()
    rays = of.rays().reshape(90, 160, 3) * 3.0 + EYE
    in_mirror = (rays[..., 0] > -1.75) & (rays[..., 0] < 1.85) & (rays[..., 2] > 0.35) & (rays[..., 2] < 2.65)
    inner = in_mirror & (maps["depth_mm"] == 3000)
    assert wall[inner].all() and not wall[(rays[..., 0] < -1.85) | (rays[..., 0] > 1.95)].any()
    assert maps["seen"].all()


def test_mirror_pixels_are_seen_if_the_reflection_was_seen(world):
    of = view()
    mirror = region_maps(world, world.at(1), 1, of, of)[OBJECT_PREFIX + "mirror"]
    turned = region_maps(world, world.at(1), 1, of, view(1.2))
    assert not turned["seen"][mirror].any(), "the mirror is not in that frame"
    # Seen from half a metre to the left, the left third of the mirror's content lies beyond its edge: the image of the
    # wall at -3 is three times as far as the mirror.
    shifted = region_maps(world, world.at(1), 1, of, view(0.0, EYE - [0.5, 0, 0]))
    share = shifted["seen"][mirror].mean()
    assert share == pytest.approx(2 / 3, abs=0.07)
    columns = np.flatnonzero(mirror.any(axis=0))
    seen = (shifted["seen"] & mirror).sum(axis=0)[columns] / mirror.sum(axis=0)[columns]
    assert seen[:3].mean() < 0.1 and seen[-3:].mean() > 0.9


def test_what_hides_a_point_from_the_mirror_hides_it_from_the_eye(world):
    """From 0.7 to the side, the mirror shows a part of the rear wall that the board at 0.8 hides from the other eye."""
    near = with_board(world, [0.0, 2.3, 0.0])
    of, eye_view = view(), view(0.0, EYE - np.array([0.7, 0, 0]))
    maps = region_maps(near, near.at(1), 1, eye_view, of)
    shown = (eye_view.rays() * 8.96 + eye_view.eye).reshape(
        90, 160, 3
    )  # images of the wall at -3, with the mirror at 2.98
    x, y = np.moveaxis(of.project(shown)[0], 2, 0)
    board = box(of, [-1.3, 2 * 2.98 - 0.8, 1.6], [-0.9, 2 * 2.98 - 0.8, 2.0])
    inside = (x > 0) & (x < 160) & (y > 0) & (y < 90)
    covered = np.zeros_like(board)
    covered[inside] = board[y[inside].astype(int), x[inside].astype(int)]
    covered &= maps[OBJECT_PREFIX + "mirror"]
    assert covered.any() and not maps["seen"][covered].any()
    assert maps["seen"][maps[OBJECT_PREFIX + "mirror"] & ~covered].any()


def test_what_moves_in_glass_moves_however_still_the_garden_is(world):
    of = view(0.0, EYE + np.array([2.07, 0, 0]))
    maps = region_maps(world, world.at(1), 1, of, of)
    image = box(of, [-1.3, 7.5, 1.6], [-0.9, 7.5, 2.0])
    assert image.any() and maps["moving"][image].all() and not maps[OBJECT_PREFIX + "glass"][image].any()
    assert maps[OBJECT_PREFIX + "glass"].any() and (maps["depth_mm"][image] == 6000).all()


def test_a_board_before_a_mirror_hides_it(world):
    """In frame 2 the board is between the other eye and the mirror."""
    of = view()
    near = with_board(world, [0.3, 3.5, -0.3])
    maps = region_maps(near, near.at(1), 1, of, of)
    hidden = box(of, [-1.0, 2.0, 1.3], [-0.6, 2.0, 1.7])
    assert (
        hidden.any() and not maps[OBJECT_PREFIX + "mirror"][hidden].any() and (maps["depth_mm"][hidden] == 2000).all()
    )
