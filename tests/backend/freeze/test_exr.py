import dataclasses
import subprocess
import sys
import tracemalloc

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import FrameLayer
from torch_backend.footage.color import PRIMARIES, InputSpace
from torch_backend.freeze import exr
from torch_backend.freeze.exr import (
    CHANNELS,
    DETAIL_CHANNELS,
    GRAIN_CHANNELS,
    HALF_MAX,
    DetailLayers,
    FrameMetadata,
    LazyLayer,
    read_frozen_exr,
    read_key,
    write_frozen_exr,
)

VIEWMAT = np.array([[0, -1, 0, 0.25], [1, 0, 0, -2], [0, 0, 1, 3.5], [0, 0, 0, 1]], dtype=np.float32)
K = np.array([[1000.5, 0, 31.5], [0, 999.25, 24.5], [0, 0, 1]], dtype=np.float32)
METADATA = FrameMetadata(frame=1012, t_star_frame=1030.5, viewmat=VIEWMAT, K=K, depth_units="metres")


def layers(height=7, width=9, seed=1):
    rng = np.random.default_rng(seed)
    rgba = rng.uniform(-0.2, 6.0, (height, width, 4))
    rgba[..., 3] = rng.uniform(size=(height, width))
    depth = rng.uniform(0.01, 5000.0, (height, width))
    depth[0, 0] = 1e10
    arrays = dict(rgba=rgba, depth=depth, support=rng.uniform(size=depth.shape), motion=rng.uniform(size=depth.shape))
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def test_round_trip_keeps_depth_exact_and_the_rest_to_half(tmp_path):
    stored = layers()
    frame = read_frozen_exr(write_frozen_exr(tmp_path / "Größe 測試" / "001012.exr", metadata=METADATA, **stored))
    np.testing.assert_array_equal(frame.depth, stored["depth"])
    for name in ("rgba", "support", "motion"):
        np.testing.assert_array_equal(getattr(frame, name), stored[name].astype(np.float16).astype(np.float32))
    assert [p.name for p in (tmp_path / "Größe 測試").iterdir()] == ["001012.exr"]


def test_grain_comes_back_to_an_eighth_and_unbiased_and_may_be_absent(tmp_path):
    stored = layers(120, 160)
    grain = np.random.default_rng(3).normal(0.0, 0.02, (120, 160, 3)).astype(np.float32)
    path = write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, grain=grain, **stored)
    frame = read_frozen_exr(path)
    np.testing.assert_allclose(frame.grain, grain, rtol=0.5**3, atol=1e-5)
    assert frame.grain.std() == pytest.approx(grain.std(), rel=0.01)
    np.testing.assert_array_equal(frame.depth, stored["depth"])
    spec = oiio.ImageBuf(str(path)).spec()
    kinds = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    assert {kinds[name] for name in GRAIN_CHANNELS} == {"half"}
    assert read_frozen_exr(write_frozen_exr(tmp_path / "b.exr", metadata=METADATA, **layers())).grain is None
    with pytest.raises(ValueError, match="^grain should be"):
        write_frozen_exr(tmp_path / "c.exr", metadata=METADATA, grain=grain[:5], **stored)
    with pytest.raises(ValueError, match="^grain has [0-9]+ NaN"):
        write_frozen_exr(tmp_path / "c.exr", metadata=METADATA, grain=grain * np.nan, **stored)


def detail_of(stored: dict, seed: int = 2) -> DetailLayers:
    rng = np.random.default_rng(seed)
    shape = stored["depth"].shape
    source = rng.integers(100_000, 100_300, shape).astype(np.float32)
    return DetailLayers(stored["rgba"][:, ::-1] * 0.5, rng.uniform(size=shape).astype(np.float32), source)


def source(array):
    return LazyLayer(array.shape, lambda rows: array[rows].astype(np.float64))


def test_streamed_layers_give_the_same_file(tmp_path):
    stored = layers(150, 60)
    detail, grain = detail_of(stored), np.random.default_rng(3).normal(size=(150, 60, 3)).astype(np.float32)
    whole = write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, grain=grain, detail=detail, **stored)
    lazy = {name: source(array) for name, array in stored.items()}
    deferred = dataclasses.replace(detail, splat=source(detail.splat))
    parts = write_frozen_exr(tmp_path / "b.exr", metadata=METADATA, grain=source(grain), detail=deferred, **lazy)
    a, b = (oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT) for path in (whole, parts))
    np.testing.assert_array_equal(a, b)


