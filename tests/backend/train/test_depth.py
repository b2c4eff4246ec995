"""Training with depth maps: their fit, more accurate depth of moving objects, and detection of outdated maps."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.backend.conftest import FIRST, FRAMES, HEIGHT, WIDTH
from torch_backend.contract import DEPTH_FILE, PAINTED_FOLDER, ExitCode, JobError, TrainParams
from torch_backend.freeze.composite.measured_depth import MeasuredDepths
from torch_backend.freeze.composite.surface_depth import FrameDepths
from torch_backend.freeze.frozen import freeze_at, render_frozen, span_of
from torch_backend.raster import rasterize
from torch_backend.scene import load_scene
from torch_backend.shot import write_json
from torch_backend.train import load_run, train_shot
from torch_backend.train.checkpoint import read_meta
from torch_backend.train.depth import depth_pull, deviation, load_fitted
from torch_backend.train.model import render


def true_depth(world, n):
    """[H, W]: true depth of a frame of the tiny world, in its units."""
    out = rasterize(
        **world.at(n / (FRAMES - 1)), viewmats=world.viewmats[n : n + 1], Ks=world.K[None], width=WIDTH, height=HEIGHT,
        with_depth=True,
    )  # fmt: skip
    return out.depth_median[0].double().numpy()


def write_depth(world, folder: Path, of=lambda depth, n: 0.4 * depth, noise=0.02, frames=range(FRAMES)) -> Path:
    """Write depth maps of the tiny world as 16-bit PNG, with noise."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for n in frames:
        depth = true_depth(world, n)
        values = of(depth * (1.0 + noise * rng.standard_normal(depth.shape)), n)
        cv2.imwrite(str(folder / f"{FIRST + n:06d}.png"), np.clip(values * 2e4, 1, 65535).astype(np.uint16))
    return folder


@pytest.fixture(scope="module")
def swaying(trained_copy):
    """The trained world, whose patch is painted as moving, with a lens in its solve."""
    lens = {"camera_model": "SIMPLE_RADIAL", "distortion": [0.0], "focal_px": 60.0}
    write_json(trained_copy.shot.solve_record, {"version": 1, **lens})
    shutil.rmtree(trained_copy.shot.motion, ignore_errors=True)  # of another file's freeze, later than the run
    return trained_copy


def params_of(run, depth=""):
    return TrainParams(run=run, iterations=12, max_gaussians=300, holdout=8, depth=str(depth))


