"""Plate compositing in a world with exact ground truth: a wall, and a board in front that sways.

The model has exact geometry, but only soft colours. The plates also show fine stripes, which the model lacks.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, map_coordinates

from torch_backend.contract import CameraFrame, CameraPath, read_json
from torch_backend.deformation import Deformation, Deltas
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import read_png, write_png
from torch_backend.footage.plates import Plates
from torch_backend.freeze import bands
from torch_backend.freeze.composite.compositor import CompositeConfig, Compositor
from torch_backend.freeze.composite.warp import sample, snap
from torch_backend.freeze.frozen import OutputFrame, freeze_at, render_frozen
from torch_backend.gaussians import Gaussians
from torch_backend.gaussians.model import SH_C0
from torch_backend.motion.mattes import MOVING, PAINTED, STILL, write_matte
from torch_backend.scene import Scene
from torch_backend.sfm.masks import write_grey
from torch_backend.shot import Shot, write_json
from torch_backend.train import LoadedRun
from torch_backend.train.config import TrainConfig
from torch_backend.train.exposure import Exposure, ExposureConfig
from torch_backend.train.model import DynamicModel

W, H, FRAMES = 320, 240, 13
WALL, BOARD, HALF = 6.0, 4.0, (0.45, 0.6)
FOCAL = 300.0


SWAY = 0.8


def board_at(frame):
    """x of the board's centre at a frame; the board is centred at frame 7."""
    return SWAY * math.sin((frame - 7) * math.pi / 12)


def soft(x, y, board):
    """Soft colours [..., 3], which plates and model share."""
    if board:
        return np.stack([0.75 + 0.08 * np.sin(4 * x), 0.45 + 0.05 * np.cos(5 * y), 0.35 + 0 * x], -1)
    wave = 0.12 * np.sin(1.7 * x + 0.5) * np.cos(1.3 * y)
    return np.stack([0.35 + wave, 0.45 + wave, 0.5 - 0.5 * wave], -1)


def fine(x, y, board):
    """Fine stripes [...], which only the plates have."""
    step = 0.09 if board else 0.14
    return 0.1 * np.sin(2 * math.pi * x / step) * np.cos(2 * math.pi * y / step)


def seen(viewmat, board, beyond=(0, 0)):
    """(display-referred picture [H, W, 3] float64, mask of the board [H, W]); the board's centre is at x = `board`."""
    y, x = np.mgrid[-beyond[1] : H + beyond[1], -beyond[0] : W + beyond[0]] + 0.5
    rays = np.stack([(x - W / 2) / FOCAL, (y - H / 2) / FOCAL, np.ones_like(x)], -1)
    centre = -np.asarray(viewmat, np.float64)[:3, 3]  # cameras are not rotated
    places = [centre + rays * (z - centre[2]) for z in (WALL, BOARD)]
    on = (abs(places[1][..., 0] - board) < HALF[0]) & (abs(places[1][..., 1]) < HALF[1])
    pictures = []
    for place, is_board in zip(places, (False, True), strict=True):
        across, down = place[..., 0] - (board if is_board else 0.0), place[..., 1]
        pictures.append(soft(across, down, is_board) + fine(across, down, is_board)[..., None])
    return np.where(on[..., None], pictures[1], pictures[0]), on


def sheet(x, y, z, step, board):
    xs, ys = torch.meshgrid(torch.arange(*x, step), torch.arange(*y, step), indexing="ij")
    places = torch.stack([xs.flatten(), ys.flatten(), torch.full_like(xs.flatten(), z)], 1)
    colors = torch.from_numpy(soft(*places[:, :2].double().numpy().T, board)).float()
    quats = torch.zeros(len(places), 4)
    quats[:, 0] = 1.0
    flat = torch.tensor([0.6 * step, 0.6 * step, 0.05 * step]).log()
    return {
        "means": places,
        "quats": quats,
        "log_scales": flat.repeat(len(places), 1),
        "opacity_logits": torch.full((len(places),), 4.0),
        "sh0": ((colors - 0.5) / SH_C0)[:, None],
        "shN": torch.zeros(len(places), 0, 3),
    }


