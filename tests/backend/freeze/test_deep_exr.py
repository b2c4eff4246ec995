"""Deep EXR files: OpenImageIO reads back what was written, and truncated files are detected."""

import numpy as np
import OpenImageIO as oiio

from torch_backend.contract import is_whole_picture
from torch_backend.freeze.deep_exr import DEEP_CHANNELS, write_deep_exr
from torch_backend.freeze.exr import FrameMetadata


def samples_of(path):
    """[H, W] lists of (R, G, B, A, Z) samples of a deep file."""
    file = oiio.ImageInput.open(str(path))
    spec, data = file.spec(), file.read_native_deep_image()
    assert spec.deep and spec.channelnames == DEEP_CHANNELS
    each = [
        [tuple(data.deep_value(p, c, s) for c in range(5)) for s in range(data.samples(p))]
        for p in range(spec.width * spec.height)
    ]
    return np.array([*each, None], dtype=object)[:-1].reshape(spec.height, spec.width), spec


def test_truncated_deep_file_is_incomplete(tmp_path):
    rng = np.random.default_rng(1)
    rgba, depth = rng.random((2, 70, 20, 4)).astype(np.float32), rng.random((2, 70, 20)).astype(np.float32)
    rgba[1, 10:30, :, 3] = 0.0
    rgba[:, :3] = 0.0
    facts = FrameMetadata(7, 5.0, np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), key="k")
    file = write_deep_exr(tmp_path / "deep.exr", (70, 20), lambda rows: (rgba[:, rows], depth[:, rows]), facts, (2, 5))
    assert is_whole_picture(file)
    samples, spec = samples_of(file)
    assert (spec.x, spec.y, spec.full_width, spec.full_height) == (-2, -5, 16, 60)
    assert [len(samples[n, 4]) for n in (2, 9, 10, 29, 30, 69)] == [0, 2, 1, 1, 2, 2]
    np.testing.assert_allclose(samples[69, 4][1], [*rgba[1, 69, 4], depth[1, 69, 4]], atol=5e-4)
    data = file.read_bytes()
    for end in (len(data) - 1, len(data) // 2, 600):
        (tmp_path / "cut.exr").write_bytes(data[:end])
        assert not is_whole_picture(tmp_path / "cut.exr")
