"""The lens of an ST map as a polynomial: both directions, every size, in files, and in the maps written from it."""

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import CameraFrame, CameraPath, JobError
from torch_backend.lens.lens import Lens, load_lens
from torch_backend.lens.map_lens import ST_MAP, MapLens, Polynomial, exponents, fitted, widest
from torch_backend.lens.plate_lens import load_plate_lenses
from torch_backend.lens.stmap import margin, needed_margin, redistort_map, write_maps, write_plate_map
from torch_backend.lens.undistort import BandUndistorter
from torch_backend.shot import Shot, write_json

WIDTH, HEIGHT = 160, 120
TRUTH = Lens(WIDTH, HEIGHT, (140.0, 140.0), (140.0, 140.0), (82.0, 57.0), -0.15, 0.03, 0.004, -0.003)


def grid(width=WIDTH, height=HEIGHT):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def lens_of(truth=TRUTH, forward=True, beyond=0.15, degree=5, **more):
    """Lens at the undistorted picture's own size, fitted to points that extend beyond it."""
    size = np.array([truth.width, truth.height])
    plate = (grid().reshape(-1, 2) - size / 2) * (1.0 + 2.0 * beyond) + size / 2
    original = truth.to_original(plate) / size
    points, values = (plate / size, original) if forward else (original, plate / size)
    bend = fitted(points, values, degree, (*points.min(0), *points.max(0)))
    return MapLens(truth.width, truth.height, bend, forward, **more)