class Sways(Deformation):
    """The board's exact motion."""

    def forward(self, means, times, host_params=None):
        x = SWAY * torch.sin((times * (FRAMES - 1) - 6) * math.pi / 12).expand(len(means))
        return Deltas(torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], 1))


@dataclass
class World:
    shot: Shot
    scene: Scene
    run: LoadedRun
    still: bool

    def plates(self):
        return Plates(self.shot)

    def compositor(self):
        # Geometry is exact here; the default expects the depth errors of a real model.
        return Compositor(self.run, self.scene, self.plates(), CompositeConfig(depth_error=0.01))

    def output(self, frame, t_star):
        """Output frame of a take at the clip's own pose."""
        K = self.scene.camera_at(W, H)[frame - 1]
        return OutputFrame(frame, self.scene.viewmats[frame - 1], K, float(t_star), float(frame))

    def make(self, output, compositor=None, beyond=(0, 0), withheld=()):
        frozen = freeze_at(self.run.model, self.scene.time_of_frame(output.t_star), 1.0)
        K = output.K.clone()
        K[:2, 2] += torch.tensor(beyond)
        size, at = (W + 2 * beyond[0], H + 2 * beyond[1]), self.scene.time_of_frame(output.exposed_like)
        image = render_frozen(frozen, output.viewmat, K, *size, self.run.model.exposure, at)
        return (compositor or self.compositor()).frame(output, frozen, image, W, H, withheld)

    def truth(self, output):
        """(picture [H, W, 3] of the frozen instant, mask of the board)."""
        return seen(output.viewmat, 99.0 if self.still else board_at(output.t_star))

    def seen_at(self, frame):
        """(picture of plate `frame`, mask of the board)."""
        return seen(self.scene.viewmats[frame - 1], 99.0 if self.still else board_at(frame))


def path():
    """[FRAMES, 4, 4] cameras of the clip, without rotation."""
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(0.35, -0.35, FRAMES)
    viewmats[:, 1, 3] = 0.05 * torch.sin(torch.arange(FRAMES) * 1.3)
    return viewmats


