import struct

import numpy as np
import pytest

from torch_backend.gaussians.ply import property_names, read_ply, write_ply


def gaussians(count, degree, seed=0):
    rng = np.random.default_rng(seed)
    bases = (degree + 1) ** 2
    shapes = dict(means=(count, 3), quats=(count, 4), log_scales=(count, 3), opacity_logits=(count,))
    arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return arrays | {"sh": rng.normal(size=(count, bases, 3)).astype(np.float32)}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 57])
def test_round_trip_is_exact(tmp_path, degree, count):
    stored = gaussians(count, degree)
    path = write_ply(tmp_path / "Größe 測試" / "frozen.ply", **stored)
    for name, array in read_ply(path)._asdict().items():
        np.testing.assert_array_equal(array, stored[name], err_msg=name)
        assert array.dtype == np.float32
    assert [p.name for p in path.parent.iterdir()] == ["frozen.ply"]


def test_header_is_the_one_viewers_know(tmp_path):
    path = write_ply(tmp_path / "a.ply", **gaussians(2, 1))
    header = path.read_bytes().split(b"end_header\n")[0].decode()
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 2"] + [f"property float {n}" for n in names]
    assert header == "\n".join(lines) + "\n"


def test_bytes_are_channel_major_sh_and_wxyz(tmp_path):
    sh = np.arange(12, dtype=np.float32).reshape(1, 4, 3)
    path = write_ply(tmp_path / "a.ply", [[1, 2, 3]], [[0.1, 0.2, 0.3, 0.4]], [[-1, -2, -3]], [0.7], sh)
    row = struct.unpack("<26f", path.read_bytes().split(b"end_header\n")[1])
    red, green, blue = (3, 6, 9), (4, 7, 10), (5, 8, 11)
    expected = (1, 2, 3, 0, 0, 0, 0, 1, 2, *red, *green, *blue, 0.7, -1, -2, -3, 0.1, 0.2, 0.3, 0.4)
    assert row == pytest.approx(expected)


def test_reads_any_property_order_type_and_comments(tmp_path):
    """Exporters reorder properties, add colours, drop normals and append faces."""
    names = [n for n in property_names(1) if not n.startswith("n")][::-1]
    values = {name: float(i) for i, name in enumerate(property_names(1))}
    lines = ["ply", "format binary_little_endian 1.0", "comment made elsewhere", "element vertex 1"]
    lines += ["property uchar red", *(f"property double {n}" for n in names)]
    lines += ["element face 0", "property list uchar int vertex_indices", "end_header\n"]
    path = tmp_path / "other.ply"
    path.write_bytes("\n".join(lines).encode() + struct.pack("<B14d", 200, *(values[n] for n in names)))
    read = read_ply(path)
    assert read.means.tolist() == [[0, 1, 2]]
    assert read.sh.tolist() == [[[6, 7, 8]]]
    assert read.opacity_logits.tolist() == [9]
    assert read.quats.tolist() == [[13, 14, 15, 16]]


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sh"])
def test_refuses_not_finite_and_names_it(tmp_path, name):
    arrays = gaussians(4, 1)
    arrays[name][2] = np.nan
    with pytest.raises(ValueError, match=f"{name} of 1 Gaussians is not finite"):
        write_ply(tmp_path / "a.ply", **arrays)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "shape"), [("means", (4, 2)), ("quats", (3, 4)), ("opacity_logits", (4, 1)), ("sh", (4, 5, 3))]
)
def test_refuses_wrong_shapes_and_names_them(tmp_path, name, shape):
    with pytest.raises(ValueError, match=f"^{name} should"):
        write_ply(tmp_path / "a.ply", **gaussians(4, 1) | {name: np.zeros(shape)})


def test_refuses_a_file_cut_short(tmp_path):
    path = write_ply(tmp_path / "a.ply", **gaussians(10, 2))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="cut short, 10 Gaussians need"):
        read_ply(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x89PNG\r\n\x1a\n", "not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "only binary_little_endian"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n",
            "not a 3D Gaussian",
        ),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex -1\n", "bad line"),
        (b"ply\nformat binary_little_endian 1.0\n", "bad line"),
    ],
)
def test_unsupported_files_give_a_readable_error(tmp_path, content, message):
    path = tmp_path / "x.ply"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_ply(path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = write_ply(tmp_path / "a.ply", **gaussians(3, 0))
    before = path.read_bytes()
    with pytest.raises(ValueError, match="quats"):
        write_ply(path, **gaussians(3, 0) | {"quats": np.zeros((3, 3))})
    assert path.read_bytes() == before
