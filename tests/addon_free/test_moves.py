"""Camera moves: smoothing, timing and orbits, compared with float64 ground truth."""

import numpy as np
import pytest


@pytest.fixture
def moves(addon):
    return addon("freeze.moves")


def turned(axis, angle):
    """Rotation matrix [3, 3] by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def path(count=80, shake=0.0, turn=1.2, seed=0):
    """Camera path [F, 4, 4] of a walk, with sway and tremble of a hand-held camera."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, s in enumerate(np.linspace(0.0, 1.0, count)):
        sway = shake * np.array([np.sin(2 * np.pi * 5 * s), np.sin(2 * np.pi * 7 * s + 1), np.sin(2 * np.pi * 9 * s)])
        tremble = shake * 0.3 * rng.normal(size=3)
        poses[i, :3, 3] = np.array([3.0 * s, 0.4 * s * s, -0.2 * s]) + sway + tremble
        poses[i, :3, :3] = turned((0.2, 1.0, -0.1), turn * s) @ turned((1, 0.3, 0.5), float(sway.sum() + tremble[0]))
    return poses


def dense(values, period):
    """Reference smoother, solved densely by its definition in float64; the ends stay fixed."""
    count = len(values)
    second = np.zeros((count - 2, count))
    for i in range(count - 2):
        second[i, i : i + 3] = 1.0, -2.0, 1.0
    system = np.eye(count) + (period / (2 * np.pi)) ** 4 * second.T @ second
    inside = slice(1, count - 1)
    wanted = values[inside] - system[inside][:, [0, -1]] @ values[[0, -1]]
    return np.concatenate([values[:1], np.linalg.solve(system[inside, inside], wanted), values[-1:]])


@pytest.mark.parametrize("count", [3, 4, 5, 80])
def test_positions_are_smoothed_as_defined(moves, count):
    poses = path(count, 0.02)
    expected = dense(poses[:, :3, 3], 0.7 * (count - 1))
    np.testing.assert_allclose(moves.smoothed(poses, 0.7, 0.0)[:, :3, 3], expected, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 80])
