"""Digests of files: copies have equal digests, and every change of content changes the digest, also in large files."""

import os
import shutil

import pytest

from torch_backend.contract import file_digest, files_digest
from torch_backend.contract.identity import BLOCK_BYTES, BLOCKS
from torch_backend.shot import content_key


@pytest.mark.parametrize("size", [0, 10, BLOCKS * BLOCK_BYTES, BLOCKS * BLOCK_BYTES + 1, 40 << 20])
def test_a_copy_of_another_name_and_time_is_the_same_file(tmp_path, size):
    file, copy = tmp_path / "a", tmp_path / "b"
    file.write_bytes(os.urandom(min(size, 1 << 20)))
    os.truncate(file, size)
    shutil.copyfile(file, copy)
    os.utime(copy, (1, 1))
    assert file_digest(file) == file_digest(copy) and content_key(file) == content_key(copy)
    os.truncate(copy, size + 1)
    assert file_digest(file) != file_digest(copy)


@pytest.mark.parametrize("place", [0, 0.3, 0.5, 1])
def test_a_change_of_content_tells_where_size_and_time_are_the_same(tmp_path, place):
    """The change is a patch in an uncompressed picture of 35 MB: 40 rows of 16 KB."""
    size, patch = 35 << 20, 40 << 14
    keys = []
    for name in ("as filmed", "painted"):
        file = tmp_path / name
        with open(file, "wb") as stream:
            stream.truncate(size)
            if name == "painted":
                stream.seek(int(place * (size - patch)))
                stream.write(b"x" * patch)
        os.utime(file, (1, 1))
        keys.append(file_digest(file))
    assert keys[0] != keys[1]


def test_a_file_that_changes_in_its_place_is_read_again(tmp_path):
    file = tmp_path / "a"
    file.write_bytes(b"one")
    before = file_digest(file)
    file.write_bytes(b"two, longer")
    assert file_digest(file) != before


def test_files_are_known_by_number_and_content(tmp_path):
    files = {n: tmp_path / f"{n}.png" for n in (3, 4, 5)}
    for n, file in files.items():
        file.write_bytes(bytes([n]) * 100)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    copies = {n: shutil.copyfile(file, moved / f"take_{file.name}") for n, file in files.items()}
    assert files_digest(files) == files_digest(copies)
    assert files_digest(files) != files_digest({n + 1: file for n, file in files.items()})
    assert files_digest(files) != files_digest({3: files[4], 4: files[3], 5: files[5]})
    os.remove(copies[5])
    assert files_digest(files) != files_digest(copies)
    with pytest.raises(FileNotFoundError):
        file_digest(copies[5])