def build(folder, report, still=False, logo=None, drawn=None):
    """Write a shot as import, solve and painted mattes leave it: 16-bit plates, working frames half as large.

    `logo` [H, W] bool is burnt into all plates and masked in the solve. `drawn(picture, n)` changes plate n.
    """
    viewmats = path()
    shot, source = Shot.create(folder / "board.splannequin"), folder / "source"
    source.mkdir()
    painted = {}
    for n in range(1, FRAMES + 1):
        picture, on = seen(viewmats[n - 1], 99.0 if still else board_at(n))
        if logo is not None:
            picture = np.where(logo[..., None], [1.0, 0.0, 1.0], picture)
        if drawn is not None:
            picture = drawn(picture, n)
        write_png(source / f"{n:06d}.png", np.rint(picture * 65535).astype(np.uint16))
        painted[n] = np.where(on[::2, ::2], MOVING, STILL).astype(np.uint8)
    import_footage(shot, str(source), FootageConfig(working_height=H // 2), report)
    (shot.root / PAINTED).mkdir()
    for n, matte in painted.items():
        write_matte(shot.root / PAINTED / f"{n:06d}.png", matte)
    solved(shot, viewmats)
    if logo is not None:
        ignore(shot, logo[::2, ::2])
    width, height = W // 2, H // 2
    times = np.linspace(0, 1, FRAMES)
    K = torch.tensor([[FOCAL / 2, 0, width / 2], [0, FOCAL / 2, height / 2], [0, 0, 1.0]])
    scene = Scene(
        list(range(1, FRAMES + 1)), times, times, viewmats, K.repeat(FRAMES, 1, 1), width, height,
        list(range(FRAMES)), torch.zeros(1, 3), torch.zeros(1, 3), 1.0, np.zeros(3), shot.frames,
    )  # fmt: skip
    parts = [sheet((-4.6, 4.6), (-3.4, 3.4), WALL, 0.09, False)]
    if not still:
        parts.append(sheet((-HALF[0], HALF[0]), (-HALF[1], HALF[1]), BOARD, 0.03, True))
    gaussians = Gaussians({name: torch.cat([part[name] for part in parts]) for name in parts[0]}, FRAMES)
    gaussians.open[len(parts[0]["means"]) :] = True
    gaussians.support[:] = True
    exposure = Exposure(torch.from_numpy(times).float(), ExposureConfig())
    model = DynamicModel(gaussians, None if still else Sways(), torch.from_numpy(times).float(), 0, exposure)
    run = LoadedRun(shot.run("main"), TrainConfig(), model, width, height, scene.frames, "")
    return World(shot, scene, run, still)


def solved(shot, viewmats):
    """Write a solve without lens distortion."""
    width, height = W // 2, H // 2
    k = [FOCAL / 2, FOCAL / 2, width / 2, height / 2]
    cameras = [CameraFrame(n, v.flatten().tolist(), k) for n, v in enumerate(viewmats, 1)]
    shot.solve.mkdir(exist_ok=True)
    write_json(shot.solve / "cameras.json", CameraPath(width, height, cameras).to_json())
    record = {"version": 1, "key": "k", "camera_model": "SIMPLE_RADIAL", "distortion": [0.0], "focal_px": FOCAL / 2}
    write_json(shot.solve / "solve.json", record)
    for n in range(1, len(viewmats) + 1):
        write_png(shot.frames / f"{n:06d}.png", read_png(shot.frames / "raw" / f"{n:06d}.png"))


def ignore(shot, logo):
    """Write the mask that a solve stores with its cameras."""
    write_json(shot.solve_record, {**read_json(shot.solve_record), "masks": {"ignore": {"key": "logo"}}})
    shot.masks("ignore").mkdir()
    for n in range(1, FRAMES + 1):
        write_grey(shot.mask("ignore", n), np.where(logo, np.uint8(255), np.uint8(0)))


@pytest.fixture(scope="module")
def still_world(tmp_path_factory, quiet):
    return build(tmp_path_factory.mktemp("still"), quiet(), still=True)


@pytest.fixture(scope="module")
def composited(world):
    """composited(pose, t*): composited frame, computed once."""
    compositor, frames = world.compositor(), {}

    def get(frame, t_star):
        if (frame, t_star) not in frames:
            frames[frame, t_star] = world.make(world.output(frame, t_star), compositor)
        return frames[frame, t_star]

    return get


def dilate(mask, by):
    return binary_dilation(mask, np.ones((2 * by + 1,) * 2))


def rms_error(a, b, where):
    """Root mean squared difference of the pixels in `where`."""
    return float(np.sqrt(np.square(np.asarray(a, np.float64) - np.asarray(b))[where].mean()))


def identity(width=W, height=H):
    s, t = (np.arange(width) + 0.5) / width, 1.0 - (np.arange(height) + 0.5) / height
    return torch.from_numpy(np.stack(np.meshgrid(s, t), -1))


def assert_is_plate(frame, plate, where):
    assert (frame.matte.numpy()[where] == 1.0).all()
    assert (frame.plate.numpy()[where] == 1.0).all() and (frame.alpha.numpy()[where] == 1.0).all()
    assert (frame.fill.numpy()[where] == 0.0).all()
    assert (frame.source.numpy()[where] == frame.primary).all()
    assert (frame.st.numpy()[where] == snap(identity(), (W, H)).numpy()[where]).all()
    np.testing.assert_allclose(frame.linear.numpy()[where], plate.numpy()[where], rtol=1e-6, atol=1e-9)


def test_a_still_world_is_the_plate(still_world):
    plates, everywhere = still_world.plates(), np.ones((H, W), bool)
    assert (plates.width, plates.height) == (W, H)
    result = still_world.make(still_world.output(3, 11))
    assert result.primary == 3
    assert_is_plate(result, plates.linear(3), everywhere)
    np.testing.assert_allclose(result.color, plates.display(3), atol=2e-6)
    assert np.abs(result.color.numpy() - still_world.seen_at(3)[0]).max() < 2e-5


@pytest.mark.parametrize(("frame", "t_star"), [(3, 11), (9, 4)])
def test_static_pixels_equal_the_plate(world, composited, frame, t_star):
    where = ~dilate(world.seen_at(frame)[1] | world.truth(world.output(frame, t_star))[1], 24)
    assert where.mean() > 0.5
    assert_is_plate(composited(frame, t_star), world.plates().linear(frame), where)


@pytest.mark.parametrize(("frame", "t_star"), [(3, 11), (9, 4)])
def test_the_board_is_where_it_was_at_t_star_and_has_its_stripes(world, composited, frame, t_star):
    output, result = world.output(frame, t_star), composited(frame, t_star)
    truth, on = world.truth(output)
    gone = world.seen_at(frame)[1] & ~dilate(on, 4)
    inner, hole = ~dilate(~on, 4), ~dilate(~gone, 3)
    assert inner.sum() > 1000 and hole.sum() > 400
    for where in (inner, hole):
        assert rms_error(result.color, truth, where) < 0.4 * rms_error(result.splat, truth, where)
    assert np.median(result.source.numpy()[inner]) == t_star, "plate t* knows best what it shows"
    assert not (result.source.numpy()[hole] == frame).any(), "the own plate shows the board there"
    assert result.plate.numpy()[hole].mean() > 0.9


def test_what_still_is_in_one_plate_only_differs_between_two_instants(world, composited):
    early, late = composited(9, 4), composited(9, 11)
    truths = [world.truth(world.output(9, t)) for t in (4, 11)]
    touched = dilate(truths[0][1] | truths[1][1] | world.seen_at(9)[1], 16)
    moved = np.abs(truths[0][0] - truths[1][0]).max(-1) > 0.15
    difference = (early.linear - late.linear).abs().numpy().max(-1)
    assert (difference[~touched] == 0).all() and (~touched).sum() > 20_000
    assert moved.sum() > 2000 and (difference[moved] > 0.05).mean() > 0.8


def test_warp_matte_and_fill_are_the_frame(world, composited):
    turned = replace_pose(world.output(5, 7), [0.04, 0.02, 0.1])
    for result in (composited(3, 11), composited(9, 4), world.make(turned)):
        plate = world.plates().linear(result.primary)
        again = result.matte[..., None] * sample(plate, result.st) + result.fill
        np.testing.assert_allclose(result.linear, again, atol=2e-6)
        assert ((result.fill == 0).all(-1) | (result.matte < 1)).all()


def replace_pose(output, shift):
    """Output of a moved camera, as in an artist's camera path."""
    viewmat = output.viewmat.clone()
    viewmat[:3, 3] += torch.tensor(shift)
    return replace(output, viewmat=viewmat, exposed_like=output.t_star)


def test_frame_at_t_star_equals_its_plate(world, composited):
    assert_is_plate(composited(11, 11), world.plates().linear(11), np.ones((H, W), bool))
    assert composited(11, 11).motion.numpy()[~dilate(~world.seen_at(11)[1], 3)].min() > 0.9


@pytest.mark.parametrize(("frame", "t_star"), [(3, 11), (9, 4)])
def test_plate_may_be_used_where_the_motion_matte_is_black(world, composited, frame, t_star):
    """Where the board has left its place by t*, the matte must be white: the plate would show the board twice."""
    result = composited(frame, t_star)
    gone = world.seen_at(frame)[1] & ~world.truth(world.output(frame, t_star))[1]
    assert gone.mean() > 0.02 and (result.motion.numpy()[gone] > 0.9).mean() > 0.95
    share = result.motion.numpy()[..., None]
    plate = world.plates().linear(frame).numpy()
    through = share * result.linear.numpy() + (1.0 - share) * plate
    assert np.abs(through - result.linear.numpy())[gone].mean() < 0.01
    assert result.motion.mean() < 0.6, "the room stays as it was"


def test_swaying_texture_comes_from_warped_neighbour_plates(world):
    """At the end of its path the board moves by 2 pixels per frame, which is half a stripe."""
    output = world.output(12, 13)
    result = world.make(output, withheld=[13])
    truth, on = world.truth(output)
    inner = ~dilate(~on, 6)
    assert rms_error(result.color, truth, inner) < 0.6 * rms_error(result.splat, truth, inner)
    assert set(np.unique(result.source.numpy()[inner])) <= {10.0, 11.0, 12.0}


def test_frame_plate_compensates_wrong_depth_far_from_t_star(tmp_path, quiet, monkeypatch):
    """Between the ends of the path, a depth error of 3 % shifts the stripes of plate t* by a quarter."""
    monkeypatch.setitem(globals(), "SWAY", 0.003)
    world = build(tmp_path, quiet())
    means = world.run.model.gaussians.params["means"]
    with torch.no_grad():
        means[world.run.model.open_rows()] *= 1.03
    output = world.output(13, 1)
    truth, on = world.truth(output)
    inner = ~dilate(~on, 6)
    one, both = (
        world.make(output, Compositor(world.run, world.scene, world.plates(), CompositeConfig(sway_trust=trust)))
        for trust in (0.0, CompositeConfig().sway_trust)
    )
    assert one.plate.numpy()[inner].min() > 0.5
    assert rms_error(both.color, truth, inner) < 0.8 * rms_error(one.color, truth, inner)


def test_masked_logo_is_filled_from_other_plates(tmp_path, quiet):
    logo = np.zeros((H, W), bool)
    logo[150:170, 40:70] = True
    world = build(tmp_path, quiet(), still=True, logo=logo)
    output = world.output(4, 9)
    frame, (truth, _) = world.make(output), world.truth(output)
    assert (frame.matte.numpy()[logo] == 0.0).all() and (frame.motion.numpy()[logo] > 0.999).all()
    assert rms_error(frame.color, truth, logo) < 0.03 < rms_error(frame.splat, truth, logo)
    assert (frame.plate.numpy()[logo] > 0.5).mean() > 0.9 and (frame.source.numpy()[logo] != 4).all()
    far_from_logo = ~dilate(logo, 16)
    assert (frame.matte.numpy()[far_from_logo] == 1.0).all()
    write_json(world.shot.solve_record, {**read_json(world.shot.solve_record), "masks": {}})
    assert rms_error(world.make(output).color, truth, logo) > 0.3, "else there is nothing to mask"


def test_withheld_plates_are_not_used(tmp_path, quiet):
    world = build(tmp_path, quiet())
    assert 3 not in (1, FRAMES // 2 + 1, FRAMES), "those are looked at to know the footage"
    compositor = world.compositor()
    before = {(n, t): world.make(world.output(n, t), compositor, withheld=[3]) for n, t in ((3, 11), (5, 3))}
    used = world.make(world.output(5, 3), compositor)
    for path, pixels in (
        (tmp_path / "source" / "000003.png", np.zeros((H, W, 3), np.uint16)),
        (world.shot.frames / "000003.png", np.zeros((H // 2, W // 2, 3), np.uint8)),
    ):
        write_png(path, pixels)
    compositor = world.compositor()
    for (n, t), want in before.items():
        found = world.make(world.output(n, t), compositor, withheld=[3])
        for name in ("linear", "plate", "source", "alpha", "motion", "st", "matte", "fill"):
            assert torch.equal(getattr(found, name), getattr(want, name)), (n, t, name)
        assert not (found.source == 3).any()
    again = world.make(world.output(5, 3), compositor)
    assert not torch.equal(again.linear, used.linear), "else the test tests nothing"


def test_withheld_plate_is_replaced_by_other_plates(still_world):
    output = still_world.output(8, 11)
    result = still_world.make(output, withheld=[8])
    truth, _ = still_world.truth(output)
    everywhere = np.ones((H, W), bool)
    assert rms_error(result.color, truth, everywhere) < 0.5 * rms_error(result.splat, truth, everywhere)
    assert not (result.source == 8).any() and result.plate.mean() > 0.95


def test_custom_camera_uses_the_nearest_plate(world):
    output, nearest = replace_pose(world.output(9, 10), (0.2, 0.0, 0.0)), 6
    result = world.make(output)
    distances = (world.scene.viewmats[:, :3, 3] - output.viewmat[:3, 3]).norm(dim=1)
    assert abs(int(distances.argmin()) + 1 - nearest) <= 1, "the test's own arithmetic"
    assert result.primary == int(distances.argmin()) + 1
    truth, on = world.truth(output)
    inner = ~dilate(~on, 4)
    wall = ~dilate(on, 8)
    for where in (inner, wall):
        assert rms_error(result.color, truth, where) < 0.6 * rms_error(result.splat, truth, where)
    assert bool(torch.isfinite(result.linear).all()) and result.plate.mean() > 0.8


def test_custom_camera_at_a_clip_pose_equals_that_plate(still_world):
    output = replace(still_world.output(9, 4), frame=1001, exposed_like=4.0)
    result = still_world.make(output)
    assert result.primary == 9
    # Between two cameras at one place, a wrong depth moves nothing.
    assert (result.st - identity()).abs().max() < 0.02 / W
    assert rms_error(result.color, still_world.seen_at(9)[0], np.ones((H, W), bool)) < 2e-3


def test_another_lens_at_a_pose_of_the_clip_is_not_that_plate(still_world):
    output = still_world.output(9, 9)
    output.K = output.K * torch.tensor([[1.5], [1.5], [1.0]])
    output.K[:2, 2] = torch.tensor([W / 2, H / 2])
    result = still_world.make(output)
    middle = (slice(H // 2 - H // 8, H // 2 + H // 8), slice(W // 2 - W // 8, W // 2 + W // 8))
    rows, columns = np.mgrid[:H, :W]
    shown, _ = still_world.seen_at(9)
    at = ((rows + 0.5 - H / 2) / 1.5 + H / 2 - 0.5, (columns + 0.5 - W / 2) / 1.5 + W / 2 - 0.5)
    truth = np.stack([map_coordinates(shown[..., c], at, order=3) for c in range(3)], -1)
    inside = np.zeros((H, W), bool)
    inside[middle] = True
    assert rms_error(result.color, truth, inside) < 0.3 * rms_error(result.splat, truth, inside)


def test_far_from_every_plate_a_frame_fades_to_splats(still_world):
    output = replace_pose(still_world.output(7, 7), [0.0, 0.0, 40.0])
    result = still_world.make(output)
    assert result.plate.mean() < 0.2
    difference = (result.color - result.splat).abs() * (1 - result.plate)[..., None]
    assert difference.mean() < 0.01


def test_overscan_goes_on_around_the_same_frame(world, composited):
    frame, t_star, (across, down) = 9, 4, (24, 16)
    inside, wide = composited(frame, t_star), world.make(world.output(frame, t_star), beyond=(across, down))
    assert wide.linear.shape == (H + 2 * down, W + 2 * across, 3)
    middle = (slice(down, -down), slice(across, -across))
    around = [world.seen_at(frame + step)[1] for step in (-1, 0, 1)]  # neighbouring plates affect the result
    still = ~dilate(np.any([*around, world.truth(world.output(frame, t_star))[1]], axis=0), 16)
    still[:4] = still[-4:] = still[:, :4] = still[:, -4:] = False  # mattes fade at the plate's border
    for name in ("linear", "st", "matte", "plate", "source"):
        np.testing.assert_array_equal(getattr(wide, name)[middle][still], getattr(inside, name)[still], err_msg=name)
    assert (wide.color[middle] - inside.color).abs().mean() < 2e-3
    around = torch.ones(wide.alpha.shape, dtype=torch.bool)
    around[middle] = False
    assert not wide.matte[around].any(), "the plate shows nothing there"
    left = wide.st[:, :across, 0]
    assert bool((left < 0).all()), "and the map says so"
    truth, _ = seen(world.scene.viewmats[frame - 1], board_at(t_star), (across, down))
    strip = np.zeros(around.shape, bool)
    strip[down:-down, : across - 4] = strip[down:-down, -across + 4 :] = True
    strip &= wide.plate.numpy() > 0.9
    assert strip.sum() > 200
    assert rms_error(wide.color, truth, strip) < 0.7 * rms_error(wide.splat, truth, strip), (
        "other plates show more of the wall"
    )


def test_frame_is_independent_of_earlier_frames(world, composited):
    composited(3, 11)
    single, want = world.make(world.output(9, 4)), composited(9, 4)
    for name in vars(want):
        a, b = getattr(single, name), getattr(want, name)
        if isinstance(a, dict):
            assert a.keys() == b.keys() and all(torch.equal(a[term], b[term]) for term in a), name
        else:
            assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, name


@pytest.mark.parametrize("case", ["wide", "elsewhere"])
def test_frame_is_identical_when_computed_in_row_bands(world, monkeypatch, case):
    output = world.output(9, 4)
    if case == "elsewhere":
        output = replace_pose(output, [0.1, -0.2, 0.3])
    options = {"beyond": (24, 16) if case == "wide" else (0, 0), "withheld": (9,) if case == "elsewhere" else ()}
    whole = world.make(output, **options)
    monkeypatch.setattr(bands, "BAND_PIXELS", 23 * W)
    parts = world.make(output, **options)
    assert len(bands.bands(H, W)) == 11
    assert (parts.source != whole.source).float().mean() < 1e-4, "but where two plates give the same"
    for name in [*vars(whole), "color"]:
        a, b = getattr(parts, name), getattr(whole, name)
        if isinstance(a, torch.Tensor) and name != "source":
            np.testing.assert_allclose(a, b, atol=1e-4, err_msg=name)  # half floats near 0.5 have errors of 2.4e-4


def test_bars_come_from_the_plate_of_the_frame(world):
    """Bars are not part of the scene, so neither splats nor other plates show anything there."""
    output, bars = world.output(4, 7), np.zeros((H, W), bool)
    bars[:, : W // 2] = True  # also covers the board, whose pixels must come from t*
    config = CompositeConfig(depth_error=0.01)
    compositor = Compositor(
        world.run, world.scene, world.plates(), config, bars=lambda frame: bars if frame == 4 else None
    )
    with_bars, plain = world.make(output, compositor, (3, 2)), world.make(output, None, (3, 2))
    inner = (slice(2, -2), slice(3, -3))
    plate = world.plates().linear(4)
    assert torch.equal(with_bars.linear[inner][bars], plate[bars]) and not torch.equal(
        plain.linear[inner][bars], plate[bars]
    )
    for name, value in (("matte", 1.0), ("support", 1.0), ("motion", 0.0), ("plate", 1.0), ("source", 4.0)):
        assert (getattr(with_bars, name)[inner][bars] == value).all(), name
