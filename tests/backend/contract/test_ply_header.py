"""Header of a PLY: vertices, their properties, and the offset of the data; other files are refused with a message."""

import io

import numpy as np
import pytest

from torch_backend.contract import read_ply_header


def test_the_handle_is_left_at_the_first_vertex():
    lines = ["ply", "format binary_little_endian 1.0", "comment ours", "element vertex 2", "property float x"]
    lines += ["property uchar red", "element face 1", "property list uchar int vertex_indices", "end_header", ""]
    handle = io.BytesIO("\n".join(lines).encode() + b"\x00\x00\x80?\x07" + b"\x00\x00\x00@\x09")
    count, fields = read_ply_header(handle, "a.ply")
    assert (count, fields) == (2, [("x", "<f4"), ("red", "u1")])
    rows = np.frombuffer(handle.read(), np.dtype(fields))
    assert rows["x"].tolist() == [1.0, 2.0] and rows["red"].tolist() == [7, 9]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (b"", "not a PLY"),
        (b"ply\nformat ascii 1.0\n", "only binary_little_endian"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\n", "comes before the vertices"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n",
            "bad",
        ),
        (b"ply\n" + b"comment a\n" * 2000, "does not end"),
    ],
)
def test_what_is_no_header_is_refused(text, problem):
    with pytest.raises(ValueError, match=rf"a\.ply: .*{problem}"):
        read_ply_header(io.BytesIO(text), "a.ply")
