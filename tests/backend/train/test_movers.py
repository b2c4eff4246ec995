"""Moving areas of mattes: only Gaussians there go on trial, nothing else opens, and mattes are part of a run's key."""

import numpy as np
import pytest
import torch

from tests.backend.conftest import FIRST, FRAMES, HEIGHT, WIDTH, build_world, paint_motion
from tests.backend.trainings import assert_same_run, take_steps
from torch_backend.contract import Cancelled, JobError, TrainParams
from torch_backend.deformation import GateConfig
from torch_backend.motion.mattes import MOVING, PAINTED, STILL, UNKNOWN, load_motion, write_matte
from torch_backend.scene import load_images, load_scene
from torch_backend.train import config_from_params, load_run, train_shot
from torch_backend.train.checkpoint import load_checkpoint
from torch_backend.train.events import schedule_events
from torch_backend.train.movers import load_movers, mean_of, moving_frames, on_trial
from torch_backend.train.trainer import Trainer


@pytest.fixture(scope="module")
def painted_world(tmp_path_factory):
    """Tiny shot whose mattes show the patch; tests must not change its mattes."""
    world = build_world(tmp_path_factory.mktemp("painted"))
    paint_motion(world)
    return world


def paint_all(world, value):
    for n in range(FRAMES):
        path = world.shot.root / PAINTED / f"{FIRST + n:06d}.png"
        path.parent.mkdir(exist_ok=True)
        write_matte(path, np.full((HEIGHT, WIDTH), value, np.uint8))


def trainer_of(world, quiet, steps, movers=True, **changes):
    scene = load_scene(world.shot)
    config = config_from_params(TrainParams(iterations=300, max_gaussians=1500, holdout=0, **changes))
    images = load_images(scene, scene.solved, WIDTH, HEIGHT)
    found = load_movers(lambda frame: load_motion(world.shot, frame), scene, scene.solved, WIDTH, HEIGHT)
    trainer = Trainer(scene, images, scene.solved, config, quiet(), movers=found if movers else None)
    take_steps(trainer, steps)
    return trainer


def centred_on_movers(trainer, margin):
    """int [N]: number of frames in which a Gaussian's centre projects into moving pixels, dilated by `margin`
    pixels."""
    means, counts = trainer.model.gaussians.params["means"].detach(), 0
    for n, index in enumerate(trainer.train_ids):
        wide = torch.nn.functional.max_pool2d(trainer.movers[n][None].float(), 2 * margin + 1, 1, margin)[0] > 0
        camera = means @ trainer.viewmats[index][:3, :3].T + trainer.viewmats[index][:3, 3]
        pixels = (camera @ trainer.Ks[index].T)[:, :2] / camera[:, 2:].clamp_min(1e-3)
        x, y = pixels.long().clamp(min=0).unbind(1)
        inside = (pixels >= 0).all(1) & (x < WIDTH) & (y < HEIGHT)
        counts = counts + (inside & wide[y.clamp(max=HEIGHT - 1), x.clamp(max=WIDTH - 1)])
    return counts


def test_mattes_of_another_size_are_brought_to_the_training_images():
    class Frames:
        frames = (7, 8)

    matte = np.full((40, 80), STILL, np.uint8)
    matte[:20, :40], matte[20:] = MOVING, UNKNOWN
    movers = load_movers({7: matte, 8: None}.get, Frames(), [0, 1], 16, 8)
    assert movers.shape == (2, 8, 16)
    assert movers[0, :4, :8].all()
    assert int(movers.sum()) == 32, "unknown counts as still, and so does a frame without a matte"
    assert load_movers(lambda frame: None, Frames(), [0, 1], 16, 8) is None