def test_invalid_streamed_layer_leaves_no_file(tmp_path):
    stored = layers(150, 60)
    stored["depth"][130, 7] = np.nan
    with pytest.raises(ValueError, match=r"^depth has 1 NaN or infinite values, the first at \(7, 130\)"):
        write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **{**stored, "depth": source(stored["depth"])})
    with pytest.raises(ValueError, match="^depth should be"):
        write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **{**stored, "depth": source(stored["depth"][:9])})
    assert not list(tmp_path.iterdir())


def test_streamed_layers_are_never_fully_in_memory(tmp_path):
    height, width = 3000, 500
    flat = {name: LazyLayer((height, width), lambda rows: np.full((min(rows.stop, height) - rows.start, width), 0.5))
            for name in ("depth", "support", "motion")}  # fmt: skip
    rgba = LazyLayer((height, width, 4), lambda rows: np.full((min(rows.stop, height) - rows.start, width, 4), 0.5))
    tracemalloc.start()
    write_frozen_exr(tmp_path / "a.exr", rgba, metadata=METADATA, **flat)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 4 * height * width / 4, f"{peak / 1e6} MB"


@pytest.mark.parametrize("with_grain", [False, True])
def test_source_layers_round_trip_and_are_optional(tmp_path, with_grain):
    stored = layers(150, 60)  # more rows than one write holds
    detail, grain = detail_of(stored), np.full((150, 60, 3), 0.25, np.float32) if with_grain else None
    path = write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, grain=grain, detail=detail, margin=(3, 2), **stored)
    frame = read_frozen_exr(path)
    assert frame.detail is not None and frame.margin == (3, 2) and (frame.grain is not None) == with_grain
    np.testing.assert_array_equal(frame.detail.source, detail.source)  # half floats cannot represent these numbers
    np.testing.assert_allclose(frame.detail.splat, detail.splat, rtol=2.0**-9 + 2.0**-11, atol=1e-6)
    assert np.sum(frame.detail.splat) == pytest.approx(detail.splat.sum(), rel=2e-5), "rounded, not cut off"
    np.testing.assert_allclose(frame.detail.plate, detail.plate, atol=0.5 / 256 + 1e-6)
    np.testing.assert_array_equal(frame.rgba, stored["rgba"].astype(np.float16))
    np.testing.assert_array_equal(frame.depth, stored["depth"])
    spec = oiio.ImageBuf(str(path)).spec()
    kinds = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    assert [kinds[name] for name in DETAIL_CHANNELS] == ["half"] * 5 + ["float"]
    plain = write_frozen_exr(tmp_path / "b.exr", metadata=METADATA, **stored)
    assert read_frozen_exr(plain).detail is None
    assert not set(DETAIL_CHANNELS) & set(oiio.ImageBuf(str(plain)).spec().channelnames)


@pytest.mark.parametrize("name", ["splat", "plate", "source"])
def test_invalid_source_layer_is_named(tmp_path, name):
    stored = layers()
    good = detail_of(stored)
    flat = dataclasses.replace(good, **{name: getattr(good, name)[:5]})
    with pytest.raises(ValueError, match=f"^{name} should be"):
        write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, detail=flat, **stored)
    torn = dataclasses.replace(good, **{name: getattr(good, name) * np.where(np.arange(9) == 4, np.nan, 1.0).reshape(
        (1, 9, 1) if name == "splat" else (1, 9)
    )})  # fmt: skip
    with pytest.raises(ValueError, match=rf"^{name} has \d+ NaN or infinite values, the first at \(4, 0\)"):
        write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, detail=torn, **stored)
    assert list(tmp_path.iterdir()) == []


