"""Moving areas are trained on softened pictures: the loss compared with its definition, and the runs that use it."""

import pytest
import torch

from torch_backend.contract import TrainParams
from torch_backend.train.config import config_from_params
from torch_backend.train.losses import photometric
from torch_backend.train.softened import SoftenedMovers

H, W = 90, 162
"""Not multiples of the block size."""


@pytest.fixture
def pictures():
    g = torch.Generator().manual_seed(0)
    image, target = (torch.rand(H, W, 3, generator=g, dtype=torch.float64) for _ in range(2))
    movers = torch.zeros(2, H, W, dtype=torch.bool)
    movers[0, 40:60, 100:130] = True
    return image.requires_grad_(), target, movers


def soft(picture, block):
    """Block means, computed one by one."""
    rows, columns = range(0, H, block), range(0, W, block)
    means = [[picture[y : y + block, x : x + block].mean(dim=(0, 1)) for x in columns] for y in rows]
    return torch.stack([torch.stack(row) for row in means])


def loss_of(movers_loss, image, target, dssim, ignored, frame, progress):
    return movers_loss.loss(image, target, dssim, ignored, movers_loss.movers_at(frame, progress))


def test_loss_is_the_static_loss_plus_softened_movers(pictures):
    image, target, movers = pictures
    movers_loss = SoftenedMovers(movers, W, span=(0.2, 0.5), block=16.0)
    assert movers_loss.block == 4 and movers_loss.margin == 1
    around = torch.zeros(H, W, dtype=torch.bool)
    around[39:61, 99:131] = True
    blocks = torch.zeros(23, 41, dtype=torch.bool)
    blocks[9:16, 24:33] = True
    expected = photometric(image, target, 0.2, around) + photometric(soft(image, 4), soft(target, 4), 0.2, ~blocks)
    assert loss_of(movers_loss, image, target, 0.2, None, 0, 0.49).item() == pytest.approx(
        float(expected.detach()), abs=1e-12
    )


def test_only_the_mean_of_what_moves_counts(pictures):
    """Details of moving areas may move within a pixel of the soft picture; details of static areas may not."""
    image, target, movers = pictures
    with torch.no_grad():
        image.copy_(target)
        swapped = image.clone()
        swapped[48:52, 108:112] = image[48:52, 108:112].flip(0, 1)
        still = image.clone()
        still[8:12, 8:12] = image[8:12, 8:12].flip(0, 1)
    movers_loss = SoftenedMovers(movers, W, span=(0.2, 0.5), block=16.0)
    assert float(loss_of(movers_loss, swapped, target, 0.2, None, 0, 0.2)) < 1e-9
    assert float(loss_of(movers_loss, still, target, 0.2, None, 0, 0.2)) > 1e-4
    for progress in (0.19, 0.5):
        assert float(loss_of(movers_loss, swapped, target, 0.2, None, 0, progress)) > 1e-4, (
            "before and later its details count"
        )


def test_softened_loss_attracts_a_distant_hand(pictures):
    """A bar of 2 px is 2.5 px from its place; at full resolution, small shifts do not change its error."""
    _, _, movers = pictures
    movers[0, :, 60:140] = True
    across = torch.arange(W, dtype=torch.float64) + 0.5

    def bar(at):
        return torch.sigmoid(6.0 * (1.0 - (across - at).abs()))[None, :, None].expand(H, W, 3)

    def pull(movers_loss):
        at = torch.tensor(99.5, dtype=torch.float64, requires_grad=True)
        loss_of(movers_loss, bar(at), bar(102.0), 0.0, None, 0, 0.2).backward()
        return float(at.grad)

    whole, softened = (pull(SoftenedMovers(m, W, span=(0.2, 0.5), block=16.0)) for m in (None, movers))
    assert softened < -1e-4 and abs(whole) < 0.1 * abs(softened)


def test_frames_without_movers_and_runs_without_mattes_are_as_published(pictures):
    image, target, movers = pictures
    expected = float(photometric(image, target, 0.2))
    assert float(loss_of(SoftenedMovers(movers, W, (0.2, 0.5), 16.0), image, target, 0.2, None, 1, 0.2)) == expected
    assert float(loss_of(SoftenedMovers(None, W, (0.2, 0.5), 16.0), image, target, 0.2, None, 0, 0.2)) == expected
    last = [SoftenedMovers(m, W, (0.2, 0.5), 16.0).until for m in (movers, torch.zeros_like(movers), None)]
    assert last == [0.5, 0.0, 0.0]
    one = SoftenedMovers(movers, W, (0.2, 0.5), block=3.0)
    assert float(loss_of(one, image, target, 0.2, None, 0, 0.2)) == expected, "one pixel"


def test_ignored_pixels_teach_nothing(pictures):
    image, target, movers = pictures
    ignored = torch.zeros(H, W, dtype=torch.bool)
    ignored[:, 90:] = True
    loss_of(SoftenedMovers(movers, W, (0.2, 0.5), 16.0), image, target, 0.2, ignored, 0, 0.2).backward()
    assert float(image.grad[:, 90:].abs().max()) == 0.0 and float(image.grad[:, :80].abs().max()) > 0.0


def test_published_settings_soften_nothing():
    assert config_from_params(TrainParams()).soft_movers > 0.0
    for published in (
        TrainParams(host_config="reference"),
        TrainParams(method="hexplane"),
        TrainParams(method="static"),
    ):
        assert config_from_params(published).soft_movers == 0.0