def test_nothing_is_smoothed_by_0_and_the_ends_stay(moves, count):
    poses = path(count, 0.02)
    np.testing.assert_allclose(moves.smoothed(poses, 0.0, 0.0), poses, atol=1e-12)
    calm = moves.smoothed(poses, 1.0, 1.0)
    np.testing.assert_allclose(calm[[0, -1]], poses[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(
        calm[:, :3, :3] @ calm[:, :3, :3].swapaxes(1, 2), np.eye(3)[None].repeat(count, 0), atol=1e-12
    )


@pytest.mark.parametrize("turn", [0.3, 1.2, 2 * np.pi])
def test_smooth_at_1_leaves_a_tenth_of_the_second_difference_and_follows_the_walk(moves, turn):
    shaky, walk = path(120, 0.01, turn), path(120, 0.0, turn)
    before, after = moves.unsteadiness(shaky), moves.unsteadiness(moves.smoothed(shaky, 1.0, 1.0))
    assert before[0] > 10 * after[0] and before[1] > 10 * after[1]
    calm = moves.smoothed(shaky, 0.5, 0.5)
    assert np.abs(calm[:, :3, 3] - walk[:, :3, 3]).max() < 0.05
    difference = calm[:, :3, :3] @ walk[:, :3, :3].swapaxes(1, 2)
    assert np.degrees(np.arccos(np.clip((np.trace(difference, axis1=1, axis2=2) - 1) / 2, -1, 1))).max() < 3.0


def test_positions_and_rotations_are_smoothed_independently(moves):
    poses = path(60, 0.02)
    moved, turned_ = moves.smoothed(poses, 1.0, 0.0), moves.smoothed(poses, 0.0, 1.0)
    np.testing.assert_allclose(moved[:, :3, :3], poses[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(turned_[:, :3, 3], poses[:, :3, 3], atol=1e-12)
    assert np.abs(moved[:, :3, 3] - poses[:, :3, 3]).max() > 0.01
    assert np.abs(turned_[:, :3, :3] - poses[:, :3, :3]).max() > 0.01


def test_what_is_smoothed_does_not_depend_on_the_worlds_axes(moves):
    poses, world = path(60, 0.02), np.eye(4)
    world[:3, :3], world[:3, 3] = turned((1, 2, 3), 2.0), (3, -1, 2)
    np.testing.assert_allclose(
        moves.smoothed(world @ poses, 0.8, 0.6), world @ moves.smoothed(poses, 0.8, 0.6), atol=1e-9
    )


def test_a_quaternion_is_that_of_its_rotation_and_goes_the_short_way(moves):
    poses = path(200, 0.05, 7 * np.pi)
    found = moves.quaternions(poses)
    np.testing.assert_allclose(moves.rotations(found), poses[:, :3, :3], atol=1e-12)
    assert ((found[1:] * found[:-1]).sum(1) > 0).all()


def test_stops_have_smooth_starts_and_ends(moves):
    timing = moves.retimed(10, 90, 50, 20, 30, 12)
    assert timing.frames[0] == 10 and timing.frames[-1] == 90 and len(timing.frames) == 81 + 10 + 30 + 6
    pace = np.diff(timing.frames)
    assert (pace >= 0).all() and (pace <= 1 + 1e-12).all()
    assert np.abs(np.diff(pace)).max() < 1.6 / 12  # smoothstep's steepest slope is 1.5 over its length
    still = np.flatnonzero(timing.frames == 50)
    assert len(still) == 31 and timing.stop_fraction[still[0]] == 0.0 and timing.stop_fraction[still[-1]] == 1.0
    assert np.allclose(pace[:29], 1.0) and np.allclose(pace[-29:], 1.0)


@pytest.mark.parametrize("stop", [10, 12, 88, 90])
def test_an_ease_that_the_clip_has_no_room_for_is_shortened(moves, stop):
    timing = moves.retimed(10, 90, stop, 40, 5, 40)
    assert timing.frames[0] == 10 and timing.frames[-1] == 90
    assert (np.diff(timing.frames) >= 0).all() and (timing.frames == stop).sum() >= 5
    assert (moves.retimed(10, 90, stop, 0, 0, 0).frames == np.arange(10, 91)).all()


def test_poses_between_frames(moves):
    poses = path(40)
    np.testing.assert_allclose(moves.at(poses, np.arange(40.0)), poses, atol=1e-12)
    finer = path(391)
    np.testing.assert_allclose(moves.at(poses, np.arange(391) / 10), finer, atol=2e-4)
    np.testing.assert_allclose(moves.at(poses[:1], np.zeros(3)), poses[[0, 0, 0]], atol=1e-12)
    kept = np.array([0, 1, 5, 39])
    np.testing.assert_allclose(moves.filled(kept + 7.0, poses[kept])[kept], poses[kept], atol=1e-12)
    assert len(moves.filled(kept + 7.0, poses[kept])) == 40


def test_an_orbit_keeps_its_distance_and_comes_back(moves):
    poses, pivot, up = np.tile(path(5)[2], (61, 1, 1)), np.array([1.0, 0.5, -4.0]), np.array([0.0, 0.0, 1.0])
    times = np.linspace(0, 1, 61)
    round_it = moves.orbit(poses, times, pivot, up, (np.radians(40), 0.0))
    np.testing.assert_allclose(round_it[[0, -1]], poses[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(round_it[:, :3, 3] - pivot, axis=1), np.linalg.norm(poses[:, :3, 3] - pivot, axis=1), atol=1e-12
    )
    expected = turned(up, np.radians(40))
    np.testing.assert_allclose(round_it[30, :3, :3], expected @ poses[0, :3, :3], atol=1e-12)
    np.testing.assert_allclose(round_it[30, :3, 3], pivot + expected @ (poses[0, :3, 3] - pivot), atol=1e-12)
    # The pivot stays at its place in the picture, also when the camera rises.
    risen = moves.orbit(poses, times, pivot, up, (np.radians(40), np.radians(-20)))
    seen = np.einsum("nij,nj->ni", risen[:, :3, :3].swapaxes(1, 2), pivot - risen[:, :3, 3])
    np.testing.assert_allclose(seen, seen[:1].repeat(61, 0), atol=1e-12)


def test_the_point_in_the_middle_of_the_picture(moves):
    pose, lens, size = path(9)[4], (300.0, 320.0, 140.0, 110.0), (320, 240)
    seen = np.linalg.inv(pose) @ [*moves.in_the_middle(pose, lens, size, 5.0), 1.0]
    assert -seen[2] == pytest.approx(5.0)
    assert lens[2] + lens[0] * seen[0] / 5.0 == pytest.approx(160)
    assert lens[3] - lens[1] * seen[1] / 5.0 == pytest.approx(120)
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-0.4, 0.4, (101, 2)), -np.linspace(2, 6, 101)[:, None]], axis=1)
    aside = np.array([[50.0, 0.0, -1.0], [0.0, 0.0, 3.0]]).repeat(200, 0)
    world = np.concatenate([points, aside]) @ pose[:3, :3].T + pose[:3, 3]
    assert moves.depth_of_points(pose, lens, size, world) == pytest.approx(4.0)
    assert moves.depth_of_points(pose, lens, size, world[101:]) == 0.0
