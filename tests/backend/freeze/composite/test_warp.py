"""The freeze as a warp, compared with float64: values far above white and below black, old and damaged files."""

import dataclasses

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from torch_backend.freeze.composite.warp import (
    CHANNELS,
    Warp,
    WarpMetadata,
    apply_warp,
    read_warp,
    sample,
    snap,
    write_warp,
)
from torch_backend.freeze.exr import read_key

METADATA = WarpMetadata(1012, 1010, 1030.5, 70, 41, "0123abc")


def plate_of(width: int, height: int, seed: int = 1) -> torch.Tensor:
    """[h,w,3]: noise of -0.2 to 1.2, with highlights of 25 to 50 in 5 % of the pixels."""
    rng = np.random.default_rng(seed)
    plate = rng.uniform(-0.2, 1.2, (height, width, 3))
    hot = rng.uniform(size=(height, width)) < 0.05
    plate[hot] = rng.uniform(25.0, 50.0, (int(hot.sum()), 3))
    return torch.from_numpy(plate.astype(np.float32))


def identity(width: int, height: int) -> torch.Tensor:
    """[H,W,2] identity ST map, computed in float32 like other programs."""
    x = (np.arange(width, dtype=np.float32) + np.float32(0.5)) / np.float32(width)
    y = np.float32(1.0) - (np.arange(height, dtype=np.float32) + np.float32(0.5)) / np.float32(height)
    return torch.from_numpy(np.stack(np.meshgrid(x, y), axis=2))


