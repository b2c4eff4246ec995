"""Cryptomattes, compared with the specification: hashes of its reference code, the header, and coverage read back."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.freeze.mattes.cryptomatte import PAIRS, as_float, identifier, murmur3, ranked, write_cryptomatte


@pytest.mark.parametrize(
    ("text", "hashed"),
    [
        ("", 0),
        ("a", 0x3C2569B2),
        ("hello", 0x248BFA47),
        ("hello, world", 0x149BBB7F),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
    ],
)
def test_the_hash_is_murmur3_of_32_bits(text, hashed):
    assert murmur3(text.encode()) == hashed


def test_identifiers_are_ordinary_floats():
    names = [f"matte {n}" for n in range(20_000)]
    bits = np.array([identifier(name) for name in names], np.uint32)
    exponents = bits >> 23 & 255
    assert exponents.min() > 0 and exponents.max() < 255
    # some exponents had to be changed
    assert (bits != np.array([murmur3(name.encode()) for name in names], np.uint32)).any()
    assert np.isfinite(as_float(identifier("")))


def test_a_file_gives_back_every_matte_by_its_name(tmp_path):
    generator = np.random.default_rng(1)
    split = generator.uniform(0.0, 1.0, (9, 12)).astype(np.float32)
    mattes = {"left man": split, "Würfel 2": 1.0 - split, "none": np.zeros_like(split)}
    path = write_cryptomatte(tmp_path / "000001.exr", mattes, key="abc")
    image = oiio.ImageBuf(str(path))
    spec = image.spec()
    attributes = {a.name: a.value for a in spec.extra_attribs if a.name.startswith("cryptomatte/")}
    (folder,) = {name.rsplit("/", 1)[0] for name in attributes}
    layer = attributes[f"{folder}/name"]
    assert folder == f"cryptomatte/{murmur3(layer.encode()):08x}"[:19]
    assert (
        attributes[f"{folder}/hash"] == "MurmurHash3_32" and attributes[f"{folder}/conversion"] == "uint32_to_float32"
    )
    known = json.loads(attributes[f"{folder}/manifest"])
    assert set(known) == set(mattes)
    assert {str(form) for form in spec.channelformats or [spec.format]} == {"float"}
    names = [f"{layer}{n:02d}.{channel}" for n in range(PAIRS // 2) for channel in "RGBA"]
    pixels = image.get_pixels(oiio.FLOAT)[..., [spec.channelnames.index(name) for name in names]]
    pairs = pixels.reshape(9, 12, PAIRS, 2)
    for name, matte in mattes.items():
        wanted = np.uint32(int(known[name], 16)).view(np.float32)
        share = np.where(pairs[..., 0] == wanted, pairs[..., 1], 0.0).sum(-1)
        assert np.array_equal(share, matte)
    assert (np.diff(pairs[..., 1], axis=-1) <= 0.0).all()


def test_shares_are_of_one_pixel_and_the_least_are_left_out():
    mattes = {f"m{n}": np.full((1, 1), 0.1 * (n + 1), np.float32) for n in range(PAIRS + 2)}
    pairs = ranked(mattes).reshape(PAIRS, 2)
    whole = sum(0.1 * (n + 1) for n in range(PAIRS + 2))
    assert np.allclose(pairs[:, 1], [0.1 * (n + 1) / whole for n in range(PAIRS + 1, 1, -1)], atol=1e-6)
    assert pairs[0, 0] == as_float(identifier(f"m{PAIRS + 1}"))
