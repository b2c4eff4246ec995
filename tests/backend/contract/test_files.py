"""Files of unknown origin: no reader blocks on a pipe or fills the memory. Uses real special files."""

import os
import signal
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torch_backend.cameras.colmap_files import read_model
from torch_backend.contract import UnreadableFile, open_arrays, open_regular, read_json, regular_file
from torch_backend.footage.images import read_png
from torch_backend.footage.layers import find_layer
from torch_backend.freeze.exr import read_frozen_exr, read_key
from torch_backend.gaussians.ply import read_ply
from torch_backend.lens.map_reading import fingerprint
from torch_backend.train.stored_tensors import open_stored

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows has no such files in folders")


@pytest.fixture(autouse=True)
def no_waiting() -> Iterator[None]:
    """End a test that blocks on a pipe."""

    def late(number: int, frame: object) -> None:
        raise TimeoutError("it waits for a file")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def make(path: Path, kind: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        path.touch()
        os.truncate(path, 40 << 30)  # a sparse file of 40 GB, which uses no disk space
    return path


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "regular_file": ("any", regular_file),
    "JSON": ("any.json", read_json),
    "working frame": ("000001.png", read_png),
    "frozen frame": ("000001.exr", read_frozen_exr),
    "checkpoint": ("checkpoint.safetensors", open_stored),
    "layers of an EXR": ("plate.exr", find_layer),
    "ST map": ("map.exr", lambda path: fingerprint(str(path))),
    "PLY": ("any.ply", read_ply),
    "arrays": ("points.npz", lambda path: open_arrays(path).__enter__()),
}


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "sparse"])
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_refused_by_its_name(tmp_path: Path, reader: str, kind: str):
    name, read = READERS[reader]
    path = make(tmp_path / name, kind)
    with pytest.raises((ValueError, OSError), match=name):
        read(path)


def test_a_colmap_model_of_sparse_files(tmp_path: Path):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        make(tmp_path / name, "sparse")
    with pytest.raises(UnreadableFile, match=r"cameras\.bin is 42\.9 GB"):
        read_model(tmp_path)


def test_the_key_of_a_frame_that_is_none(tmp_path: Path):
    assert [read_key(make(tmp_path / kind, kind)) for kind in ("pipe", "device", "folder", "sparse")] == [None] * 4
    assert read_key(tmp_path / "absent.exr") is None


def test_a_file_that_is_whole_is_opened(tmp_path: Path):
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert regular_file(path, 5) == str(path)
    with pytest.raises(UnreadableFile, match="too large for this kind of file"):
        regular_file(path, 4)
    link = tmp_path / "link"
    link.symlink_to(path)
    with open_regular(link, 5) as source:
        assert source.read() == b"12345"


def packed(path: Path, size: int, header: str = "") -> Path:
    """Write an .npz whose array "xyz" has `size` bytes, or the given header."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("xyz.npy", "w", force_zip64=True) as member:
            text = header or f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({size},), }}"
            member.write(b"\x93NUMPY\x01\x00" + (len(text) + 1).to_bytes(2, "little") + text.encode() + b"\n")
            for _ in range(size >> 20):
                member.write(bytes(1 << 20))
    return path


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 3), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3), }",
        "{'descr': '<f4'",
        "[" * 5000,
    ],
)
def test_arrays_whose_header_lies(tmp_path: Path, header: str):
    path = packed(tmp_path / "points.npz", 0, header)
    with pytest.raises(ValueError, match=r"points\.npz is damaged"):
        with open_arrays(path) as source, np.load(source, allow_pickle=False) as arrays:
            arrays["xyz"]


def test_arrays_that_unpack_to_more_than_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = packed(tmp_path / "points.npz", 64 << 20)
    assert path.stat().st_size < 1 << 20
    with open_arrays(path) as source, np.load(source, allow_pickle=False) as arrays:
        assert arrays["xyz"].nbytes == 64 << 20
    monkeypatch.setattr("torch_backend.contract.files.LONGEST_ARRAYS", 1 << 20)
    with pytest.raises(UnreadableFile, match="too large for this kind"):
        open_arrays(path).__enter__()
