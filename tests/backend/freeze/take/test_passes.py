"""Passes of frozen frames: a tilted plane compared with geometry, and a take compared with its depth and cameras."""

import dataclasses
import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torch_backend.cameras.placement import Similarity
from torch_backend.contract import NO_DEPTH, FreezeParams, Placement, write_json
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.frozen import OutputFrame
from torch_backend.freeze.take.passes import Passes

W, H = 40, 30
TURNED = Similarity(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), 3.0, np.array([5.0, 1.0, -2.0]))
SCENE = SimpleNamespace(scale=0.5, centre=np.array([0.3, -0.1, 2.0]))


def camera(frame, centre, turn):
    """Camera at `centre` in the model's units, panned by `turn` radians."""
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ centre
    K = torch.tensor([[35.0, 0.0, 19.0], [0.0, 34.0, 16.0], [0.0, 0.0, 1.0]])
    return OutputFrame(frame, torch.from_numpy(viewmat).float(), K, 1.0, float(frame))


FRAMES = [camera(1, [0.0, 0.0, 0.0], 0.0), camera(2, [0.2, -0.05, 0.1], 0.03), camera(3, [0.25, 0.1, 0.1], -0.02)]
PLANE = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
"""Normal of the plane n . x = 2; it points away from the cameras."""


def plane_depth(output):
    """(depth [H, W], points [H, W, 3]) of the plane seen by a camera, float64."""
    K, view = output.K.double().numpy(), output.viewmat.double().numpy()
    y, x = np.mgrid[:H, :W] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    world, centre = rays @ view[:3, :3], -view[:3, :3].T @ view[:3, 3]
    depth = (2.0 - centre @ PLANE) / (world @ PLANE)
    return depth, centre + world * depth[..., None]


def projected(points, output):
    K, view = output.K.double().numpy(), output.viewmat.double().numpy()
    local = points @ view[:3, :3].T + view[:3, 3]
    return local[..., :2] / local[..., 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]


