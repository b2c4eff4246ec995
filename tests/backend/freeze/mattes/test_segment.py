"""Segmentation of an object: pictures with known outlines, and the definition of the guided filter."""

import numpy as np

from torch_backend.freeze.mattes.segment import filled, guided, refine, segment_lasso


def disc(shape, centre, radius):
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.hypot(x - centre[0], y - centre[1]) < radius


def ring(centre, radius, wobble, seed=0, corners=40):
    """Lasso around a disc with errors of up to `wobble` pixels."""
    turn = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    radii = radius + np.random.default_rng(seed).uniform(-wobble, wobble, corners)
    return np.stack([centre[0] + radii * np.cos(turn), centre[1] + radii * np.sin(turn)], axis=1)


def painted(mask, object_color, rest, seed=3):
    noise = np.random.default_rng(seed).normal(0.0, 12.0, (*mask.shape, 3))
    return np.clip(np.where(mask[..., None], object_color, rest) + noise, 0, 255).astype(np.uint8)


def overlap(matte, mask):
    found = matte > 0.5
    return (found & mask).sum() / (found | mask).sum()


def test_a_polygon_is_filled_where_pixel_centres_are_inside():
    corners = np.array([[2.0, 1.0], [6.0, 1.0], [6.0, 4.0], [2.0, 4.0]])
    mask = filled(corners, (8, 10))
    assert mask[1:4, 2:6].all() and mask.sum() <= 5 * 4


def test_a_sloppy_lasso_finds_the_outline_by_colour():
    mask = disc((160, 220), (110, 80), 45)
    picture = painted(mask, (170, 90, 60), (70, 110, 130))
    lasso = ring((110, 80), 45, 4.0)
    depth = np.full(mask.shape, 3.0, np.float32)
    drawn = overlap(filled(lasso, mask.shape).astype(np.float32), mask)
    assert overlap(segment_lasso(picture, depth, lasso), mask) > 0.98 > 0.97 > drawn


def test_depth_separates_objects_of_one_colour():
    mask = disc((160, 220), (110, 80), 45)
    picture = painted(mask, (110, 110, 110), (110, 110, 110))
    lasso = ring((110, 80), 45, 4.0)
    depth = np.where(mask, 2.0, 3.5).astype(np.float32)
    alike = overlap(segment_lasso(picture, np.full_like(depth, 3.0), lasso), mask)
    assert overlap(segment_lasso(picture, depth, lasso), mask) > max(0.965, alike)


def test_shifted_splat_matte_is_aligned_to_picture_edges():
    mask, shifted = disc((160, 220), (110, 80), 45), disc((160, 220), (112, 79), 44)
    picture = painted(mask, (170, 90, 60), (70, 110, 130))
    depth, known = np.full(mask.shape, 3.0, np.float32), np.ones(mask.shape, np.float32)
    rendered = shifted.astype(np.float32)
    assert overlap(refine(picture, depth, rendered, known), mask) > 0.98 > overlap(rendered, mask)


def test_the_picture_decides_where_no_vote_is_known():
    mask = disc((160, 220), (110, 80), 45)
    picture = painted(mask, (170, 90, 60), (70, 110, 130))
    depth = np.where(mask, 2.0, 3.5).astype(np.float32)
    known = np.ones(mask.shape, np.float32)
    known[:, 130:170] = 0.0
    rendered = mask * known
    assert overlap(refine(picture, depth, rendered, known), mask) > 0.95 > overlap(rendered, mask)


def test_nothing_stays_nothing():
    picture, empty = np.full((40, 50, 3), 90, np.uint8), np.zeros((40, 50), np.float32)
    assert not refine(picture, np.ones_like(empty), empty, np.ones_like(empty)).any()


def test_the_guided_filter_is_the_mean_of_linear_fits():
    """Compared with float64 least squares in every window, away from the border."""
    generator = np.random.default_rng(5)
    guide = generator.uniform(0.0, 1.0, (15, 15, 3))
    values = (guide[..., 0] > 0.5).astype(np.float64)
    radius, epsilon = 2, 1e-2
    fits = np.full((15, 15, 4), np.nan)
    for y in range(radius, 15 - radius):
        for x in range(radius, 15 - radius):
            window = slice(y - radius, y + radius + 1), slice(x - radius, x + radius + 1)
            colours, wanted = guide[window].reshape(-1, 3), values[window].ravel()
            spread = np.cov(colours.T, bias=True) + epsilon * np.eye(3)
            joint = ((colours - colours.mean(0)) * (wanted - wanted.mean())[:, None]).mean(0)
            slope = np.linalg.solve(spread, joint)
            fits[y, x] = [*slope, wanted.mean() - slope @ colours.mean(0)]
    middle = slice(2 * radius, 15 - 2 * radius)
    expected = np.full((15, 15), np.nan)
    for y in range(2 * radius, 15 - 2 * radius):
        for x in range(2 * radius, 15 - 2 * radius):
            mean = fits[y - radius : y + radius + 1, x - radius : x + radius + 1].reshape(-1, 4).mean(0)
            expected[y, x] = mean[:3] @ guide[y, x] + mean[3]
    found = guided(guide.astype(np.float32), values.astype(np.float32), radius, epsilon)
    assert np.allclose(found[middle, middle], np.clip(expected, 0, 1)[middle, middle], atol=2e-5)