def test_new_layer_needs_only_a_table_row(tmp_path, monkeypatch):
    rows = (
        FrameLayer("Distance", ("Distance.V",), "float", "Distance.V", "from the camera", part="distance"),
        FrameLayer("Sky", tuple(f"Sky.{c}" for c in "RGBA"), "half", "Sky.R G B A", "what is far", part="sky"),
    )
    monkeypatch.setattr(exr, "_MORE", {row.name: row for row in rows})
    stored = layers()
    more = {"Distance": stored["depth"] * 1.5, "Sky": source(stored["rgba"])}
    path = write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, detail=detail_of(stored), more=more, **stored)
    frame = read_frozen_exr(path)
    np.testing.assert_array_equal(frame.more["Distance"], stored["depth"] * 1.5)
    np.testing.assert_array_equal(frame.more["Sky"], stored["rgba"].astype(np.float16).astype(np.float32))
    np.testing.assert_array_equal(frame.detail.source, detail_of(stored).source)
    assert read_frozen_exr(write_frozen_exr(tmp_path / "b.exr", metadata=METADATA, **stored)).more == {}
    with pytest.raises(ValueError, match=r"Sky should be \[7, 9, 4\] like rgba"):
        write_frozen_exr(tmp_path / "c.exr", metadata=METADATA, more={"Sky": stored["depth"]}, **stored)
    with pytest.raises(KeyError, match="Plate"):  # this layer has its own argument
        write_frozen_exr(tmp_path / "c.exr", metadata=METADATA, more={"Plate": stored["depth"]}, **stored)


def test_the_key_is_read_from_the_header(tmp_path):
    noted = dataclasses.replace(METADATA, key="0123abc")
    assert read_key(write_frozen_exr(tmp_path / "a.exr", metadata=noted, **layers())) == "0123abc"
    assert read_key(write_frozen_exr(tmp_path / "b.exr", metadata=METADATA, **layers())) == ""
    (tmp_path / "c.exr").write_bytes(b"torn")
    assert read_key(tmp_path / "c.exr") is None


def test_metadata_comes_back(tmp_path):
    read = read_frozen_exr(write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **layers())).metadata
    for field in dataclasses.fields(FrameMetadata):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(METADATA, field.name), err_msg=field.name)


def test_file_is_one_part_of_zipped_half_and_float_channels_in_linear_rec709(tmp_path):
    path = write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **layers())
    image = oiio.ImageBuf(str(path))
    spec = image.spec()
    formats = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    assert formats == {name: "float" if name == "Z" else "half" for name in CHANNELS}
    assert image.nsubimages == 1
    assert spec.getattribute("compression") == "zip"
    assert spec.getattribute("oiio:ColorSpace") == "lin_rec709_scene"
    assert spec.getattribute("chromaticities") == pytest.approx((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329))


@pytest.mark.parametrize("light", ["ap1", "ap0", "rec2020", "p3d65"])
def test_frames_leave_in_the_light_of_the_footage_and_come_back_as_rec709(tmp_path, light):
    """Colours, grain and splats are converted; decoded from that space they equal the Rec.709 values."""
    metadata = dataclasses.replace(METADATA, light=light)
    rng = np.random.default_rng(1)
    written = layers()
    shape = written["rgba"].shape[:2]
    grain = rng.normal(0.0, 0.02, (*shape, 3)).astype(np.float32)
    splat = rng.uniform(0.0, 2.0, (*shape, 4)).astype(np.float32)
    detail = DetailLayers(splat, np.ones(shape, np.float32), np.ones(shape, np.float32))
    path = write_frozen_exr(tmp_path / "a.exr", metadata=metadata, grain=grain, detail=detail, **written)
    image = oiio.ImageBuf(str(path))
    spec = image.spec()
    assert spec.getattribute("chromaticities") == pytest.approx(PRIMARIES[light][1], abs=1e-6)
    assert spec.getattribute("oiio:ColorSpace") == f"lin_{light}_scene"
    stored = np.asarray(image.get_pixels(oiio.FLOAT))[..., [spec.channelnames.index(c) for c in "RGB"]]
    expected = InputSpace("lin", light).to_linear(stored)
    scale = np.abs(written["rgba"][..., :3]).max()
    assert np.abs(expected - written["rgba"][..., :3]).max() < 2e-3 * scale < np.abs(stored - expected).max()
    read = read_frozen_exr(path)
    assert read.metadata.light == light
    np.testing.assert_allclose(read.rgba, written["rgba"], atol=2e-3 * scale)
    np.testing.assert_allclose(read.grain, grain, atol=0.2 * np.abs(grain).max())
    np.testing.assert_allclose(np.asarray(read.detail.splat), splat, atol=0.02)
    np.testing.assert_array_equal(read.rgba[..., 3], read_frozen_exr(
        write_frozen_exr(tmp_path / "b.exr", metadata=METADATA, **written)).rgba[..., 3])  # fmt: skip