def moving_error(world, run):
    """Median relative depth error of moving objects, away from their borders, at each frame's own time."""
    model, scene, errors = load_run(world.shot, run).model, load_scene(world.shot), []
    for n in range(FRAMES):
        matte = cv2.imread(str(world.shot.root / PAINTED_FOLDER / f"{FIRST + n:06d}.png"), cv2.IMREAD_GRAYSCALE) > 200
        inside = cv2.erode(matte.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        state = model.state_at(float(scene.times[n]))
        out = render(state, model.sh_degree, scene.viewmats[n], scene.Ks[n], WIDTH, HEIGHT, with_depth=True)
        depth = out.depth_median[0].detach().numpy() / scene.scale
        errors.append(np.abs(depth / true_depth(world, n) - 1.0)[inside])
    return float(np.median(np.concatenate(errors)))


@pytest.fixture(scope="module")
def pairs(swaying, quiet, tmp_path_factory):
    """World with the runs `main` and `with`, without and with depth maps."""
    folder = write_depth(swaying, tmp_path_factory.mktemp("maps") / "depth")
    params = dataclasses.replace(params_of("with", folder), iterations=300, max_gaussians=800)
    train_shot(swaying.shot, params, quiet())
    return swaying


def test_what_moves_is_nearer_to_its_true_depth(pairs):
    assert moving_error(pairs, "with") < 0.4 * moving_error(pairs, "main")


@pytest.mark.parametrize("pose", [6, 8])
def test_the_depth_of_a_frozen_frame_is_measured_by_the_map_of_its_instant(pairs, pose):
    """Views are plate t* itself and another pose; the truth is the world at t*."""
    t_star = 6
    deep, scene = load_run(pairs.shot, "with"), load_scene(pairs.shot)
    # Combine the maps of one run with the splats of the other, whose moving objects are 7 to 12 % too far.
    run = dataclasses.replace(load_run(pairs.shot, "main"), folder=deep.folder, depth_key=deep.depth_key)
    frozen = freeze_at(run.model, float(scene.times[t_star]), span_of(scene, run))
    image = render_frozen(frozen, scene.viewmats[pose], scene.Ks[pose], WIDTH, HEIGHT)
    measured = MeasuredDepths(run, scene).at(FIRST + t_star, frozen)
    assert measured is not None and MeasuredDepths(run, scene).at(FIRST + 0.5, frozen) is None
    state = {name: value[pairs.moving] for name, value in pairs.at(t_star / (FRAMES - 1)).items()}
    camera = {"viewmats": pairs.viewmats[pose : pose + 1], "Ks": pairs.K[None], "width": WIDTH, "height": HEIGHT}
    patch = rasterize(**state, **camera, with_depth=True)
    inside = cv2.erode((patch.alphas[0] > 0.9).numpy().astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    inside &= image.motion.numpy() > 0.5
    assert inside.sum() > 50

    def error(depth):
        return float(np.median(np.abs(depth.numpy() / scene.scale / patch.depth_median[0].numpy() - 1.0)[inside]))

    depths, picture = FrameDepths(run, scene), pairs.image(pose, t_star / (FRAMES - 1))
    inputs = scene.viewmats[pose], scene.Ks[pose], image.depth, image.motion, picture
    without, _ = depths.of(*inputs)
    with_map, sigma = depths.of(*inputs, measured)
    assert error(with_map) < 0.5 * error(without)
    assert bool((sigma >= 0).all()) and bool(torch.isfinite(sigma).all())


@pytest.mark.parametrize("kind", ["depth", "inverse depth"])
def test_fitted_maps_are_the_true_depth_whatever_scale_and_shift_they_had(swaying, quiet, tmp_path, kind):
    def values(depth, n):
        return (0.3 + 0.01 * n) * depth + 0.2 if kind == "depth" else (2.0 + 0.1 * n) / depth + 0.1

    folder = write_depth(swaying, tmp_path / "depth", values, noise=0.005)
    name = kind.replace(" ", "-")
    report = quiet()
    summary = train_shot(swaying.shot, params_of(name, folder), report)
    facts, scene = summary["depth"], load_scene(swaying.shot)
    # The tiny world has two depths, so a line through both fits for either kind of map.
    assert facts["residual"] < 0.02 and facts["frames"] == FRAMES
    assert any(facts["linear_in"] in event[4] for event in report.events if event[:2] == ("progress", "depth"))
    fitted = load_run(swaying.shot, name).depth()
    assert fitted is not None and fitted.frames == list(range(FIRST, FIRST + FRAMES))
    for n in (0, 7, 15):
        inverse, sigma = fitted.at(FIRST + n)
        error = 1.0 / inverse.numpy() / scene.scale / true_depth(swaying, n) - 1.0
        assert np.median(np.abs(error)) < 0.02
        assert 0.005 < float((sigma / inverse).median()) < 0.03


def test_frames_without_a_usable_map_are_trained_without_in_one_sentence(swaying, quiet, tmp_path):
    folder = write_depth(swaying, tmp_path / "depth")
    (folder / "000103.png").unlink()
    (folder / "000104.png").write_bytes(b"no picture")
    cv2.imwrite(str(folder / "000105.png"), np.full((48, 20), 9, np.uint16))
    report = quiet()
    summary = train_shot(swaying.shot, params_of("holes", folder), report)
    assert summary["depth"]["frames"] == FRAMES - 3 and math.isfinite(summary["heldout_psnr_db"])
    warnings = [event[1] for event in report.events if event[0] == "warning" and str(folder) in event[1]]
    assert (
        len(warnings) == 1 and "frame 103" in warnings[0] and "frame 104" in warnings[0] and "frame 105" in warnings[0]
    )


def test_unrelated_or_unusable_depth_sequence_is_refused(swaying, quiet, tmp_path):
    rng = np.random.default_rng(1)
    unrelated = write_depth(swaying, tmp_path / "other", lambda depth, n: rng.uniform(0.1, 1.0, depth.shape))
    broken = write_depth(swaying, tmp_path / "broken")
    for file in broken.iterdir():
        file.write_bytes(b"no picture")
    for folder in (unrelated, broken):
        with pytest.raises(JobError) as refused:
            train_shot(swaying.shot, params_of("refused", folder), quiet())
        assert refused.value.exit_code == ExitCode.TRAIN and str(folder) in str(refused.value)
    assert not (swaying.shot.run("refused") / "checkpoint.safetensors").is_file()


def test_a_run_is_known_by_the_contents_of_its_maps(swaying, quiet, tmp_path):
    folder = write_depth(swaying, tmp_path / "depth")

    def key_after(depth):
        report = quiet()
        train_shot(swaying.shot, params_of("keyed", depth), report)
        done = ("progress", "training", 1, 1, "already trained") in report.events
        return read_meta(swaying.shot.run("keyed") / "checkpoint.safetensors")["key"], done

    plain, _ = key_after("")
    assert not (swaying.shot.run("keyed") / DEPTH_FILE).exists()
    first, done = key_after(folder)
    assert first != plain and not done
    assert key_after(folder) == (first, True)
    stored = load_run(swaying.shot, "keyed").depth()
    (swaying.shot.run("keyed") / DEPTH_FILE).unlink()
    with pytest.raises(JobError, match="depth"):
        load_run(swaying.shot, "keyed").depth()
    assert key_after(folder) == (first, True), "what was removed is fitted again"
    assert torch.equal(load_run(swaying.shot, "keyed").depth().inverse, stored.inverse)
    write_depth(swaying, folder, frames=[5], noise=0.1)
    second, done = key_after(folder)
    assert second not in (first, plain) and not done
    with pytest.raises(JobError):
        load_fitted(swaying.shot.run("keyed"), "another key")
    assert key_after("")[0] == plain
    assert load_run(swaying.shot, "keyed").depth() is None
    assert not (swaying.shot.run("keyed") / DEPTH_FILE).exists()
    config = json.loads((swaying.shot.run("keyed") / "config.json").read_text())
    assert "depth" not in config


def test_an_extended_run_keeps_its_maps_without_the_folder(swaying, quiet, tmp_path):
    folder = write_depth(swaying, tmp_path / "depth")
    train_shot(swaying.shot, params_of("longer", folder), quiet())
    for file in folder.iterdir():
        file.unlink()
    summary = train_shot(swaying.shot, TrainParams(run="longer", extend=10), quiet())
    assert summary["iterations"] == 22 and summary["depth"]["frames"] == FRAMES
    assert load_run(swaying.shot, "longer").depth() is not None


def test_the_deviation_is_pseudo_hubers_loss_in_standard_deviations():
    inverse = torch.tensor([[0.5, 0.25, 0.9, 0.7]], dtype=torch.float64, requires_grad=True)
    wanted = torch.tensor([[[0.5, 0.2, 0.0, 0.4]], [[0.1, 0.1, 0.1, 0.1]]], dtype=torch.float64)
    loss = deviation(torch.stack([inverse, inverse.square()], -1), wanted)
    assert float(loss.detach()) == pytest.approx((math.sqrt(1.25) - 1.0 + math.sqrt(10.0) - 1.0) / 4.0)
    loss.backward()
    pulls = [0.0, 0.5 / math.sqrt(1.25) / 0.1 / 4.0, 0.0, 3.0 / math.sqrt(10.0) / 0.1 / 4.0]
    np.testing.assert_allclose(inverse.grad.numpy()[0], pulls, atol=1e-9)
    spread = torch.tensor([[[0.5, 0.26]]], dtype=torch.float64)  # of 0.4 and 0.6, whose mean is correct
    assert float(deviation(spread, wanted[:, :, :1])) == pytest.approx(math.sqrt(2.0) - 1.0)


def test_the_pull_moves_means_of_what_moves_along_the_cameras_axis_and_nothing_else(world):
    state = {name: value.clone().requires_grad_() for name, value in world.state.items() if name != "colors"}
    depth = torch.from_numpy(true_depth(world, 3)).float()
    wanted = torch.stack([1.0 / (0.9 * depth), torch.full_like(depth, 0.01)])

    def pull(of, moves):
        return depth_pull(of, moves, world.viewmats[3], world.K, wanted)

    pull(state, world.moving).backward()
    assert all(value.grad is None for name, value in state.items() if name != "means")
    slope = state["means"].grad
    assert bool((slope[:, :2] == 0).all()) and float(slope[world.moving, 2].max()) > 0.0, "the world looks along z"
    assert bool((slope[~world.moving] == 0).all())
    with torch.no_grad():
        nearer = {**state, "means": state["means"] - 1e-2 * slope.sign()}
        assert pull(nearer, None) < pull(state, None)
