"""A wall and an arm that the model knows, a hand that it does not: found, as deep as it is, and nothing else."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torch_backend.contract import Cancelled
from torch_backend.footage.images import write_png
from torch_backend.freeze.frozen import FrozenGaussians, freeze_at, render_frozen
from torch_backend.freeze.instant_bench import InstantBench, InstantConfig, low_difference
from torch_backend.freeze.instant_depth import DepthConfig, as_field
from torch_backend.freeze.instant_track import Track
from torch_backend.freeze.missing_layer import _crumbs, _helps, _thing_cover, instant_layer, join
from torch_backend.gaussians import Gaussians
from torch_backend.gaussians.model import SH_C0
from torch_backend.scene import Scene
from torch_backend.train import LoadedRun
from torch_backend.train.config import TrainConfig
from torch_backend.train.exposure import Exposure, ExposureConfig
from torch_backend.train.model import DynamicModel

W, H, FRAMES, T_STAR = 192, 144, 13, 7
WALL, ARM = 6.0, 3.0
FOCAL = 180.0


def sheet(x, y, z, step, color):
    """State of Gaussians on a grid x (from, to), y (from, to) at a depth, `step` apart; color(x, y) -> [N, 3]."""
    xs, ys = torch.meshgrid(torch.arange(x[0], x[1], step), torch.arange(y[0], y[1], step), indexing="ij")
    places = torch.stack([xs.flatten(), ys.flatten(), torch.full_like(xs.flatten(), z)], 1)
    count = len(places)
    return {
        "means": places,
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "log_scales": torch.full((count, 3), math.log(0.7 * step)),
        "opacity_logits": torch.full((count,), 3.0),
        "sh0": ((color(places[:, 0], places[:, 1]) - 0.5) / SH_C0)[:, None],
        "shN": torch.zeros(count, 0, 3),
    }


def wall(fine=0.0, half=4.5):
    """A wall of dull spots; `fine`: how strong a texture of 2 px squares is on it; `half`: of its width."""

    def color(x, y):
        spots = 0.35 + 0.12 * torch.sin(2.1 * x + 0.7) * torch.cos(1.7 * y) + 0.08 * torch.sin(5.3 * x + 3.9 * y)
        squares = torch.where(((x / 0.07).floor() + (y / 0.07).floor()) % 2 > 0, fine, -fine)
        return (spots + squares)[:, None] * torch.tensor([0.8, 0.9, 1.0])

    return sheet((-half, half), (-3.2, 3.2), WALL, 0.07, color)


def skin(x, y):
    shade = 0.04 * torch.sin(23.0 * x) * torch.cos(19.0 * y)
    return torch.tensor([0.9, 0.6, 0.5]) + shade[:, None]


def arm(half=0.12):
    return sheet((0.1, 0.9), (-half, half), ARM, 0.02, skin)


def hand(n, drift=(0.02, 0.05), start=(-0.28, 0.0), z=ARM):
    """A hand at the arm's end, which goes by `drift` scene units a frame, and is in place at t*."""
    at = [s + d * (n - T_STAR) for s, d in zip(start, drift, strict=True)]
    state = sheet((-0.2, 0.38), (-0.2, 0.2), z, 0.02, skin)
    return {**state, "means": state["means"] + torch.tensor([*at, 0.0])}


def together(*states):
    return {name: torch.cat([state[name] for state in states]) for name in states[0]}


def frozen_of(state, motion=None):
    count = len(state["means"])
    return FrozenGaussians(state, 0, torch.ones(count), torch.zeros(count) if motion is None else motion)


@dataclass
class World:
    """A clip of what `shown(n)` is at frame n, and a model of what `known` is."""

    scene: Scene
    run: LoadedRun
    frozen: FrozenGaussians

    def image(self, state, n):
        scene = self.scene
        return render_frozen(frozen_of(state), scene.viewmats[n - 1], scene.Ks[n - 1], W, H).color.numpy()

    def layer(self, motion=None, config=None):
        return instant_layer(self.run, self.scene, self.frozen, T_STAR, config, motion)

    def found(self):
        layer = self.layer()
        assert layer is not None
        return layer


