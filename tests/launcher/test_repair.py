"""Integrity check of a repair: compares every file's contents, whatever its size and time."""

import zipfile
from pathlib import Path

import pytest

from launcher import repair
from torch_backend import contract


@pytest.fixture
def site(tmp_path: Path, write_wheel) -> Path:
    """site-packages of an environment with two packages, as pip unpacks them."""
    site = tmp_path / "venv" / "lib" / "python3.11" / "site-packages"
    for name in ("one", "two"):
        with zipfile.ZipFile(write_wheel(name, "1.0", "value = 1")) as wheel:
            wheel.extractall(site)
    return site


def test_changed_file_of_equal_size_is_detected(site: Path, tmp_path: Path):
    (site / "one.py").write_text("value = 2")
    assert contract.changed_packages(tmp_path / "venv", contract.record_packages(tmp_path / "venv", ["one"])) == []
    assert repair.drop_damaged(tmp_path / "venv", {}) == ["one"]
    assert [p.name for p in site.glob("*.dist-info")] == ["two-1.0.dist-info"]


@pytest.mark.parametrize(
    "damage", ["no record", "record of another", "record is no text", "a folder in a file's place"]
)
def test_a_record_that_cannot_be_believed(site: Path, tmp_path: Path, damage: str):
    recorded = contract.record_packages(tmp_path / "venv", ["one", "two"])
    record = site / "one-1.0.dist-info" / "RECORD"
    if damage == "no record":
        record.unlink()
    elif damage == "record of another":
        record.write_text("")  # consistent with any contents
    elif damage == "record is no text":
        record.write_bytes(bytes(range(256)))
    else:
        (site / "one.py").unlink()
        (site / "one.py").mkdir()
    assert repair.drop_damaged(tmp_path / "venv", recorded) == ["one"]


def test_what_python_compiles_is_no_damage(site: Path, tmp_path: Path):
    cached = site / "__pycache__" / "one.cpython-311.pyc"
    cached.parent.mkdir()
    cached.write_bytes(b"compiled anew")
    with open(site / "one-1.0.dist-info" / "RECORD", "a") as record:
        record.write("__pycache__/one.cpython-311.pyc,sha256=abc,5\n")
    assert repair.drop_damaged(tmp_path / "venv", {}) == []


@pytest.mark.parametrize(
    ("requirement", "cuda"),
    [('nvidia-cudnn-cu13==9; platform_system == "Linux"', True), ("cuda-toolkit==13", True), ("filelock", False)],
)
def test_a_torch_says_whether_it_needs_cuda(site: Path, tmp_path: Path, write_wheel, requirement: str, cuda: bool):
    assert not repair.needs_cuda(tmp_path / "venv")
    with zipfile.ZipFile(write_wheel("torch", "2.13.0", "", needs=requirement)) as wheel:
        wheel.extractall(site)
    assert repair.needs_cuda(tmp_path / "venv") is cuda
