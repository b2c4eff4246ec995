"""Interpolated poses, compared with closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from torch_backend.cameras.poses import (
    camera_centre,
    fill_poses,
    interpolate_pose,
    quat_to_rotation,
    rotation_to_quat,
    slerp,
)
from torch_backend.sfm.results import _nearest

vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
shares = st.floats(0.0, 1.0)


def pose(rotvec, centre):
    rotation = Rotation.from_rotvec(rotvec).as_matrix()
    return np.concatenate([rotation, (-rotation @ np.asarray(centre, float))[:, None]], axis=1)


def wxyz(rotation):
    return np.roll(rotation.as_quat(canonical=True), 1)


@given(vectors)
def test_quaternions_agree_with_scipy(rotvec):
    rotation = Rotation.from_rotvec(rotvec)
    quat = rotation_to_quat(rotation.as_matrix())
    assert quat[0] >= 0
    assert abs(quat @ wxyz(rotation)) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(quat_to_rotation(quat), rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_have_a_quaternion(axis):
    quat = rotation_to_quat(Rotation.from_rotvec(np.pi * axis).as_matrix())
    assert np.allclose(np.abs(quat), [0.0, *axis], atol=1e-9)


@given(vectors, vectors, shares)
def test_slerp_agrees_with_scipy(a, b, share):
    one, two = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    if (one.inv() * two).magnitude() > np.pi - 1e-3:
        return  # no unique path between opposite rotations
    expected = Slerp([0, 1], Rotation.concatenate([one, two]))(share)
    got = slerp(wxyz(one), -wxyz(two), share)  # q and -q are the same rotation
    assert abs(got @ wxyz(expected)) == pytest.approx(1.0, abs=1e-9)


@given(vectors, shares, st.floats(-12.0, -6.0))
def test_slerp_of_almost_equal_rotations_is_finite(a, share, exponent):
    one = wxyz(Rotation.from_rotvec(a))
    two = wxyz(Rotation.from_rotvec(a) * Rotation.from_rotvec([10**exponent, 0, 0]))
    got = slerp(one, two, share)
    assert np.isfinite(got).all()
    assert np.abs(np.abs(got @ one)) == pytest.approx(1.0, abs=1e-9)


def test_half_way_has_half_the_turn_and_the_middle_of_the_centres():
    a, b = pose([0, 0, 0], [0, 0, 0]), pose([0, np.radians(60), 0], [2, 4, 6])
    middle = interpolate_pose(a, b, 0.5)
    assert np.allclose(middle[:, :3], Rotation.from_rotvec([0, np.radians(30), 0]).as_matrix(), atol=1e-12)
    assert np.allclose(camera_centre(middle), [1, 2, 3], atol=1e-12)


@given(vectors, vectors, vectors, vectors)
def test_first_and_last_poses_are_kept(ra, ca, rb, cb):
    a, b = pose(ra, ca), pose(rb, cb)
    assert np.allclose(interpolate_pose(a, b, 0.0), a, atol=1e-9)
    assert np.allclose(interpolate_pose(a, b, 1.0), b, atol=1e-9)


def test_gaps_are_interpolated_by_time_and_ends_are_constant():
    known = {1: pose([0, 0, 0], [0, 0, 0]), 4: pose([0, 0.9, 0], [9, 0, 0])}
    seconds = np.array([0.0, 1.0, 1.1, 3.0, 4.0, 5.0])
    filled = fill_poses(seconds, known)
    assert len(filled) == 6
    assert np.allclose([camera_centre(p)[0] for p in filled], [0, 0, 0.3, 6, 9, 9])
    assert np.allclose(filled[3][:, :3], Rotation.from_rotvec([0, 0.6, 0]).as_matrix(), atol=1e-12)
    assert (filled[5] == known[4]).all()


def test_nothing_known_is_an_error():
    with pytest.raises(ValueError, match="no pose is known"):
        fill_poses(np.arange(3.0), {})


@pytest.mark.parametrize("known", [[0], [7], [3, 4], [0, 10], [2, 5, 6, 11], list(range(12))])
def test_the_nearest_of_known_frames_is_the_lower_of_two_as_near(known):
    assert _nearest(known, 12) == [min(known, key=lambda k: (abs(k - i), k)) for i in range(12)]
