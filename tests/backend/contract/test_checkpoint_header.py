"""Headers of checkpoints, from complete and damaged files."""

import json
import struct

import pytest

from torch_backend.contract import checkpoint_facts


def header(facts: object) -> bytes:
    text = json.dumps({"__metadata__": {"splannequin": json.dumps(facts)}}).encode()
    return struct.pack("<Q", len(text)) + text


def test_facts_are_read_without_what_follows_them(tmp_path):
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(header({"iterations": 7, "width_px": 320}) + b"\0" * 64)
    assert checkpoint_facts(file) == {"iterations": 7, "width_px": 320}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff" * 8,
        header({"a": 1})[:-3],
        header([1, 2]),
        struct.pack("<Q", 2) + b"{}",
        struct.pack("<Q", 4) + b"[1]]",
    ],
)
def test_foreign_or_truncated_file_has_no_header(tmp_path, content):
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(content)
    assert checkpoint_facts(file) == {}


def test_missing_file_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        checkpoint_facts(tmp_path / "checkpoint.safetensors")
