"""Panorama of a take's light at a point: splats in known directions and colours, caching, refusals."""

import dataclasses
import json

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.backend.conftest import build_world
from torch_backend import contract
from torch_backend.contract import Cancelled, JobError, LightParams, TakeFolder
from torch_backend.footage.display import PLAIN, ROLLED
from torch_backend.freeze.light import job
from torch_backend.freeze.light.job import LightConfig, make_light, render_panorama, seen_from
from torch_backend.gaussians.ply import PlyGaussians, read_ply, write_ply
from torch_backend.scene import load_scene
from torch_backend.shot import write_json
from torch_backend.train import load_run

SMALL = LightConfig(width=128)
SH_C0 = 0.28209479177387814
COLORS = {
    (1, 0, 0): (0.9, 0.1, 0.2),
    (-1, 0, 0): (0.1, 0.8, 0.3),
    (0, 1, 0): (0.2, 0.3, 0.9),
    (0, -1, 0): (0.7, 0.7, 0.1),
    (0, 0, 1): (0.6, 0.2, 0.8),
    (0, 0, -1): (0.3, 0.9, 0.9),
}
"""Map from direction (from the point, in scene axes) to display-referred sRGB."""
POINT = np.array([1.5, -0.5, 0.75])


def fibonacci(count):
    heights = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angles = np.arange(count) * np.pi * (3.0 - 5.0**0.5)
    radii = np.sqrt(1.0 - heights**2)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], 1)


def of_the_nearest(along):
    """([..., 3] float64 sRGB of the axis nearest to a direction, [...] cosine to this axis)."""
    axes, colors = (np.array(list(x), np.float64) for x in (COLORS, COLORS.values()))
    cosines = np.asarray(along, np.float64) @ axes.T
    return colors[cosines.argmax(-1)], cosines.max(-1)


def to_light(srgb):
    """sRGB decoding (IEC 61966-2-1) in float64."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def ball(radius=4.0, missing=None, count=3000):
    """Opaque splats on a sphere around POINT in six colours, in scene axes, without the directions that `missing`
    selects."""
    along = fibonacci(count)
    if missing is not None:
        along = along[~missing(along)]
    return splats(POINT + radius * along, of_the_nearest(along)[0], 0.05 * radius, 6.0)


def splats(means, colors, scale, logit):
    n = len(means)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    sh = ((np.asarray(colors) - 0.5) / SH_C0).astype(np.float32)[:, None]
    means = np.asarray(means, np.float32)
    logs = np.full((n, 3), np.log(scale), np.float32)
    return PlyGaussians(means, quats, logs, np.full(n, logit, np.float32), sh)


def joined(*parts):
    return PlyGaussians(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def truth(width):
    u = (np.arange(width) + 0.5) / width
    v = 1.0 - (np.arange(width // 2) + 0.5) / (width // 2)
    longitude, latitude = 2 * np.pi * (0.5 - u), np.pi * (v - 0.5)
    x = np.cos(latitude)[:, None] * np.cos(longitude)
    y = np.cos(latitude)[:, None] * np.sin(longitude)
    return np.stack([x, y, np.broadcast_to(np.sin(latitude)[:, None], x.shape)], -1)


def rendered(gaussians, quiet, display=PLAIN, turn=None):
    seen = seen_from(gaussians, POINT, np.zeros((1, 3)), SMALL)
    return render_panorama(seen, np.eye(3) if turn is None else turn, display, SMALL, quiet())


def test_every_direction_has_its_colour_as_light(quiet):
    picture = rendered(ball(), quiet)
    along = truth(SMALL.width)
    srgb, cosine = of_the_nearest(along)
    sure = cosine > 0.9  # away from the borders between colours
    assert sure.mean() > 0.25
    np.testing.assert_allclose(picture[sure][:, :3], to_light(srgb)[sure], atol=0.01)
    assert picture[..., 3].min() > 0.98


def test_a_turned_scene_is_turned(quiet):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    picture = rendered(ball(), quiet, turn=turn)
    srgb, cosine = of_the_nearest(truth(SMALL.width) @ turn)  # turn^T d
    sure = cosine > 0.9
    np.testing.assert_allclose(picture[sure][:, :3], to_light(srgb)[sure], atol=0.01)


def test_light_above_white_is_kept_where_the_footage_has_it(quiet):
    shown = float(ROLLED.from_light(np.float32([12.0]))[0])
    display = dataclasses.replace(ROLLED, most=1.0)
    lamp = splats(POINT + 4.0 * fibonacci(3000), np.full((3000, 3), shown), 0.36, 6.0)
    assert np.median(rendered(lamp, quiet, display)[..., :3]) == pytest.approx(12.0, rel=0.02)


def test_what_is_near_or_around_the_point_does_not_smear(quiet):
    clean = rendered(ball(), quiet)
    white = np.full((1, 3), 1.0)
    near = splats(POINT + np.array([[0.03, 0.02, 0.0]]), white, 0.05, 6.0)
    around = splats(POINT + np.array([[0.3, 0.0, 0.1]]), white, 0.4, 6.0)
    needle = splats(POINT + np.array([[0.0, 2.0, 0.0]]), white, 0.05, 6.0)
    needle.log_scales[:, 1] = np.log(1.5)  # it extends through the point
    wide = splats(POINT + np.array([[0.0, 0.0, -3.0]]), white, 0.02, 6.0)
    wide.log_scales[:, :2] = np.log(2.0)  # flat; one standard deviation spans 34 degrees
    assert np.abs(rendered(joined(ball(), near, around, needle, wide), quiet) - clean).max() < 1e-3
    aside = splats(POINT + np.array([[-1.0, 0.0, 0.0]]), white, 0.05, 6.0)
    with_aside = rendered(joined(ball(), aside), quiet)
    seen = np.abs(with_aside - clean).max(-1) > 0.05
    assert seen.any() and (truth(SMALL.width)[seen][:, 0] < -0.95).all(), "what stands there is seen, and only there"


def test_colours_are_those_that_the_clip_saw():
    """Harmonics make a splat red from below and blue from above. A clip that saw it from below gives red everywhere."""
    gaussians = splats(POINT + np.array([[0.0, 0.0, -4.0]]), [[0.5, 0.5, 0.5]], 0.3, 6.0)
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 2] = (0.8, 0.0, -0.8)  # times z of the ray from the camera to the splat
    gaussians = gaussians._replace(sh=sh)
    many = joined(gaussians, splats(POINT + 4.0 * fibonacci(9), np.zeros((9, 3)), 0.1, 6.0)._replace(
        sh=np.zeros((9, 4, 3), np.float32)
    ))  # fmt: skip
    below = POINT - np.array([0.0, 0.0, 9.0])
    seen = seen_from(many, POINT, below[None], SMALL)
    np.testing.assert_allclose(seen.colors[0], 0.5 + 0.4886025119029199 * np.array([0.8, 0.0, -0.8]), atol=1e-5)
    above = seen_from(many, POINT, np.stack([below, POINT + np.array([0.0, 0.0, 1.0])]), SMALL)
    np.testing.assert_allclose(above.colors[0], 0.5 - 0.4886025119029199 * np.array([0.8, 0.0, -0.8]), atol=1e-5)


# ------------------------------------------------------------------------------------------------- the job


PLACEMENT = contract.Placement([0, 0, 2, 1, 2, 0, 0, 5, 0, 2, 0, -1, 0, 0, 0, 1])
"""A rotated scene at twice the solve's scale."""