def test_what_lies_in_movers_goes_on_trial_and_nothing_else(painted_world, quiet):
    trainer = trainer_of(painted_world, quiet, 90)
    trial = on_trial(trainer)
    rows = torch.nonzero(trial).flatten()
    assert 10 < len(rows) < 0.5 * len(trial)
    assert float((centred_on_movers(trainer, 1) >= 3)[rows].float().mean()) > 0.9
    always = centred_on_movers(trainer, 0) == len(trainer.train_ids)
    assert float(trial[always].float().mean()) > 0.8
    assert int(moving_frames(trainer, 0.5).max()) == len(trainer.train_ids)
    trainer.config.gate.moving_frames = FRAMES + 1
    assert not on_trial(trainer).any(), "a frame or two of motion are a fault of the flow"
    trainer.config.gate.moving_frames = 3
    trainer.movers[5:] = False
    few = on_trial(trainer)
    trainer.config.gate.moving_often = 0.5
    assert few.any() and not on_trial(trainer).any(), "what something passes stands still most of the time"
    trainer.movers = None
    assert on_trial(trainer).float().mean() > 0.8, "without mattes all that is painted is tried"


def test_when_growth_of_a_long_run_ends_who_is_open_and_paints_no_mover_closes(painted_world, quiet):
    """Children of open Gaussians are open. Here some are placed near the patch, with a change of their own."""
    trainer = trainer_of(painted_world, quiet, 140)
    model, config = trainer.model, trainer.config
    movers = model.gaussians.open.clone()
    assert trainer.policy.facts.hardened is not None and movers.any()
    static_rows = (centred_on_movers(trainer, 4) == 0) & (moving_frames(trainer, 0.05) == 0)
    static_rows &= model.gaussians.support.any(1) & ~movers
    strays = torch.nonzero(static_rows).flatten()[:20]
    model.gaussians.open[strays] = True
    mean = mean_of(model, strays)
    trainer.config.densify.every = 1000  # no round of growth at this step
    trainer.iteration = round(config.densify.stop * config.iterations)
    schedule_events(trainer)
    assert model.gaussians.open[strays].all(), "a short run is left alone"
    config.iterations = GateConfig.LONG + 1
    trainer.iteration = round(config.densify.stop * config.iterations)
    schedule_events(trainer)
    assert len(strays) == 20 and not model.gaussians.open[strays].any()
    assert float(model.gaussians.open[movers].float().mean()) > 0.8
    for name, value in mean.items():
        torch.testing.assert_close(model.gaussians.params[name][strays], value, msg=name)


def test_published_hosts_ignore_movers(painted_world, quiet):
    for changes in ({"method": "hexplane"}, {"host_config": "reference"}):
        assert trainer_of(painted_world, quiet, 0, **changes).movers is None
    assert trainer_of(painted_world, quiet, 0, method="static").movers is not None


def test_a_run_is_known_by_its_mattes_and_nothing_opens_where_they_say_that_nothing_moves(tmp_path, quiet):
    world, params = build_world(tmp_path), TrainParams(iterations=40, max_gaussians=600)
    paint_motion(world)
    train_shot(world.shot, params, quiet())
    again = quiet()
    train_shot(world.shot, params, again)
    assert ("progress", "training", 1, 1, "already trained") in again.events
    paint_all(world, UNKNOWN)
    with pytest.raises(JobError, match="other motion mattes"):
        train_shot(world.shot, TrainParams(extend=10), quiet())
    later = quiet()
    summary = train_shot(world.shot, params, later)
    assert any("motion mattes changed" in event[1] for event in later.events if event[0] == "warning")
    assert summary["moving_share"] == 0.0
    assert load_run(world.shot, "main").model.field is None


def test_it_resumes_exactly_with_mattes(painted_world, quiet):
    whole, broken = (TrainParams(run=run, iterations=40, max_gaussians=600) for run in ("whole", "broken"))
    train_shot(painted_world.shot, whole, quiet())
    for share in (0.3, 0.7):  # static; with a field
        with pytest.raises(Cancelled):
            train_shot(painted_world.shot, broken, quiet(cancel_at=("training", share)))
    train_shot(painted_world.shot, broken, quiet())
    runs = [painted_world.shot.run(name) for name in ("whole", "broken")]
    assert_same_run(*runs)
    tensors, facts = load_checkpoint(runs[0] / "checkpoint.safetensors")
    assert facts["motion"] and any(name.startswith("field.") for name in tensors)
