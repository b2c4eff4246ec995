"""The shadow of a ball on planes: its place, occluders, and its similarity to a shadow on a wrong plane."""

import numpy as np
import pytest

from benchmarks.shadow import RADIUS, TO_LAMP, Set, likeness, places_of, shadow
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.regions import View

FACES = np.array([[0, 1, 2], [0, 2, 3]])


def floor(z=0.0, half=5.0, at=(0.0, 0.0)):
    corners = np.array([(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)])
    return corners + np.array([*at, 0.0])


@pytest.fixture
def view():
    """View from four metres above the origin, looking down; a pixel is a centimetre of the floor."""
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[2, 3] = 4.0
    return View(viewmat, np.array([[400.0, 0, 100], [0, 400.0, 75], [0, 0, 1]]), 200, 150)


def pixel(view, point):
    (x, y), _ = view.project(np.asarray(point, float))
    return int(y), int(x)


def test_shadow_is_opposite_the_lamp_and_blocked_by_a_screen(view):
    of = Set.on(np.zeros(3))
    left = shadow(RayScene(floor(), FACES), view, of)
    middle = of.ball - TO_LAMP * of.ball[2] / TO_LAMP[2]
    assert abs(middle[2]) < 1e-9 and left[pixel(view, middle)] == 0.0
    assert left[pixel(view, [0.5, -0.3, 0.0])] == 1.0 and left[pixel(view, [-0.6, 0.4, 0.0])] == 1.0
    # A ball's shadow is elongated; the ratio depends on the lamp's height.
    slope = np.linalg.norm(TO_LAMP) / TO_LAMP[2]
    assert 1e-4 * (1.0 - left).sum() == pytest.approx(np.pi * RADIUS**2 * slope * 1.25, rel=0.15)
    screen = floor(1.2, 0.5, of.ball[:2] + TO_LAMP[:2] * 0.9)
    hidden = RayScene(np.concatenate([floor(), screen]), np.concatenate([FACES, FACES + 4]))
    assert shadow(hidden, view, of)[pixel(view, middle)] == 1.0, "no light arrives that a ball could stop"


def test_likeness_is_one_on_the_truth_and_falls_with_the_error(view):
    truth, of = RayScene(floor(), FACES), Set.on(np.zeros(3))
    found = [likeness(RayScene(floor(-z), FACES), truth, view, of) for z in (0.0, 0.02, 0.3)]
    assert found[0] == pytest.approx(1.0) and found[0] > found[1] > found[2]
    far_floor = RayScene(floor(0.0, 0.1, (9.0, 9.0)), FACES)
    assert likeness(far_floor, far_floor, view, of) is None
    assert likeness(far_floor, truth, view, of) < 0.6, "a shadow that is missing is unlike"


def test_balls_rest_on_what_is_seen(view):
    found = places_of(RayScene(floor(), FACES), view)
    assert len(found) == 3 and np.allclose([place[2] for place in found], 0.0, atol=1e-6)
    assert places_of(RayScene(floor(0.0, 0.1, (9.0, 9.0)), FACES), view) == []