def computed(output, depth, bands=1):
    """Complete layers, computed in `bands` bands."""
    layers = Passes(FRAMES, SCENE, TURNED).of(output, output.K, torch.from_numpy(depth))
    cuts = [n * H // bands for n in range(bands + 1)]
    return {name: np.concatenate([layer[slice(a, b)] for a, b in pairwise(cuts)]) for name, layer in layers.items()}


@pytest.mark.parametrize("bands", [1, 4])
def test_a_planes_passes_are_its_geometry(bands):
    depth, points = plane_depth(FRAMES[1])
    found = computed(FRAMES[1], depth, bands)
    np.testing.assert_allclose(found["Position"], TURNED.points(points / 0.5 + SCENE.centre), atol=1e-4)
    facing = np.broadcast_to(-(TURNED.rotation @ PLANE), (H, W, 3))
    np.testing.assert_allclose(found["Normal"], facing, atol=1e-4)
    now, before, after = (projected(points, FRAMES[n]) for n in (1, 0, 2))
    up = np.array([1.0, -1.0])
    np.testing.assert_allclose(
        found["Vector"], np.concatenate([(before - now) * up, (now - after) * up], -1), atol=1e-3
    )
    np.testing.assert_allclose(found["forward"], (after - now) * up, atol=1e-3)
    np.testing.assert_allclose(found["backward"], (before - now) * up, atol=1e-3)
    assert np.abs(found["Vector"]).max() > 2.0, "or the test says nothing"


def test_depth_step_does_not_tilt_normals_and_all_values_are_finite():
    depth, _ = plane_depth(FRAMES[1])
    depth[:, W // 2 :] *= 0.7  # a parallel, nearer plane, with the same normal
    depth[:5] = NO_DEPTH
    found = computed(FRAMES[1], depth)
    facing = np.broadcast_to(-(TURNED.rotation @ PLANE), (H - 5, W, 3))
    np.testing.assert_allclose(found["Normal"][5:], facing, atol=1e-4)
    assert all(not layer[:5].any() for layer in found.values())


def test_at_the_ends_of_a_take_nothing_is_beyond():
    depth, _ = plane_depth(FRAMES[0])
    first = computed(FRAMES[0], depth)["Vector"]
    assert not first[..., :2].any() and np.abs(first[..., 2]).min() > 0.1
    depth, _ = plane_depth(FRAMES[2])
    last = computed(FRAMES[2], depth)["Vector"]
    assert np.abs(last[..., :2]).max() > 0.1 and not last[..., 2:].any()


def test_a_zoom_of_the_next_frame_changes_the_facts_that_its_motion_vectors_depend_on():
    zoomed = dataclasses.replace(FRAMES[2], K=FRAMES[2].K * torch.tensor([[1.2], [1.2], [1.0]]))
    depth, _ = plane_depth(FRAMES[1])
    plain, changed = Passes(FRAMES, SCENE, TURNED), Passes([*FRAMES[:2], zoomed], SCENE, TURNED)
    vectors = [p.of(FRAMES[1], FRAMES[1].K, torch.from_numpy(depth))["Vector"][slice(0, H)] for p in (plain, changed)]
    assert np.abs(vectors[0] - vectors[1]).max() > 0.5, "or the test says nothing"
    assert plain.facts(FRAMES[1]) != changed.facts(FRAMES[1])


def test_a_takes_passes_lie_on_its_cameras(trained, tmp_path, quiet):
    """Each position projects to its pixel and depth; moved by its vector, it matches the next frame's position."""
    placement = Placement([0.0, -2.5, 0.0, 4.0, 0.0, 0.0, 2.5, 1.0, -2.5, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0])
    write_json(tmp_path / "placement.json", placement.to_json())
    params = FreezeParams(
        take="passes", t_star=105, first=104, last=106, passes=True, develop="off",
        placement=str(tmp_path / "placement.json"),
    )  # fmt: skip
    facts = freeze_shot(trained.shot, params, quiet())
    assert facts["passes"]
    back = Similarity.of(placement).inverse()
    frames = {n: read_frozen_exr(trained.shot.take("passes") / f"{n:06d}.exr") for n in (104, 105, 106)}
    for n, frame in frames.items():
        assert frame.more["Vector"].shape == (*frame.depth.shape, 4)
        np.testing.assert_array_equal(frame.more["forward"], -frame.more["Vector"][..., 2:])
        np.testing.assert_array_equal(frame.more["backward"], frame.more["Vector"][..., :2])
        solve, meta = back.points(frame.more["Position"]), frame.metadata
        local = solve @ meta.viewmat[:3, :3].T + meta.viewmat[:3, 3]
        is_solid = frame.depth < NO_DEPTH
        np.testing.assert_allclose(local[..., 2][is_solid], frame.depth[is_solid], rtol=1e-4)
        y, x = np.mgrid[: is_solid.shape[0], : is_solid.shape[1]] + 0.5
        seen = local[..., :2] / local[..., 2:] * np.diag(meta.K)[:2] + meta.K[:2, 2]
        np.testing.assert_allclose(seen[is_solid], np.stack([x, y], -1)[is_solid], atol=1e-2)
        lengths = np.linalg.norm(frame.more["Normal"], axis=-1)[is_solid]
        np.testing.assert_allclose(lengths, 1.0, atol=2e-3)
        if n < 106:
            later = frames[n + 1].metadata
            expected = solve @ later.viewmat[:3, :3].T + later.viewmat[:3, 3]
            goes = expected[..., :2] / expected[..., 2:] * np.diag(later.K)[:2] + later.K[:2, 2]
            to = np.stack([x - frame.more["Vector"][..., 2], y + frame.more["Vector"][..., 3]], -1)
            np.testing.assert_allclose(to[is_solid], goes[is_solid], atol=2e-2)
