"""Deep pictures of frozen frames: their samples composite to the frame, and CG merges between its surfaces."""

import json
from itertools import pairwise

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.backend.freeze.test_deep_exr import samples_of
from torch_backend.contract import NO_DEPTH, CameraPath, FreezeParams, JobError, Placement
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.deep_exr import DEEP_CHANNELS
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.take.deep import DeepSamples
from torch_backend.shot import write_json

PLACED = Placement([0.0, -2.5, 0.0, 4.0, 0.0, 0.0, 2.5, 1.0, -2.5, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0])
"""Rotation by a quarter turn and a scale of 2.5."""


def over(front, back):
    return front + (1.0 - front[..., 3:]) * back


def flattened(image):
    """[H, W, 4]: a deep file or picture, flattened by OpenImageIO."""
    flat = oiio.ImageBufAlgo.flatten(image if isinstance(image, oiio.ImageBuf) else oiio.ImageBuf(str(image)))
    return np.asarray(flat.get_pixels(oiio.FLOAT), np.float32).reshape(flat.spec().height, flat.spec().width, -1)[
        ..., :4
    ]


def card(spec, depth, rgba):
    """Deep picture with one sample per pixel."""
    flat = oiio.ImageSpec(spec.width, spec.height, 5, oiio.FLOAT)
    flat.channelnames, flat.x, flat.y = DEEP_CHANNELS, spec.x, spec.y
    image = oiio.ImageBuf(flat)
    assert image.set_pixels(
        oiio.ROI(), np.broadcast_to(np.float32([*rgba, depth]), (spec.height, spec.width, 5)).copy()
    )
    return oiio.ImageBufAlgo.deepen(image)


@pytest.fixture(scope="module")
def take(trained_copy, quiet, tmp_path_factory):
    """Deep take of the world: a patch at depth 3.2 in front of a wall at 4."""
    file = tmp_path_factory.mktemp("placed") / "placement.json"
    write_json(file, PLACED.to_json())
    params = FreezeParams(
        take="deep", t_star=105, first=104, last=106, deep=True, only_missing=True, develop="off", placement=str(file)
    )
    facts = freeze_shot(trained_copy.shot, params, quiet())
    assert facts["deep"]
    return trained_copy.shot.take("deep"), params


def test_flattened_deep_samples_equal_the_frame(take):
    folder, _ = take
    for n in (104, 105, 106):
        frame, file = read_frozen_exr(folder / f"{n:06d}.exr"), folder / "deep" / f"{n:06d}.exr"
        flat = flattened(file)
        limit = np.maximum(1.0, np.abs(frame.rgba)) / 1024.0
        assert (np.abs(flat - frame.rgba) <= limit).all()
        samples, spec = samples_of(file)
        counts = np.vectorize(len)(samples)
        assert set(np.unique(counts)) <= {0, 1, 2}
        assert 0.01 < (counts == 2).mean() < 0.4, "where the patch ends, and hardly elsewhere"
        single = counts == 1
        depth = np.vectorize(lambda s: s[0][4] if s else NO_DEPTH, otypes=[float])(samples)
        np.testing.assert_allclose(depth[single], 2.5 * frame.depth[single], rtol=1e-6)
        for pixel in samples[counts == 2]:
            near, far = pixel
            assert near[4] < far[4] and 0.0 < near[3] < 1.0
        assert spec.getattribute("splannequin:depthUnits") == "scene units"
        viewmat = np.array(spec.getattribute("splannequin:viewmat")).reshape(4, 4)
        np.testing.assert_allclose(np.linalg.det(viewmat[:3, :3]), 1.0, atol=1e-5)


def test_cg_between_both_surfaces_is_the_analytic_over(take):
    """OpenImageIO merges like Nuke: each surface covers what lies behind it."""
    folder, _ = take
    samples, spec = samples_of(folder / "deep" / "000105.exr")
    counts = np.vectorize(len)(samples)
    two = samples[counts == 2]
    at = float(np.median([0.5 * (near[4] + far[4]) for near, far in two]))
    cg = np.float32([0.0625, 0.375, 0.125, 0.5])  # exact in half floats
    merged = oiio.ImageBufAlgo.deep_merge(oiio.ImageBuf(str(folder / "deep" / "000105.exr")), card(spec, at, cg), False)
    expected = np.zeros((*samples.shape, 4), np.float32)
    for place in np.ndindex(samples.shape):
        layers = sorted([*samples[place], (*cg, at)], key=lambda sample: sample[4])
        for layer in reversed(layers):
            expected[place] = over(np.float32(layer[:4]), expected[place])
    np.testing.assert_allclose(flattened(merged), expected, atol=1e-5)
    between = [near[4] < at < far[4] for near, far in two]
    assert np.mean(between) > 0.5


def test_two_surfaces_become_two_samples_of_the_frames_colour():
    """Red splats cover half of a pixel, blue ones are behind: both samples composite to the plate's colour within
    1e-6."""
    weight = torch.tensor([[[0.3, 0.0, 0.995, 0.0]], [[0.5, 0.9, 0.0, 0.0]]])
    red, blue = torch.tensor([0.8, 0.1, 0.0]), torch.tensor([0.0, 0.1, 0.6])
    light = weight[..., None] * torch.stack([red, blue])[:, None, None]
    deep = DeepSamples(weight, light, torch.tensor([[[1.0] * 4], [[2.0] * 4]]))
    rgba = np.float32([[[0.4, 0.2, 0.3, 1.0], [0.1, 0.1, 0.1, 0.5], [5.0, 0.0, -0.01, 1.0], [0.2, 0.2, 0.2, 1.0]]])
    samples, depth = deep.rows(slice(0, 1), rgba)
    np.testing.assert_allclose(over(samples[0], samples[1]), rgba, atol=1e-6)
    np.testing.assert_allclose(samples[:, 0, :, 3], [[0.375, 0.0, 1.0, 1.0], [1.0, 0.5, 0.0, 0.0]], atol=1e-6)
    near, far = samples[0, 0, 0, :3] / 0.375, samples[1, 0, 0, :3]
    assert near[0] > 1.0 and far[0] == pytest.approx(0.0, abs=1e-6), "red stays with what was red"
    assert far[2] > near[2]
    assert depth.tolist() == [[[1.0] * 4], [[2.0] * 4]]


def test_only_frames_without_a_complete_deep_file_are_rerendered(take, trained_copy, quiet):
    folder, params = take
    files = [folder / "deep" / f"{n:06d}.exr" for n in (104, 105, 106)]
    times = [path.stat().st_mtime_ns for path in files]
    whole = files[1].read_bytes()
    files[1].write_bytes(whole[:-200])
    freeze_shot(trained_copy.shot, params, quiet())
    now = [path.stat().st_mtime_ns for path in files]
    assert (now[0], now[2]) == (times[0], times[2]) and now[1] != times[1]
    assert files[1].read_bytes() == whole


def test_blurred_takes_have_none(trained_copy, quiet, tmp_path):
    path = CameraPath.load(trained_copy.shot.solve / "cameras.json")
    for n, (one, _) in enumerate(pairwise(path.frames)):
        one.viewmat[3] += 0.1 * n
    (tmp_path / "own.json").write_text(json.dumps(path.to_json()))
    ask = dict(t_star=105, deep=True, shutter=180.0, develop="off")
    params = FreezeParams(take="blurred", camera_path=str(tmp_path / "own.json"), **ask)
    with pytest.raises(JobError, match="no deep EXRs"):
        freeze_shot(trained_copy.shot, params, quiet())
    assert not trained_copy.shot.take("blurred").exists()
