"""Single mattes: round trip of both formats, with overscan if the format supports it."""

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import TakeFolder
from torch_backend.freeze.mattes.files import is_current, matte_file, read_matte, remaining_suffixes, write_matte


@pytest.mark.parametrize(("suffix", "tolerance"), [("exr", 2.5e-4), ("png", 1e-5)])
def test_a_matte_is_read_back(tmp_path, suffix, tolerance):
    matte = np.random.default_rng(2).uniform(0.0, 1.0, (12, 20)).astype(np.float32)
    path = matte_file(TakeFolder(tmp_path), "man", 7, suffix)
    path.parent.mkdir(parents=True)
    write_matte(path, matte, (3, 2), "key")
    found = read_matte(path, (3, 2))
    inner = slice(2, 10), slice(3, 17)
    assert np.abs(found - matte)[inner].max() <= tolerance
    assert is_current(path, "key") and not is_current(path, "other")
    spec = oiio.ImageBuf(str(path)).spec()
    assert (spec.full_width, spec.full_height) == (14, 8)
    if suffix == "exr":
        assert np.abs(found - matte).max() <= tolerance
    assert suffix not in remaining_suffixes(suffix) and remaining_suffixes(suffix)


def test_truncated_matte_file_is_not_current(tmp_path):
    path = tmp_path / "000001.exr"
    write_matte(path, np.ones((40, 40), np.float32), (0, 0), "key")
    path.write_bytes(path.read_bytes()[:-30])
    assert not is_current(path, "key") and not is_current(tmp_path / "none.exr", "key")