def test_a_polynomial_and_its_slopes_are_what_their_terms_say():
    """The polynomials are x^2 y - 3 and y, over a box that is not the unit square."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.0, 2.0], [3.0, 5.0], (200, 2))
    x, y = points.T
    fit = fitted(points, np.stack([x * x * y - 3.0, y], 1), 3, (-1.0, 2.0, 3.0, 5.0))
    assert len(fit.terms) == 2 * len(exponents(3)[0]) == 20
    far = rng.uniform([-4.0, -1.0], [6.0, 9.0], (50, 2))
    x, y = far.T
    np.testing.assert_allclose(fit(far), np.stack([x * x * y - 3.0, y], 1), atol=1e-9)
    expected = np.stack([np.stack([2 * x * y, x * x], 1), np.stack([0 * x, 1 + 0 * x], 1)], 1)
    np.testing.assert_allclose(fit.slopes(far), expected, atol=1e-9)
    np.testing.assert_allclose(
        fit.of_grid(x[:3], y[:4]), fit(np.stack(np.meshgrid(x[:3], y[:4]), -1).reshape(-1, 2)).reshape(4, 3, 2)
    )
    flat = Polynomial(0, (0.0, 0.0, 1.0, 1.0), (2.0, 5.0))
    np.testing.assert_array_equal(flat.slopes(far), np.zeros((50, 2, 2)))


@pytest.mark.parametrize("forward", [True, False])
def test_it_is_the_lens_both_ways_and_past_the_edge(forward):
    lens = lens_of(forward=forward, degree=5 if forward else 11)
    at = grid().reshape(-1, 2)
    tolerance = 1e-6 if forward else 5e-3
    np.testing.assert_allclose(lens.to_original(at), TRUTH.to_original(at), atol=tolerance)
    np.testing.assert_allclose(lens.to_plate(at), TRUTH.to_plate(at), atol=2 * tolerance)
    np.testing.assert_allclose(lens.to_plate(lens.to_original(at)), at, atol=1e-6)
    lens.check()
    assert not lens.is_none and lens.slopes_in_the_middle == pytest.approx((1.0, 1.0), abs=0.01)


def test_a_narrower_map_goes_on_as_the_lens_does():
    """The fit only uses the middle 80 %; the inverse must find the corners beyond it."""
    lens = lens_of(beyond=-0.1)
    np.testing.assert_allclose(lens.to_plate(grid().reshape(-1, 2)), TRUTH.to_plate(grid().reshape(-1, 2)), atol=1e-4)


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("size", [(160, 120), (320, 240), (80, 60)])
def test_plates_of_any_size_are_taken_through_it(forward, size):
    lens = lens_of(forward=forward, degree=5 if forward else 11, window=(0.9, 0.9))
    ratio = size[0] / WIDTH
    where = lens.where(*size)
    assert where.dtype == np.float32 and where.shape == (size[1], size[0], 2)
    expected = lens.to_original(grid(*size).reshape(-1, 2) / ratio).reshape(where.shape) * ratio
    np.testing.assert_allclose(where, expected, atol=1e-4)


def test_the_window_is_the_widest_that_is_whole():
    barrel = Lens(WIDTH, HEIGHT, (140.0, 140.0), (140.0, 140.0), (80.0, 60.0), -0.15)
    pincushion = Lens(WIDTH, HEIGHT, (140.0, 140.0), (140.0, 140.0), (80.0, 60.0), 0.15)
    whole = (0.0, 0.0, 1.0, 1.0)
    shape = WIDTH / HEIGHT
    assert widest(lens_of(barrel), shape, whole).window == (1.0, 1.0), "pixels stay what they are"
    wider = widest(lens_of(barrel), shape)
    for lens in (wider, widest(lens_of(pincushion), shape, whole)):
        at = lens.to_original(grid().reshape(-1, 2))
        assert at.min() > 0.4 and (at < [WIDTH - 0.4, HEIGHT - 0.4]).all()
        assert min(at.min(), *(np.array([WIDTH, HEIGHT]) - at.max(0))) < 0.6, "and not narrower than that"
    assert wider.window[0] > 1.01 and wider.window[0] == wider.window[1]
    # The undistorted picture is 2:1, the plate 4:3. The plate keeps the height, and its width follows from its shape.
    low = widest(lens_of(barrel), 2.0, whole)
    assert low.window == pytest.approx((2.0 / 3.0, 1.0))


def test_a_lens_that_folds_over_is_refused():
    strong = Lens(WIDTH, HEIGHT, (140.0, 140.0), (140.0, 140.0), (80.0, 60.0), -0.75)
    middle = lens_of(strong, beyond=-0.3, degree=3)
    with pytest.raises(JobError, match="folds over"):
        middle.check()


def test_numbers_that_are_no_lens_are_refused():
    params = lens_of().params
    assert MapLens.from_params(WIDTH, HEIGHT, params) == lens_of()
    with pytest.raises(ValueError, match="do not match its degree"):
        MapLens.from_params(WIDTH, HEIGHT, params[:-1])
    with pytest.raises(ValueError, match="not enough values"):
        MapLens.from_params(WIDTH, HEIGHT, [])


@pytest.fixture
def shot(tmp_path):
    """Solved shot whose lens comes from a map."""
    shot, lens = Shot.create(tmp_path / "lens.splannequin"), widest(lens_of(), WIDTH / HEIGHT)
    K = [140.0, 140.0, 80.0, 60.0]
    frames = [CameraFrame(n, np.eye(4).ravel().tolist(), K) for n in (1, 2)]
    write_json(shot.solve / "cameras.json", CameraPath(WIDTH, HEIGHT, frames).to_json())
    record = {"version": 1, "camera_model": ST_MAP, "distortion": [], "focal_px": 140.0, "lens_of_frame": [0, 0]}
    write_json(shot.solve / "solve.json", {**record, "lenses": [{"model": ST_MAP, "params": lens.params}]})
    return shot


def st_pixels(file):
    buffer = oiio.ImageBuf(str(file))
    st = buffer.get_pixels(oiio.FLOAT).astype(float)
    return st[..., :2] * [1, -1] + [0, 1]


def shift(a, b, at, reach=12):
    """Displacement (x, y) in pixels of picture `b` against `a` around a point, from gradients, to first order."""
    x, y = at
    cut = (slice(max(0, y - reach), y + reach), slice(max(0, x - reach), x + reach))
    gy, gx = np.gradient(a)
    G = np.stack([gx[cut].ravel(), gy[cut].ravel()], 1)
    return np.linalg.lstsq(G, (a - b)[cut].ravel(), rcond=None)[0]


def test_what_is_written_of_it_brings_a_plate_back_onto_the_original_at_its_corners(shot, tmp_path):
    """Footage at twice the working size: undistorted by the plate's map, rendered with overscan, and redistorted."""
    lens = load_lens(shot)
    assert isinstance(lens, MapLens) and load_plate_lenses(shot)[2] == lens and lens.intrinsics[0] == 140.0
    assert hash(lens) == hash(load_plate_lenses(shot)[1])
    width, height = 2 * WIDTH, 2 * HEIGHT
    u, v = np.moveaxis(grid(width, height), -1, 0)
    original = 0.5 + 0.2 * np.sin(u / 9.0 + 0.3 * np.cos(v / 31.0)) * np.cos(v / 8.0)
    where = st_pixels(write_plate_map(tmp_path / "plate.exr", lens, width, height, "")) * [width, height]
    np.testing.assert_allclose(where, lens.where(width, height), atol=1e-3)
    plain = (lambda x: x.astype(np.float32), lambda x: x)
    picture = np.repeat(original[..., None], 3, 2).astype(np.float32)
    plate = BandUndistorter(where.astype(np.float32))(picture, *plain, np.empty_like(picture))
    facts = write_maps(shot, width)
    back = st_pixels(facts["redistort"]) * [width, height]
    seen = ((back > 0.5) & (back < [width - 0.5, height - 0.5])).all(-1)
    again = BandUndistorter(back.astype(np.float32))(plate, *plain, np.empty_like(picture))[..., 0]
    again = np.where(seen, again, original)
    for corner in ((20, 14), (width - 20, 14), (20, height - 14), (width - 20, height - 14), (width // 2, height // 2)):
        assert np.abs(shift(original, again, corner)).max() < 0.05
    # With overscan, every pixel of the original has a source.
    across, down = needed_margin(lens, width, height)
    assert across > 0 and margin(
        shot, type("P", (), {"overscan": -1.0})(), width, height, np.array([[280.0, 280.0, 160.0, 120.0]])
    ) == (across, down)
    st = redistort_map(lens, width, height, (across / width, down / height))[..., :2]
    assert st.min() > 0.0 and st.max() < 1.0


def test_a_damaged_record_is_named(shot):
    record = {"version": 1, "camera_model": ST_MAP, "lenses": [{"model": ST_MAP, "params": [1.0, 5.0]}]}
    write_json(shot.solve / "solve.json", record)
    with pytest.raises(JobError, match=r"solve\.json is damaged"):
        load_lens(shot)
    with pytest.raises(JobError, match=r"solve\.json is damaged"):
        load_plate_lenses(shot)