def waves(width: int, height: int) -> torch.Tensor:
    """Identity in the left half, smooth displacements of up to 1.5 pixels in the right half, also beyond the border."""
    st = identity(width, height).double()
    y, x = np.mgrid[0:height, 0:width]
    moved = torch.from_numpy(np.stack([1.5 * np.sin(y / 9.0 + x / 31.0) / width, np.cos(x / 13.0) / height], axis=2))
    return (st + moved * torch.from_numpy(x >= width // 2)[..., None]).float()


def reference(plate: np.ndarray, st: np.ndarray) -> np.ndarray:
    """Bilinear sampling in float64 with extended borders."""
    height, width = plate.shape[:2]
    x = np.clip(st[..., 0].astype(np.float64) * width - 0.5, 0, width - 1)
    y = np.clip((1.0 - st[..., 1].astype(np.float64)) * height - 0.5, 0, height - 1)
    i, j = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    fx, fy = (x - i)[..., None], (y - j)[..., None]
    plate = plate.astype(np.float64)
    upper = (1 - fx) * plate[j, i] + fx * plate[j, i + 1]
    return (1 - fy) * upper + fy * ((1 - fx) * plate[j + 1, i] + fx * plate[j + 1, i + 1])


@pytest.mark.parametrize("size", [(70, 41), (1001, 333), (4096, 9), (3840, 300)])
def test_the_identity_gives_the_plate_bit_for_bit(size):
    plate = plate_of(*size)
    assert torch.equal(sample(plate, snap(identity(*size), size)), plate)
    assert torch.equal(sample(plate, identity(*size)), plate), "rounded where it is looked up, too"


def test_a_smooth_warp_is_bilinear_in_steps_of_a_256th():
    size = (171, 90)
    plate, st = plate_of(*size), waves(*size)
    snapped = snap(st, size)
    steps = snapped.double() * torch.tensor(size) * 256.0
    assert (steps - steps.round()).abs().max() < 256 * max(size) * 1.2e-7
    assert ((snapped - st).double() * torch.tensor(size)).abs().max() < 0.51 / 256
    assert torch.equal(snap(snapped, size), snapped)
    found, expected = sample(plate, snapped).double().numpy(), reference(plate.numpy(), snapped.numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=50 * 171 * 2e-7)


def test_a_frame_of_another_size_than_the_plate_looks_where_it_should():
    plate = plate_of(128, 64)
    expected = sum(plate[y::2, x::2].double() for y in (0, 1) for x in (0, 1)) / 4.0
    np.testing.assert_allclose(sample(plate, identity(64, 32)), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("device", ["cpu"] + (["cuda"] if torch.cuda.is_available() else []))
def test_plate_matte_and_fill_give_the_frozen_frame_back_from_the_file(tmp_path, device):
    """Includes values of 50 near dark ones, values below 0, areas of other content, and holes."""
    rng, size = np.random.default_rng(5), (70, 41)
    plate, st = plate_of(*size).to(device), snap(waves(*size).to(device), size)
    matte = torch.from_numpy(rng.integers(0, 1025, size[::-1]) / 1024.0).float().to(device)
    matte[:, :20], matte[:, 20:30] = 1.0, 0.0
    fill = (1.0 - matte[..., None]) * plate_of(*size, seed=9).clamp(min=0.0).to(device)
    alpha = torch.from_numpy(rng.integers(0, 9, size[::-1]) / 8.0)
    path = write_warp(tmp_path / "warp" / "é.exr", st.cpu(), matte.cpu(), fill.cpu(), alpha, METADATA, (3, 2))
    warp = read_warp(path)
    assert warp.metadata == METADATA and warp.margin == (3, 2) and read_key(path) == METADATA.key
    assert torch.equal(warp.st, st.cpu()) and torch.equal(warp.matte, matte.cpu())
    np.testing.assert_array_equal(warp.alpha, alpha)
    found = apply_warp(plate.cpu(), warp)
    assert torch.equal(found[:, :20], plate.cpu()[:, :20]), "where nothing moves it is the plate, bit for bit"
    from_plate = matte.cpu().double().numpy()[..., None] * reference(plate.cpu().numpy(), st.cpu().numpy())
    expected = from_plate + fill.cpu().double().numpy()
    assert np.abs(expected).max() > 40 and expected.min() < -0.1
    assert (np.abs(found.numpy() - expected) < 1e-3 * np.maximum(np.abs(expected), 0.1)).all()
    assert [p.name for p in path.parent.iterdir()] == ["é.exr"]


def arrays(height: int = 5, width: int = 7) -> dict:
    rng = np.random.default_rng(0)
    kinds = {"st": (2,), "matte": (), "fill": (3,), "alpha": ()}
    return {name: rng.uniform(0, 1, (height, width, *more)).astype(np.float32) for name, more in kinds.items()}


@pytest.mark.parametrize("name", ["st", "matte", "fill", "alpha"])
def test_a_bad_layer_is_named(tmp_path, name):
    torn = arrays()
    torn[name][3, 2] = np.nan
    with pytest.raises(ValueError, match=rf"^{name} has \d NaN or infinite values, the first at \(2, 3\)"):
        write_warp(tmp_path / "a.exr", **torn, metadata=METADATA)
    flat = arrays()
    flat[name] = flat[name][None]
    with pytest.raises(ValueError, match=f"^{name} should be"):
        write_warp(tmp_path / "a.exr", **flat, metadata=METADATA)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("change", "match"), [({"t_star_frame": np.nan}, "t_star_frame"), ({"plate_width": 0}, "0 x")])
def test_bad_metadata_is_refused(tmp_path, change, match):
    with pytest.raises(ValueError, match=match):
        write_warp(tmp_path / "a.exr", **arrays(), metadata=dataclasses.replace(METADATA, **change))


def test_a_plate_of_another_size_is_refused_in_words(tmp_path):
    warp = read_warp(write_warp(tmp_path / "a.exr", **arrays(), metadata=METADATA))
    with pytest.raises(
        ValueError, match=r"frame 1012 is for a plate of 70 x 41 with 3 channels, got shape \[5, 7, 3\]"
    ):
        apply_warp(torch.zeros(5, 7, 3), warp)


def test_foreign_damaged_newer_and_missing_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_warp(tmp_path / "none.exr")
    oiio.ImageBuf(oiio.ImageSpec(4, 4, 3, oiio.HALF)).write(str(tmp_path / "rgb.exr"))
    with pytest.raises(ValueError, match=r"no warp, it has no channel A, ST\.X"):
        read_warp(tmp_path / "rgb.exr")
    newer = write_warp(tmp_path / "new.exr", **arrays(), metadata=dataclasses.replace(METADATA, version=9))
    with pytest.raises(ValueError, match="newer version"):
        read_warp(newer)
    whole = write_warp(tmp_path / "whole.exr", **arrays(64, 64), metadata=METADATA).read_bytes()
    (tmp_path / "half.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"half\.exr"):
        read_warp(tmp_path / "half.exr")


def test_channels_are_what_compositing_programs_find(tmp_path):
    path = write_warp(tmp_path / "a.exr", **arrays(), metadata=METADATA)
    spec = oiio.ImageBuf(str(path)).spec()
    kinds = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    assert kinds == {name: "float" if name.startswith("ST.") else "half" for name in CHANNELS}
    assert spec.getattribute("compression") == "zip"
    pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    assert (pixels[..., spec.channelnames.index("ST.Z")] == 1.0).all()
    assert isinstance(read_warp(path), Warp)
