"""Images of a folder that are named by their frame numbers. No bpy."""

from __future__ import annotations

from pathlib import Path

from ...torch_backend import contract


def frame_numbers(folder: Path, suffix: str = ".exr") -> list[int]:
    """Frame numbers in a folder, ascending; empty if the folder does not exist."""
    if not folder.is_dir():
        return []
    found = (contract.frame_number(p.stem) for p in folder.iterdir() if p.suffix == suffix)
    return sorted(number for number in found if number is not None)


def frame_path(folder: Path, frame: int, suffix: str = ".exr") -> Path:
    """Path of a frame in a folder of frames."""
    return folder / contract.frame_file(frame, suffix)
