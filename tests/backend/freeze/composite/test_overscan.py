"""A take with overscan: the same camera with more pixels, with the frame inside; and redistortion with the lens."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import NO_DEPTH, CameraFrame, CameraPath, FreezeParams, JobError
from torch_backend.footage.images import read_png
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.composite.surface_depth import SurfaceDepthConfig
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.lens.lens import load_lens
from torch_backend.lens.stmap import needed_margin, redistort_map
from torch_backend.shot import write_json

RANGE = {"t_star": 105, "first": 104, "last": 104, "develop": "off"}


@pytest.fixture(scope="module")
def lens(trained):
    """The tiny world with a barrel lens in its solve."""
    record = {"version": 1, "camera_model": "SIMPLE_RADIAL", "distortion": [-0.2], "focal_px": 61.9}
    write_json(trained.shot.solve / "solve.json", record)
    yield load_lens(trained.shot)
    (trained.shot.solve / "solve.json").unlink()


@pytest.fixture(scope="module")
def plain(trained, lens, quiet):
    freeze_shot(trained.shot, FreezeParams(take="plain", **RANGE), quiet())
    return trained.shot.take("plain")


def test_the_frame_inside_is_the_take_without_overscan(trained, lens, plain, quiet):
    facts = freeze_shot(trained.shot, FreezeParams(take="over", overscan=12.5, **RANGE), quiet())
    folder = trained.shot.take("over")
    assert (facts["width"], facts["height"], facts["margin"]) == (64, 48, [8, 6])
    whole, frame = read_frozen_exr(folder / "000104.exr"), read_frozen_exr(plain / "000104.exr")
    assert whole.rgba.shape == (60, 80, 4) and whole.margin == (8, 6) and frame.margin == (0, 0)
    np.testing.assert_array_equal(whole.metadata.K, frame.metadata.K)
    for name in ("rgba", "support", "motion"):
        difference = np.abs(getattr(whole, name)[6:-6, 8:-8] - getattr(frame, name))
        # The slope of a Gaussian's projection is clamped slightly beyond the frame; with overscan the frame is
        # larger.
        assert difference.max() < 2e-2, name
        if name == "rgba":
            aside = np.abs(whole.rgba[6:-6, 9:-7] - frame.rgba).mean()
            assert difference.mean() < 0.02 * aside, "not a fraction of a pixel aside"
    sigma = frame.more["DepthSigma"]
    assert sigma.shape == frame.depth.shape and (sigma[frame.depth < NO_DEPTH] > 0).all()
    difference = np.abs(whole.depth[6:-6, 8:-8] - frame.depth)
    reach = 4 * SurfaceDepthConfig().radii[0] + 1  # reach of nested windows
    inner = np.s_[reach:-reach, reach:-reach]
    assert (difference / frame.depth)[inner].max() < 1e-4
    assert (difference < 2.0 * sigma).mean() > 0.99, "surfaces at the border are measured with what is beyond it"
    assert whole.rgba[:6, :, 3].mean() > 0.5, "there is picture beyond the frame: the wall goes on"
    np.testing.assert_array_equal(
        read_png(folder / "preview" / "000104.png").shape, read_png(plain / "preview" / "000104.png").shape
    )
    spec = oiio.ImageBuf(str(folder / "000104.exr")).spec()
    assert (spec.x, spec.y, spec.width, spec.height) == (-8, -6, 80, 60)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 64, 48)


def test_what_the_lens_needs_is_rendered_and_its_map_is_with_the_take(trained, lens, quiet):
    facts = freeze_shot(trained.shot, FreezeParams(take="lens", overscan=-1.0, **RANGE), quiet())
    across, down = needed_margin(lens, 64, 48)
    assert facts["margin"] == [across, down] and across > 2 and facts["overscan"] == -1.0
    frame = read_frozen_exr(trained.shot.take("lens") / "000104.exr")
    assert frame.rgba.shape == (48 + 2 * down, 64 + 2 * across, 4)
    found = oiio.ImageBuf(facts["redistort"]).get_pixels(oiio.FLOAT)
    np.testing.assert_array_equal(found, redistort_map(lens, 64, 48, (across / 64, down / 48)))
    assert found[..., :2].min() >= 0.0 and found[..., :2].max() <= 1.0


def test_another_overscan_makes_the_frames_stale_and_none_leaves_no_map(trained, lens, quiet):
    folder = trained.shot.take("change")
    sizes = []
    ask = dict(RANGE, take="change", detail="off", only_missing=True)
    for overscan in (0.0, 12.5, 0.0):
        freeze_shot(trained.shot, FreezeParams(overscan=overscan, **ask), quiet())
        sizes.append(read_frozen_exr(folder / "000104.exr").rgba.shape[1])
        assert (folder / "stmap" / "redistort.exr").is_file() == bool(overscan)
    assert sizes == [64, 80, 64]
    assert json.loads((folder / "take.json").read_text())["redistort"] == ""


def test_custom_camera_has_percent_overscan_and_no_map(trained, lens, quiet, tmp_path):
    pose = trained.viewmats[7].flatten().tolist()
    path = CameraPath(64, 48, [CameraFrame(1, pose, [90.0, 90.0, 32.0, 24.0], "blender")])
    write_json(tmp_path / "path.json", path.to_json())
    params = {"take": "own", "t_star": 108, "camera_path": str(tmp_path / "path.json"), "width": 64, "develop": "off"}
    facts = freeze_shot(trained.shot, FreezeParams(overscan=25.0, **params), quiet())
    assert facts["margin"] == [16, 12] and facts["redistort"] == ""
    with pytest.raises(JobError, match="only known for the clip's own camera"):
        freeze_shot(trained.shot, FreezeParams(overscan=-1.0, **params), quiet())


def test_a_lens_without_a_way_back_is_said_and_the_percentage_still_rendered(trained, lens, quiet):
    record = trained.shot.solve / "solve.json"
    before = json.loads(record.read_text())
    write_json(record, {**before, "distortion": [-2.0]})
    try:
        report = quiet()
        facts = freeze_shot(trained.shot, FreezeParams(take="fold", overscan=12.5, detail="off", **RANGE), report)
        assert facts["margin"] == [8, 6] and facts["redistort"] == ""
        assert any(e[0] == "warning" and "folds over" in e[1] for e in report.events)
        with pytest.raises(JobError, match="folds over"):
            freeze_shot(trained.shot, FreezeParams(take="fold", overscan=-1.0, **RANGE), quiet())
    finally:
        write_json(record, before)