def lit(shot, run="none", checkpoint=""):
    """Folder of a take whose splats are the sphere around POINT, without its bottom."""
    folder = TakeFolder(shot.take("lit"))
    facts = {"version": 1, "take": "lit", "run": run, "checkpoint": checkpoint, "t_star_frame": 105}
    write_json(folder.facts, {**facts, "placement": PLACEMENT.to_json()})
    write_json(shot.placement, PLACEMENT.to_json())
    write_ply(folder.ply, *ball(missing=lambda along: along[:, 2] < -0.5))
    return folder


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """(solved tiny world, its `lit` folder). The world has no run, so no exposure."""
    world = build_world(tmp_path_factory.mktemp("lit"))
    return world, lit(world.shot)


def params(**more):
    return LightParams(**{"take": "lit", "position": ",".join(map(repr, POINT.tolist())), **more})


def read(path):
    image = oiio.ImageInput.open(str(path))
    spec, pixels = image.spec(), image.read_image(oiio.FLOAT)
    image.close()
    assert spec.format == oiio.HALF and spec.channelnames == ("R", "G", "B")
    return pixels


def test_the_panorama_is_the_scenes_and_says_what_was_filled(take, quiet):
    world, folder = take
    result = make_light(world.shot, params(), quiet(), SMALL)
    assert result["made"] and result["position"] == POINT.tolist()
    assert result["filled"] == pytest.approx(0.22, abs=0.03), "the cap below -0.5, less a rim of splats"
    light = read(result["light"])
    along = truth(SMALL.width)
    srgb, cosine = of_the_nearest(along)
    sure = (cosine > 0.9) & (along[..., 2] > -0.4)
    np.testing.assert_allclose(light[sure], to_light(srgb)[sure], atol=0.012)
    assert np.abs(np.diff(light[-8:], axis=0)).max() < 0.03 and np.ptp(light[-1], axis=0).max() < 0.05
    cap = to_light(np.array(COLORS[0, 0, -1]))
    assert np.abs(light[-1].mean(0) - cap).max() > 0.1, "nobody saw what is below: it is not known"
    facts = contract.light_of_take(folder, result["key"])
    assert facts.filled == result["filled"] and facts.position == POINT.tolist()


