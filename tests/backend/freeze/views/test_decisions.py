"""Decisions are insensitive to rounding: no pixel of a frozen frame jumps by 1, wherever a threshold lies."""

import pytest
import torch

from torch_backend.footage.plates import Plates
from torch_backend.freeze.composite.compositor import Compositor
from torch_backend.freeze.frozen import OutputFrame, freeze_at, render_frozen, span_of
from torch_backend.freeze.views.decisions import above, first_best, first_least
from torch_backend.scene import load_scene
from torch_backend.train import load_run


def test_a_threshold_is_a_ramp_around_it():
    value = torch.tensor([0.0, 0.44, 0.475, 0.5, 0.525, 0.56, 9.0])
    torch.testing.assert_close(above(value, 0.5), torch.tensor([0.0, 0.0, 0.25, 0.5, 0.75, 1.0, 1.0]))
    torch.testing.assert_close(above(value, torch.full((7,), 0.5)), above(value, 0.5))
    assert float(above(0.0, 0.0)) == 0.5, "no threshold, and no division by it"


def test_of_choices_that_are_equally_good_the_first_is_taken():
    values = torch.tensor([[1.0, 0.2], [1.0 + 1e-6, 0.5], [0.9, 0.5 - 1e-6]])
    assert first_best(values).tolist() == [0, 1]
    assert first_least([3.0, 1.0 + 1e-6, 1.0], 0.0) == 1 and first_least([1e-7, 0.0], 1e-5) == 0


@pytest.fixture(scope="module")
def frame(trained):
    """frame(by): [H, W, 5] colour, support and motion from another pose, with Gaussians perturbed by the fraction
    `by`."""
    run, scene, plates = (
        load_run(trained.shot, "main", torch.device("cpu")),
        load_scene(trained.shot),
        Plates(trained.shot),
    )
    compositor, (pose, t_star) = Compositor(run, scene, plates), (113, 106)
    size, i = (plates.width, plates.height), scene.frames.index(pose)
    output = OutputFrame(pose, scene.viewmats[i], scene.camera_at(*size)[i], float(t_star), float(pose))

    def make(by=0.0):
        frozen = freeze_at(run.model, scene.time_of_frame(t_star), span_of(scene, run))
        noise = torch.Generator().manual_seed(3)
        for name, value in frozen.state.items():
            frozen.state[name] = value * (1.0 + by * (2.0 * torch.rand(value.shape, generator=noise) - 1.0))
        exposed_at = scene.time_of_frame(pose)
        image = render_frozen(frozen, output.viewmat, output.K, *size, run.model.exposure, exposed_at)
        out = compositor.frame(output, frozen, image, *size)
        return torch.cat([out.linear, out.support[..., None], out.motion[..., None]], dim=-1)

    return make


def test_rounding_errors_of_the_scene_stay_rounding_errors(frame):
    assert float((frame() - frame(1e-6)).abs().max()) < 0.02
