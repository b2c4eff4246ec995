"""A burnt-in logo with a mask: training learns the hidden area from frames that show it."""

import math

import numpy as np
import pytest
import torch

from tests.backend.conftest import FIRST, FRAMES, HEIGHT, WIDTH, build_world
from tests.backend.trainings import take_steps
from torch_backend.contract import TrainParams, read_json
from torch_backend.footage.images import read_png, write_png
from torch_backend.scene import load_images, load_scene
from torch_backend.sfm.masks import IGNORE, load_mask, write_grey
from torch_backend.shot import write_json
from torch_backend.train import config_from_params, train_shot
from torch_backend.train.evidence import gather_evidence
from torch_backend.train.ignored import load_ignored
from torch_backend.train.trainer import Trainer
from torch_backend.train.verdict import figures_of

LOGO = np.zeros((HEIGHT, WIDTH), bool)
LOGO[30:40, 6:22] = True


@pytest.fixture(scope="module")
def logo_world(tmp_path_factory):
    """The tiny shot with a logo, solved with a mask of the logo."""
    world = build_world(tmp_path_factory.mktemp("logo"))
    record = read_json(world.shot.solve_record) if world.shot.solve_record.is_file() else {"version": 1}
    write_json(world.shot.solve_record, {**record, "masks": {IGNORE: {"key": "logo"}}})
    world.shot.masks(IGNORE).mkdir()
    for n in range(FRAMES):
        plate = world.shot.plate(FIRST + n)
        write_png(plate, np.where(LOGO[..., None], np.uint8([255, 0, 255]), read_png(plate)))
        write_grey(world.shot.mask(IGNORE, FIRST + n), np.where(LOGO, np.uint8(255), np.uint8(0)))
    return world


def masks_of(world):
    return lambda frame: load_mask(world.shot, IGNORE, frame)


def test_frames_with_the_same_mask_share_it_and_half_covered_pixels_count(logo_world):
    scene = load_scene(logo_world.shot)
    found = load_ignored(masks_of(logo_world), scene, scene.solved, WIDTH // 4, HEIGHT // 4)
    assert set(found) == set(scene.solved) and len({id(mask) for mask in found.values()}) == 1
    wanted = LOGO.reshape(HEIGHT // 4, 4, WIDTH // 4, 4).mean((1, 3)) > 0.1
    assert (found[scene.solved[0]].numpy() == wanted).all()


def shown_behind(world, quiet, ignored):
    """([P, 3] pixels behind the logo in a frame of a short run, the same pixels in the truth)."""
    scene = load_scene(world.shot)
    config = config_from_params(TrainParams(iterations=300, max_gaussians=1500, holdout=0, method="static"))
    images = load_images(scene, scene.solved, WIDTH, HEIGHT)
    found = load_ignored(masks_of(world), scene, scene.solved, WIDTH, HEIGHT) if ignored else {}
    trainer = Trainer(scene, images, scene.solved, config, quiet(), ignored=found)
    take_steps(trainer, 100)
    mask = torch.from_numpy(LOGO)
    return trainer.render_frame(8)[mask], world.image(8, 8 / (FRAMES - 1))[mask]


def test_a_masked_logo_is_not_learnt(logo_world, quiet):
    errors = []
    for ignored in (True, False):
        shown, truth = shown_behind(logo_world, quiet, ignored)
        errors.append(float((shown - truth).abs().mean()))
    assert errors[0] < 0.12 and errors[1] > 2.5 * errors[0]


def test_a_run_is_known_by_what_it_ignores(logo_world, quiet):
    params = TrainParams(iterations=10, max_gaussians=300, method="static")
    key = train_shot(logo_world.shot, params, quiet())["key"]
    assert train_shot(logo_world.shot, params, quiet())["key"] == key
    record = read_json(logo_world.shot.solve_record)
    write_json(logo_world.shot.solve_record, {**record, "masks": {IGNORE: {"key": "another"}}})
    assert train_shot(logo_world.shot, params, quiet())["key"] != key


def test_ignored_pixels_have_no_share_in_any_figure_and_a_covered_frame_has_none(logo_world, quiet):
    """Ignored pixels are replaced by the render itself, so counting them would give a perfect score."""
    scene = load_scene(logo_world.shot)
    config = config_from_params(TrainParams(iterations=300, max_gaussians=300, holdout=0, method="static"))
    images = load_images(scene, scene.solved, WIDTH, HEIGHT)
    most = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    most[: 2 * HEIGHT // 3] = True
    ignored = dict.fromkeys(scene.solved, most)
    ignored[scene.solved[3]] = torch.ones_like(most)
    trainer = Trainer(scene, images, scene.solved, config, quiet(), ignored=ignored)
    seen = gather_evidence(trainer, scene.solved[2:4], images[2:4])
    plain = {one.frame: one.psnr_db for one in seen}
    for index in scene.solved[:3]:
        error = (trainer.render_frame(index).clamp(0.0, 1.0) - images[scene.solved.index(index)])[~most]
        assert plain[scene.frames[index]] == pytest.approx(-10 * math.log10(float(error.square().mean())), abs=1e-3)
    assert math.isnan(plain[scene.frames[scene.solved[3]]])
    assert trainer.heldout_psnr(scene.solved[2:4], images[2:4]) == pytest.approx(plain[scene.frames[2]], abs=1e-3)
    assert trainer.heldout_psnr(scene.solved[3:4], images[3:4]) is None
    figures = figures_of(seen, WIDTH, WIDTH * HEIGHT)
    assert figures.held_out and figures.median_db == pytest.approx(plain[scene.frames[2]])