def test_light_is_recomputed_for_a_new_point_or_take(take, quiet):
    world, folder = take
    first = make_light(world.shot, params(), quiet(), SMALL)
    before = read(first["light"])
    assert not make_light(world.shot, params(), quiet(), SMALL)["made"]
    second = make_light(world.shot, params(position="1.5,-0.5,0.8"), quiet(), SMALL)
    assert second["made"] and second["key"] != first["key"]
    with open(first["light"], "r+b") as file:
        file.truncate(1000)
    assert contract.light_of_take(folder, first["key"]) is None
    again = make_light(world.shot, params(), quiet(), SMALL)
    assert again["made"] and np.array_equal(read(again["light"]), before)
    facts = json.loads(folder.facts.read_text(encoding="utf-8"))
    folder.facts.write_text(json.dumps({**facts, "seconds": 1.25}), encoding="utf-8")
    assert make_light(world.shot, params(), quiet(), SMALL)["key"] != first["key"]
    folder.facts.write_text(json.dumps(facts), encoding="utf-8")


def test_light_uses_the_current_shot_placement(take, quiet, tmp_path):
    """The same point of the frozen scene, after the scene was rotated by a quarter turn and scaled by two."""
    world, folder = take
    still = read(make_light(world.shot, params(), quiet(), SMALL)["light"])
    turn = np.array([[0.0, -2, 0, 3], [2, 0, 0, 0], [0, 0, 2, -1], [0, 0, 0, 1]])
    before = contract.placement_of(json.loads(folder.facts.read_text(encoding="utf-8")))
    matrix = turn @ np.array(before.scene_from_solve).reshape(4, 4)
    file = tmp_path / "placement.json"
    file.write_text(json.dumps(contract.Placement(matrix.ravel().tolist()).to_json()), encoding="utf-8")
    moved = turn[:3, :3] @ POINT + turn[:3, 3]
    position = ",".join(map(repr, moved.tolist()))
    result = make_light(world.shot, params(position=position, placement=str(file)), quiet(), SMALL)
    # +X has become +Y, a quarter of the picture to the left.
    assert np.abs(read(result["light"]) - np.roll(still, -SMALL.width // 4, axis=1)).mean() < 0.005


def test_the_light_is_exposed_as_at_the_instant(trained_copy, quiet):
    world = trained_copy
    run, scene = load_run(world.shot, "main"), load_scene(world.shot)
    with torch.no_grad():
        run.model.exposure.values[:, 0] = torch.tensor([-0.5, 0.1, 0.0])
        run.model.exposure.values[:, 1] = torch.tensor([0.0, 0.02, -0.01])
        gain, offset = (x.double().numpy() for x in run.model.exposure.at(scene.time_of_frame(105)))
    lit(world.shot, "main", run.stamp)
    report = quiet()
    splat_colors = torch.rand(50, 3)
    exposed = job.exposed_as(run, scene, 105.0, splat_colors)
    np.testing.assert_allclose(exposed, np.clip(splat_colors.double().numpy() * gain + offset, 0.0, None), atol=1e-6)
    make_light(world.shot, params(), report, SMALL)
    assert not [event for event in report.events if event[0] == "warning"]


def test_missing_run_drops_exposure_with_a_warning(take, quiet):
    world, _ = take
    report = quiet()
    make_light(world.shot, params(position="1.5,-0.5,0.76"), report, SMALL)
    assert [event for event in report.events if event[0] == "warning"]


def test_a_take_of_a_former_solve_gives_no_light(take, quiet):
    """Its splats have other axes and units than the point."""
    world, folder = take
    kept = folder.facts.read_text(encoding="utf-8")
    try:
        write_json(folder.facts, {**json.loads(kept), "scale": 1.3 * load_scene(world.shot).scale})
        with pytest.raises(JobError, match="solved again"):
            make_light(world.shot, params(), quiet(), SMALL)
    finally:
        folder.facts.write_text(kept, encoding="utf-8")


def test_uncreatable_paths_give_a_readable_error(take, quiet):
    world, folder = take
    with pytest.raises(JobError, match="no finished take"):
        make_light(world.shot, params(take="nowhere"), quiet())
    for wrong in ("1,2", "a,b,c", "1,2,nan", ""):
        with pytest.raises(ValueError, match="three numbers"):
            make_light(world.shot, params(position=wrong), quiet())
    before = set(folder.root.rglob("*"))
    with pytest.raises(Cancelled):
        make_light(world.shot, params(position="0,0,0"), quiet(cancel_at=("making the light", 0.3)), SMALL)
    assert set(folder.root.rglob("*")) == before
    kept = read_ply(folder.ply)
    write_ply(folder.ply, *splats(POINT + np.array([[0.0, 0.0, 0.1]]), [[1.0, 1.0, 1.0]], 0.5, 6.0))
    with pytest.raises(JobError, match="No splat"):
        make_light(world.shot, params(), quiet(), SMALL)
    write_ply(folder.ply, *kept)