def scene_at(folder, far=0.7):
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    # The camera sways on its way: a steady one cannot be told from a hand's steady motion.
    viewmats[:, 0, 3] = torch.linspace(far, -far, FRAMES)
    viewmats[:, 1, 3] = 0.06 * torch.sin(torch.arange(FRAMES) * 1.3)
    # Never through level: Gaussians of one depth would change their order, and the wall would jump by a pixel.
    tilt = 0.03 + 0.02 * torch.sin(torch.arange(FRAMES) * 0.9)
    viewmats[:, 1, 1] = viewmats[:, 2, 2] = torch.cos(tilt)
    viewmats[:, 2, 1], viewmats[:, 1, 2] = torch.sin(tilt), -torch.sin(tilt)
    K = torch.tensor([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]])
    times = np.linspace(0, 1, FRAMES)
    return Scene(
        list(range(1, FRAMES + 1)), times * FRAMES / 24, times, viewmats, K.repeat(FRAMES, 1, 1), W, H,
        list(range(FRAMES)), torch.zeros(1, 3), torch.zeros(1, 3), 1.0, np.zeros(3), folder,
    )  # fmt: skip


def world(folder, known, shown, drawn=None, exposed=(0.0, 0.0), motion=None, far=0.7):
    """`drawn(picture, n)` changes plate n; `exposed`: log-gain and offset that plates and model have; `far`: the camera
    goes so far to either side."""
    scene = scene_at(folder, far)
    gaussians = Gaussians(known, FRAMES)
    gaussians.support[:] = True
    exposure = Exposure(torch.from_numpy(scene.times).float(), ExposureConfig())
    exposure.values.data[:] = torch.tensor(exposed)[:, None]
    model = DynamicModel(gaussians, None, torch.from_numpy(scene.times).float(), 0, exposure)
    run = LoadedRun(folder, TrainConfig(), model, W, H, scene.frames, "")
    frozen = freeze_at(model, float(scene.times[T_STAR - 1]), 1.0)
    if motion is not None:
        frozen.motion = motion
    made = World(scene, run, frozen)
    for n in scene.frames:
        picture = made.image(shown(n), n) * math.exp(exposed[0]) + exposed[1]
        picture = picture if drawn is None else drawn(picture, n)
        write_png(folder / f"{n:06d}.png", (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
    return made


@pytest.fixture(scope="module")
def waving(tmp_path_factory):
    static = together(wall(), arm())
    return world(tmp_path_factory.mktemp("waving"), static, lambda n: together(static, hand(n)))


def where(made, state, n=T_STAR):
    """Pixels [H, W] of plate n that show a state, wholly."""
    frozen = frozen_of(state)
    return render_frozen(frozen, made.scene.viewmats[n - 1], made.scene.Ks[0], W, H).alpha.numpy() > 0.9


def stops_when_asked(work, times=3):
    """`work(check)` is cancelled by the `times`-th call of check, and calls it no more."""
    asked = []

    def check():
        asked.append(1)
        if len(asked) == times:
            raise Cancelled

    with pytest.raises(Cancelled):
        work(check)
    return len(asked) == times


def test_a_hand_that_the_model_lacks_is_found_as_deep_as_the_arm_it_hangs_on(waving):
    layer = waving.found()
    truth = where(waving, hand(T_STAR)) & ~where(waving, arm())
    found = layer.mask.numpy() > 0.5
    assert (found & truth).sum() / (found | truth).sum() > 0.8
    depths = layer.state["means"][:, 2].numpy()
    assert abs(np.median(depths) / ARM - 1) < 0.06
    assert np.percentile(np.abs(depths / ARM - 1), 95) < 0.15
    assert layer.frame == T_STAR and not layer.ghost.any() and bool((layer.kept == 1).all())


def test_from_every_pose_the_frozen_scene_shows_the_hand_of_t_star(waving):
    joined = join(waving.frozen, waving.found())
    known = waving.frozen.state
    truth_state = together(known, hand(T_STAR))
    for n in (1, 4, T_STAR, 10, FRAMES):
        truth = waving.image(truth_state, n)
        without, shown = waving.image(known, n), waving.image(joined.state, n)
        changed = np.abs(truth - without).max(-1) > 0.1
        before, after = (np.square(image - truth)[changed].mean() for image in (without, shown))
        assert changed.sum() > 200
        assert after < 0.25 * before, f"frame {n}: {before:.4f} {after:.4f}"
        away = np.abs(truth - shown).max(-1)[~changed]
        assert (away > 0.15).mean() < 0.01


def test_twice_as_large_the_layer_has_no_holes(waving):
    layer = waving.found()
    K = waving.scene.Ks[0].clone()
    K[:2] *= 2
    alone = join(frozen_of({k: v[:0] for k, v in waving.frozen.state.items()}), layer_alone(layer))
    image = render_frozen(alone, waving.scene.viewmats[T_STAR - 1], K, 2 * W, 2 * H)
    inside = np.kron(where(waving, hand(T_STAR)) & (layer.mask.numpy() > 0.9), np.ones((2, 2), bool))
    assert image.alpha.numpy()[inside].min() > 0.85
    assert image.motion.numpy()[inside].min() > 0.99 and image.support.numpy()[inside].min() > 0.99


def test_of_a_run_on_small_pictures_the_layer_is_as_sharp_as_the_plate(tmp_path):
    """Bright and dark stripes of 3 pixels, which pictures half as large show as grey."""

    def striped(n):
        state = hand(n)
        bright = ((state["means"][:, 0] / 0.05).floor() % 2 > 0).float()
        color = (0.3 + 0.6 * bright)[:, None] * torch.tensor([1.0, 0.7, 0.6])
        return {**state, "sh0": ((color - 0.5) / SH_C0)[:, None]}

    static = together(wall(), arm())
    made = world(tmp_path, static, lambda n: together(static, striped(n)))
    made.run.width, made.run.height = W // 2, H // 2
    truth = together(static, striped(T_STAR))
    errors, counts = [], []
    for width in (W // 2, W):
        layer = made.layer(config=InstantConfig(width=width))
        assert layer is not None and layer.mask.shape == (H // 2, W // 2)
        counts.append(len(layer.state["means"]))
        for n in (T_STAR, 10):
            seen = where(made, striped(T_STAR), n) & ~where(made, arm(), n)
            shown, target = (made.image(state, n) for state in (join(made.frozen, layer).state, truth))
            errors.append(np.square(shown - target)[seen].mean())
    assert 3.0 < counts[1] / counts[0] < 5.0, "four pixels of the plate for one of the run"
    assert errors[2] < 0.9 * errors[0] and errors[3] < 0.6 * errors[1], errors


def layer_alone(layer):
    layer.kept = layer.kept[:0]
    return layer


def test_nothing_is_found_where_plate_and_model_agree(tmp_path):
    static = together(wall(), arm())
    assert world(tmp_path, static, lambda n: static).layer() is None


def test_a_model_that_is_merely_soft_is_no_disagreement(tmp_path):
    assert world(tmp_path, together(wall()), lambda n: wall(fine=0.25)).layer() is None


def test_neither_lost_detail_nor_an_edge_out_of_place_is_a_difference_but_a_missing_thing_is():
    y, x = np.mgrid[:80, :120]
    soft = np.full((80, 120, 3), 0.5, np.float32)
    detailed = soft + 0.3 * np.where((x // 2 + y // 2) % 2 > 0, 1, -1)[..., None].astype(np.float32)
    edge, moved = (soft + 0.4 * np.sign(x - at)[..., None].astype(np.float32) for at in (60.5, 61.5))
    thing = soft + 0.3 * (np.hypot(x - 60, y - 40) < 6)[..., None].astype(np.float32)
    differences = [low_difference(a, b, 3.0, 1.0).max() for a, b in ((detailed, soft), (edge, moved), (thing, soft))]
    assert max(differences[:2]) < InstantConfig().grow and differences[2] > InstantConfig().seed
    assert np.abs(detailed - soft).max() > 0.25 and low_difference(edge, moved, 3.0, 0.0).max() > 0.09


def test_what_the_motion_matte_calls_still_is_left_alone(waving):
    still, moving = np.zeros((H, W), np.uint8), np.full((H // 2, W // 2), 255, np.uint8)
    asked = []
    assert waving.layer(lambda frame: asked.append(frame) or still) is None
    assert set(asked) == {T_STAR}
    assert waving.layer(lambda frame: moving) is not None


def test_a_thing_that_hangs_on_nothing_is_placed_by_its_parallax(tmp_path):
    """It goes up and down, and the camera to the side: how far it is shows along the lines, not across."""
    flies = lambda n: together(wall(), hand(n, drift=(0.0, 0.015), start=(-0.1, -0.3), z=4.0))  # noqa: E731
    layer = world(tmp_path, wall(), flies).found()
    assert abs(float(layer.state["means"][:, 2].median()) / 4.0 - 1) < 0.12
    assert layer.regions[0].attached < 0.5


def test_a_thing_that_stands_still_is_left_to_the_model(tmp_path):
    """Whether a matte is wrong about it or none is there: a sky that is modelled badly is no mover."""

    def color(x, y):
        return 0.7 + 0.25 * (torch.sin(9 * x + 4 * x * y) * torch.cos(8 * y + 3 * x * x))[:, None] * torch.tensor(
            [1.0, 0.8, 0.6]
        )

    poster = sheet((-1.2, 0.2), (-0.6, 0.4), WALL - 0.1, 0.04, color)
    still = world(tmp_path, wall(), lambda n: together(wall(), poster))
    assert still.layer() is None
    assert still.layer(lambda frame: np.full((H, W), 255, np.uint8)) is None


def test_the_outline_has_the_colour_of_the_hand_and_not_of_the_wall(waving):
    state = waving.found().state
    colors = (0.5 + SH_C0 * state["sh0"][:, 0])[state["opacity_logits"].sigmoid() > 0.4].numpy()
    assert np.abs(colors - [0.9, 0.6, 0.5]).max(1).mean() < 0.06
    assert (np.abs(colors - [0.9, 0.6, 0.5]).max(1) > 0.25).mean() < 0.02


def test_a_logo_on_the_picture_is_no_thing_in_the_scene(tmp_path):
    stamp = (np.indices((24, 24)).sum(0) // 4 % 2)[..., None] * np.ones(3)

    def drawn(picture, n):
        picture = picture.copy()
        picture[110:134, 150:174] = 0.3 * picture[110:134, 150:174] + 0.7 * stamp
        return picture

    assert world(tmp_path, wall(), lambda n: wall(), drawn).layer() is None


def pale(state, opacity):
    return {**state, "opacity_logits": torch.full_like(state["opacity_logits"], opacity)}


def test_a_hand_that_the_field_has_but_too_pale_is_as_deep_as_the_field_has_it(tmp_path):
    deep = 1.3 * ARM  # behind what it seems to hang on
    behind = {"start": (-0.36, 0.0), "drift": (0.02, 0.06), "z": deep}
    static, faint = together(wall(), arm()), pale(hand(T_STAR, **behind), -2.2)
    motion = torch.cat([torch.zeros(len(static["means"])), torch.ones(len(faint["means"]))])
    known = together(static, faint)
    made = world(tmp_path, known, lambda n: together(static, hand(n, **behind)), motion=motion)
    layer = made.found()
    depths = layer.state["means"][:, 2].numpy()
    assert abs(np.median(depths) / deep - 1) < 0.05
    truth_state = together(static, hand(T_STAR, **behind))
    for n in (1, FRAMES):
        truth, without = made.image(truth_state, n), made.image(known, n)
        changed = np.abs(truth - without).max(-1) > 0.1
        off = np.square(made.image(join(made.frozen, layer).state, n) - truth)[changed].mean()
        assert off < 0.25 * np.square(without - truth)[changed].mean()


def nearer(made_in, state, share=1 / 1.35):
    """The same to t*'s camera, at `share` of its distance."""
    view = scene_at(made_in).viewmats[T_STAR - 1]
    centre = -view[:3, :3].mT @ view[:3, 3]
    means = centre + share * (state["means"] - centre)
    return {**state, "means": means, "log_scales": state["log_scales"] + math.log(share)}


def test_a_hand_that_the_field_has_far_before_its_arm_stands_at_its_arm(tmp_path):
    true, behind = hand(T_STAR), together(wall(), arm(half=0.5))
    known = together(behind, pale(nearer(tmp_path, true), -2.2))
    motion = (torch.arange(len(known["means"])) >= len(behind["means"])).float()
    made = world(tmp_path, known, lambda n: together(behind, hand(n)), motion=motion)
    layer = made.found()
    assert abs(np.median(layer.state["means"][:, 2].numpy()) / ARM - 1) < 0.05
    assert bool((layer.kept[motion == 0] == 1).all())
    assert float((layer.kept[motion > 0] == 0).float().mean()) > 0.9
    for n in (1, FRAMES):
        truth, without = made.image(together(behind, true), n), made.image(known, n)
        changed = np.abs(truth - without).max(-1) > 0.1
        off = np.square(made.image(join(made.frozen, layer).state, n) - truth)[changed].mean()
        assert off < 0.25 * np.square(without - truth)[changed].mean()
    # Where no layer is good enough nothing is taken out either.
    assert made.layer(config=InstantConfig(gain=1.1, detail=1.1)) is None


def test_fingers_that_looked_right_do_not_stay_in_the_air_where_their_hand_was(tmp_path):
    true, behind = hand(T_STAR), together(wall(), arm(half=0.5))
    near, tips = nearer(tmp_path, true), (true["means"][:, 0] < -0.40) & (true["means"][:, 1].abs() < 0.05)
    near["opacity_logits"] = torch.where(tips, 3.0, -2.2)
    known = together(behind, near)
    motion = (torch.arange(len(known["means"])) >= len(behind["means"])).float()
    made = world(tmp_path, known, lambda n: together(behind, hand(n)), motion=motion)
    left = lambda layer: float(layer.kept[motion > 0][tips].mean())  # noqa: E731
    layer = made.found()
    assert left(layer) < 0.05 and bool((layer.kept[motion == 0] == 1).all())
    assert left(made.layer(config=InstantConfig(crumb=0.0))) > 0.3, "they are what this looks for"
    for n in (1, FRAMES):
        truth, without = made.image(together(behind, true), n), made.image(known, n)
        changed = np.abs(truth - without).max(-1) > 0.1
        off = np.square(made.image(join(made.frozen, layer).state, n) - truth)[changed].mean()
        assert off < 0.25 * np.square(without - truth)[changed].mean()


def test_what_is_left_of_a_thing_is_small_moves_and_is_as_deep_as_it(waving):
    """Not the other hand, not a shirt's button, and not what is farther away."""
    core = where(waving, hand(T_STAR))
    pieces = {
        "finger": sheet((-0.56, -0.50), (-0.05, 0.05), ARM, 0.02, skin),
        "other hand": sheet((-0.4, 0.0), (0.22, 0.6), ARM, 0.02, skin),
        "button": sheet((-0.3, -0.2), (-0.28, -0.22), ARM, 0.02, skin),
        "farther": sheet((-0.1 * 1.3, 0.0), (-0.28 * 1.3, -0.22 * 1.3), 1.3 * ARM, 0.02, skin),
    }
    counts = [len(wall()["means"]), *(len(piece["means"]) for piece in pieces.values())]
    owner = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    frozen = frozen_of(together(wall(), *pieces.values()), ((owner > 0) & (owner != 3)).float())
    bench = InstantBench(waving.run, waving.scene, T_STAR - 1, InstantConfig(), None)
    rows = _crumbs(bench, frozen, core, ARM)
    assert set(owner[rows].tolist()) == {1} and len(rows) > 0.9 * counts[1]


def test_a_trace_of_what_the_field_moves_tells_no_depth():
    inverse, region = np.zeros((40, 40), np.float32), np.zeros((40, 40), bool)
    region[10:30, 10:30] = True
    inverse[10:16, 10:30] = 0.2
    assert as_field(inverse, region, DepthConfig(), 1.0) is None
    inverse[10:20, 10:30], inverse[18:20, 10:30] = 0.25, 1.0  # and a stray in front
    told = as_field(inverse, region, DepthConfig(), 1.0)
    assert told is not None and np.allclose(told[region], 0.25 * (1.0 + DepthConfig().front), rtol=1e-3)


def test_moving_gaussians_before_what_plate_t_star_shows_are_faded(tmp_path):
    known = together(wall(), hand(T_STAR))
    motion = torch.cat([torch.zeros(len(wall()["means"])), torch.ones(len(hand(T_STAR)["means"]))])
    gone = world(tmp_path, known, lambda n: wall(), motion=motion)
    layer = gone.found()
    truth = where(gone, hand(T_STAR))
    assert (layer.ghost.numpy() & truth).sum() > 0.8 * truth.sum()
    assert len(layer.state["means"]) == 0
    assert bool((layer.kept[motion == 0] == 1).all()) and float(layer.kept[motion > 0].median()) < 0.1
    for n in (2, 12):
        truth = gone.image(wall(), n)
        before, after = (np.abs(gone.image(f.state, n) - truth).mean() for f in (gone.frozen, join(gone.frozen, layer)))
        assert after < 0.3 * before


def test_still_gaussians_are_never_faded(tmp_path):
    known = together(wall(), hand(T_STAR))
    layer = world(tmp_path, known, lambda n: wall()).layer()
    assert layer is None or bool((layer.kept == 1).all())


def test_the_layer_is_exposed_once_like_the_rest(tmp_path):
    static, exposed = together(wall(), arm()), (-0.2, 0.05)
    dark = world(tmp_path, static, lambda n: together(static, hand(n)), exposed=exposed)
    colors = 0.5 + SH_C0 * dark.found().state["sh0"][:, 0]
    assert np.allclose(colors.median(0).values.numpy(), [0.9, 0.6, 0.5], atol=0.03)


def test_small_things_are_left_alone(waving):
    assert waving.layer(config=InstantConfig(least=5000.0)) is None


def test_an_outline_a_pixel_aside_is_no_part_of_a_small_thing():
    """A leg that is known, but for a line of floor along it, and an apple that is not: both lie in what moves."""
    shown, plate = np.full((40, 60, 3), 0.7, np.float32), np.full((40, 60, 3), 0.7, np.float32)
    plate[5:35, 10:12] = plate[18:23, 40:45] = 0.1
    moves = np.zeros((40, 60), bool)
    moves[5:35, 10:24] = moves[17:24, 39:46] = True
    bench = object.__new__(InstantBench)
    bench.unit, bench.view = 1.0, SimpleNamespace(picture=plate)
    thing = Track(moves, np.full(3, 0.1, np.float32), {})
    cover = _thing_cover(bench, SimpleNamespace(color=torch.from_numpy(shown)), thing)
    assert cover[18:23, 40:45].mean() > 0.8
    assert not cover[:, :30].any()


def test_a_hand_that_the_field_has_without_fingers_is_given_those_of_the_plate():
    """Low-passed, a blurred hand is as right as a sharp one can be."""
    plate = np.full((60, 80, 3), 0.2, np.float32)
    where = np.zeros((60, 80), bool)
    where[20:40, 30:50] = True
    plate[20:40, 30:50] += np.where(np.arange(20) % 4 < 2, 0.6, 0.2)[None, :, None].astype(np.float32)
    bench = object.__new__(InstantBench)
    bench.config, bench.unit, bench.ignored, bench.view = InstantConfig(), 1.0, None, SimpleNamespace(picture=plate)
    bench.width, bench.height = 80, 60

    def image(color):
        return SimpleNamespace(color=torch.from_numpy(color.astype(np.float32)))

    blurred = plate.copy()
    blurred[where] = 0.6 + 0.021  # the mean of fingers and of what is between them, a little too bright
    sharp, pale = plate + 0.02 * where[..., None], plate + 0.05 * where[..., None]
    assert _helps(bench, image(sharp), image(blurred), where)
    assert not _helps(bench, image(blurred), image(blurred), where), "nothing gained"
    assert not _helps(bench, image(pale), image(blurred), where), "sharp, and farther from the plate's colour"
    bench.config = InstantConfig(detail=1.1)
    assert not _helps(bench, image(sharp), image(blurred), where), "by its low-pass alone it would be left away"
