"""The kernel that fills pixels from several plates against its definition in float64."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from torch_backend.freeze.composite.config import CompositeConfig
from torch_backend.freeze.composite.fill import filled_by_operators
from torch_backend.freeze.composite.filled import filled

CHOSEN, INSTANT = [3, 7, 9], 7
SMALL, FULL, VIEW, PLATE = (18, 24), (45, 60), (20, 26), (50, 65)
TOP, ROWS = 15, 20
CONFIG = CompositeConfig()


def look(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[P, C] bilinear, borders repeated."""
    h, w = picture.shape[:2]
    a, b = (np.clip(v - 0.5, 0.0, n - 1.0) for v, n in ((x, w), (y, h)))
    left, top = a.astype(int), b.astype(int)
    right, under = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    a, b = (a - left)[:, None], (b - top)[:, None]
    upper = picture[top, left] * (1.0 - a) + picture[top, right] * a
    return upper * (1.0 - b) + (picture[under, left] * (1.0 - a) + picture[under, right] * a) * b


def cubic(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[P, C] bicubic (Keys, a = -0.75), borders repeated."""
    h, w = picture.shape[:2]
    left, top, total = np.floor(x - 0.5), np.floor(y - 0.5), 0.0

    def weight(d: np.ndarray) -> np.ndarray:
        inner, outer = 1.25 * d**3 - 2.25 * d**2 + 1.0, -0.75 * (d**3 - 5.0 * d**2 + 8.0 * d - 4.0)
        return np.where(d <= 1.0, inner, outer)[:, None]

    for j in range(-1, 3):
        for i in range(-1, 3):
            u, v = (np.clip(of + k, 0, n - 1).astype(int) for of, k, n in ((left, i, w), (top, j, h)))
            total = total + weight(np.abs(x - 0.5 - left - i)) * weight(np.abs(y - 0.5 - top - j)) * picture[v, u]
    return np.asarray(total)


def projected(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return local[:, :2] / local[:, 2:] * K.diagonal()[:2] + K[:2, 2], local[:, 2]


def scene(chosen: list[int]) -> tuple[Any, Any, Any]:
    """(source views, target view, fillers), random, float32."""
    rng = torch.Generator().manual_seed(5)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=rng)

    def camera(size: tuple[int, int], offset: float) -> tuple[torch.Tensor, torch.Tensor]:
        viewmat, (h, w) = torch.eye(4), size
        viewmat[0, 3], viewmat[2, 0], viewmat[0, 2] = offset, 0.05, -0.05
        return viewmat, torch.tensor([[w, 0.0, w / 2], [0.0, w, h / 2], [0.0, 0.0, 1.0]])

    views = {}
    for n, frame in enumerate(chosen):
        viewmat, K = camera(VIEW, 0.1 * n - 0.12)
        surface = torch.stack([2.0 + 0.05 * random(*VIEW), random(*VIEW), random(*VIEW)], dim=-1)
        views[frame] = SimpleNamespace(
            viewmat=viewmat, K=K, surface=surface, ignored=0.5 * random(*VIEW, 1) if n == 0 else None
        )
    source_views = SimpleNamespace(
        view=views.__getitem__, size=VIEW[::-1], unit=0.04, plates=SimpleNamespace(width=PLATE[1], height=PLATE[0]),
        config=CONFIG.source_views, index={frame: n for n, frame in enumerate(chosen)},
        centres=torch.stack([-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in views.values()]),
    )  # fmt: skip
    viewmat, K = camera(FULL, 0.0)
    image = SimpleNamespace(depth=2.0 + 0.05 * random(*FULL), color=random(*FULL, 3))
    target = SimpleNamespace(
        viewmat=viewmat, K=K, image=image, t=INSTANT, per_pixel=SMALL[1] / FULL[1],
        centre=-viewmat[:3, :3].T @ viewmat[:3, 3],
    )  # fmt: skip
    maps = torch.zeros(*SMALL, 32)
    maps[..., : 3 + 5 * len(chosen)] = random(*SMALL, 3 + 5 * len(chosen))
    for n in range(len(chosen)):
        maps[..., 3 + 5 * n : 6 + 5 * n] = 0.1 * maps[..., 3 + 5 * n : 6 + 5 * n] - 0.05
    residuals = [(random(*PLATE, 3) - 0.5).half() for _ in chosen]
    return source_views, target, SimpleNamespace(chosen=chosen, residuals=residuals, maps=maps)


def numbers(of: torch.Tensor) -> np.ndarray:
    return of.double().numpy()


def weights(source_views: Any, target: Any, fillers: Any, at: np.ndarray) -> dict[str, Any]:
    """Per plate the weights [N, P] and pixels [N, P, 2]; `same` and `shown` [P]; `points` [P, 3]."""
    y, x = at[:, 0] + TOP + 0.5, at[:, 1] + 0.5
    K, viewmat = numbers(target.K), numbers(target.viewmat)
    depth = numbers(target.image.depth)[at[:, 0] + TOP, at[:, 1]]
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1) * depth[:, None]
    points = (rays - viewmat[:3, 3]) @ viewmat[:3, :3]
    map_of = look(numbers(fillers.maps), x * target.per_pixel, y * target.per_pixel)
    motion, doubt, moves, visibility = *map_of[:, :3].T, CONFIG.source_views
    out: dict[str, Any] = {"points": points, "same": np.zeros(len(at)), "weight": [], "places": []}

    def seen(n: int, where: np.ndarray) -> tuple[np.ndarray, ...]:
        view = source_views.view(fillers.chosen[n])
        pixels, far = projected(where, numbers(view.viewmat), numbers(view.K))
        surface, moving, explained = look(numbers(view.surface), *pixels.T).T
        border = np.minimum(pixels, np.array(VIEW[::-1]) - pixels).min(1)
        visible = np.clip(border / visibility.margin, 0.0, 1.0)
        if view.ignored is not None:
            visible = visible * (1.0 - look(numbers(view.ignored), *pixels.T)[:, 0])
        visible = visible * np.exp(-np.square((far - surface) / (visibility.depth_tolerance * far)))
        travel = np.linalg.norm(numbers(source_views.centres[n] - target.centre))
        error = K[0, 0] * target.per_pixel * travel / far * CONFIG.depth_error / source_views.unit
        return pixels, visible, moving, explained, 1.0 / (1.0 + error)

    untold = 1.0
    if INSTANT in fillers.chosen:
        n = fillers.chosen.index(INSTANT)
        _, visible, _, _, nearness = seen(n, points)
        untold = 1.0 - visible * nearness
        out["shown"] = visible * map_of[:, 6 + 5 * n] * np.clip((moves - 0.5) / 0.1 + 0.5, 0.0, 1.0)
    for n, frame in enumerate(fillers.chosen):
        way, around, agreed = map_of[:, 3 + 5 * n : 6 + 5 * n], *map_of[:, 6 + 5 * n : 8 + 5 * n].T
        pixels, visible, moving, explained, nearness = seen(n, points if frame == INSTANT else points + way)
        uneasy = np.maximum(motion, doubt)
        near = nearness * (visible * (1.0 - uneasy) + np.minimum(visible, around) * uneasy)
        view = source_views.view(frame)
        travel = np.linalg.norm(projected(points, numbers(view.viewmat), numbers(view.K))[0] - pixels, axis=1)
        unmoved = explained * agreed * np.exp(-travel / (CONFIG.sway * source_views.unit))
        still = (1.0 - doubt * (1.0 - agreed)) * (1.0 - motion)
        still = still * (1.0 - np.maximum(moving, doubt * (1.0 - explained)))
        other = near * (still + (1.0 - still) * CONFIG.sway_trust * unmoved * untold)
        out["weight"].append(near if frame == INSTANT else other)
        out["places"].append(pixels * np.array(PLATE[::-1]) / np.array(VIEW[::-1]))
        if frame != INSTANT:
            out["same"] = np.maximum(out["same"], unmoved * near)
    return out


@pytest.mark.parametrize("fills", [filled, filled_by_operators], ids=["processor", "card"])
@pytest.mark.parametrize("chosen", [CHOSEN, [3], [INSTANT]])
def test_pixels_are_splats_and_the_weighted_mean_of_residuals(chosen, fills):
    """With plate t* among others, without it, and alone; the pixels' number is no multiple of 16."""
    source_views, target, fillers = scene(chosen)
    at = (torch.rand(ROWS, FULL[1], generator=torch.Generator().manual_seed(1)) < 0.8).nonzero()
    found = fills(cast(Any, source_views), CONFIG, cast(Any, target), cast(Any, fillers), at, slice(TOP, TOP + ROWS))
    want = weights(source_views, target, fillers, at.numpy())
    weight = np.array(want["weight"])
    assert (weight.max(axis=1) > 0.05).all(), "every plate counts somewhere"
    total = np.maximum(weight.sum(0), 1e-6)
    share = total / (total + CONFIG.doubt)
    carried = sum(
        w[:, None] * cubic(numbers(residual), *place.T)
        for w, residual, place in zip(weight, fillers.residuals, want["places"], strict=True)
    )
    color = numbers(target.image.color)[TOP : TOP + ROWS][tuple(at.numpy().T)] + carried * (share / total)[:, None]
    np.testing.assert_allclose(found.color, color, atol=2e-5)
    np.testing.assert_allclose(found.share, share, atol=2e-5)
    np.testing.assert_array_equal(found.plate, (weight >= 0.9 * weight.max(0)).argmax(0))
    np.testing.assert_allclose(found.points, want["points"], rtol=1e-6, atol=1e-6)
    if INSTANT in chosen:
        np.testing.assert_allclose(found.instant, want["shown"] * (1.0 - want["same"]), atol=2e-5)
        np.testing.assert_allclose(found.places, want["places"][chosen.index(INSTANT)], atol=1e-4)
    else:
        assert not found.instant.any()