def test_light_that_no_frame_leaves_in_is_refused(tmp_path):
    with pytest.raises(ValueError, match="not 'xyz'"):
        write_frozen_exr(tmp_path / "a.exr", metadata=dataclasses.replace(METADATA, light="xyz"), **layers())


def test_world_to_camera_is_imath_row_vectors_looking_along_minus_z(tmp_path):
    path = write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **layers())
    matrix = np.reshape(oiio.ImageBuf(str(path)).spec().getattribute("worldToCamera"), (4, 4))
    point = np.array([0.3, -0.7, 2.0, 1.0])
    x, y, z, _ = VIEWMAT.astype(np.float64) @ point
    np.testing.assert_allclose(point @ matrix, [x, -y, -z, 1.0], rtol=1e-6)


@pytest.mark.parametrize("name", ["rgba", "depth", "support", "motion"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_refuses_not_finite_and_names_layer_and_place(tmp_path, name, bad):
    stored = layers()
    stored[name][3, 2] = bad
    with pytest.raises(ValueError, match=rf"^{name} has \d NaN or infinite values, the first at \(2, 3\)"):
        write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **stored)
    assert list(tmp_path.iterdir()) == []


def test_clamps_to_half_range_but_not_depth(tmp_path):
    stored = layers()
    stored["rgba"][0, 0] = [1e6, -1e6, 65519.0, 1.0]
    stored["depth"][1, 1] = 1e6
    frame = read_frozen_exr(write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **stored))
    assert frame.rgba[0, 0].tolist() == [HALF_MAX, -HALF_MAX, HALF_MAX, 1.0]
    assert frame.depth[1, 1] == 1e6


@pytest.mark.parametrize(
    ("name", "shape"), [("rgba", (7, 9, 3)), ("rgba", (0, 9, 4)), ("depth", (9, 7)), ("support", (7, 9, 1))]
)
def test_refuses_wrong_shapes_and_names_the_layer(tmp_path, name, shape):
    with pytest.raises(ValueError, match=f"^{name} should be"):
        write_frozen_exr(tmp_path / "a.exr", metadata=METADATA, **layers() | {name: np.zeros(shape)})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"viewmat": np.full((4, 4), np.nan)}, "metadata.viewmat"),
        ({"K": np.ones(4)}, "metadata.K"),
        ({"t_star_frame": np.inf}, "metadata.t_star_frame"),
    ],
)
def test_refuses_bad_metadata(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        write_frozen_exr(tmp_path / "a.exr", metadata=dataclasses.replace(METADATA, **changes), **layers())


def test_refuses_to_read_newer_foreign_damaged_and_missing_files(tmp_path):
    newer = write_frozen_exr(tmp_path / "new.exr", metadata=dataclasses.replace(METADATA, version=99), **layers())
    with pytest.raises(ValueError, match="newer version"):
        read_frozen_exr(newer)
    oiio.ImageBuf(oiio.ImageSpec(4, 4, 3, oiio.HALF)).write(str(tmp_path / "rgb.exr"))
    with pytest.raises(ValueError, match=r"no channel A, Z, Support\.V, Motion\.V"):
        read_frozen_exr(tmp_path / "rgb.exr")
    whole = write_frozen_exr(tmp_path / "whole.exr", metadata=METADATA, **layers(64, 64)).read_bytes()
    (tmp_path / "half.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"half\.exr"):
        read_frozen_exr(tmp_path / "half.exr")
    with pytest.raises(FileNotFoundError):
        read_frozen_exr(tmp_path / "none.exr")


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_a_write_cut_short_by_the_system_is_an_oserror_and_leaves_nothing(tmp_path):
    script = """
import resource, sys
import numpy as np
from torch_backend.freeze.exr import FrameMetadata, write_frozen_exr
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
noise = np.random.default_rng(0).uniform(size=(200, 200)).astype(np.float32)
meta = FrameMetadata(1, 1.0, np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32))
try:
    write_frozen_exr(sys.argv[1], np.repeat(noise[..., None], 4, 2), noise, noise, noise, meta)
except OSError as error:
    print("OSError", error.errno, error.filename)
"""
    command = [sys.executable, "-c", script, str(tmp_path / "a.exr")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.startswith("OSError")
    assert "a.exr" in done.stdout
    assert list(tmp_path.iterdir()) == []
