"""Depth maps from the artist: one picture per frame, from a phone's sensor or a monocular network.

Values are as stored: metres, disparity, or any monotonic function of depth. `train.depth_fit` finds their meaning.
Pictures are assigned to frames by number (`pairing`), and cover the whole original frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import JobError, Reporter, files_digest, is_pattern, regular_file
from ..shot import Shot
from .images import check_size, error_of
from .importing import load_frames
from .oiio_types import channel_names
from .pairing import counted_of, pair, pairing_words
from .sequence_files import find_sequence
from .sources import footage_error, frame_words

# Smallest value that means "no depth": Blender writes 1e10, other programs 1e30 or infinity.
_FARTHEST = 1e9
# Relative tolerance of a map's aspect ratio: networks round sides to multiples of 14 or 32 pixels.
_SHAPE = 0.04
# Largest difference of red, green and blue in a grey picture, in 0..1: half a step of 8 bits.
_GREY = 1.0 / 512.0


class UnusableMap(Exception):
    """Reason to ignore a depth map. The text completes the sentence "The depth map of frame 4 ..."."""


@dataclass
class DepthSequence:
    """The depth maps of a shot's frames."""

    source: Path
    """The artist's choice: a folder, one of its files or a pattern."""
    files: dict[int, Path]
    """Frame number of the shot -> file of its map, ascending."""
    aspect: float
    """Width over height of the original frames."""
    stretched: float = 1.0
    """Pixel aspect of the footage: width of a pixel over its height."""
    refused: dict[str, list[int]] = field(default_factory=dict[str, list[int]])
    """Reason -> frames whose map was ignored."""

    @property
    def key(self) -> str:
        """Digest of the numbers and contents of the files."""
        return files_digest(self.files)

    def read(self, frame: int) -> NDArray[np.float32] | None:
        """Values [h, w] of a frame's map, NaN where unknown; None for an unusable map, with the reason in `refused`."""
        file = self.files.get(frame)
        try:
            if file is None:
                raise UnusableMap("is missing")
            values = read_map(file)
            h, w = values.shape
            if all(abs(w / h / (self.aspect / ratio) - 1.0) > _SHAPE for ratio in (1.0, self.stretched)):
                raise UnusableMap(f"has another shape than the footage ({w}x{h})")
            return values
        except UnusableMap as reason:
            self.refused.setdefault(str(reason), []).append(frame)
            return None

    def refused_words(self, frames: int) -> str:
        """A sentence about the ignored maps, out of `frames` requested maps; empty if all were usable."""
        count = sum(map(len, self.refused.values()))
        if not count:
            return ""
        reasons = "; ".join(f"{frame_words(sorted(of))} {reason}" for reason, of in self.refused.items())
        return f"{count} of {frames} depth maps of {self.source} are not used: {reasons}."


def find_depth(shot: Shot, source: str, report: Reporter) -> DepthSequence:
    """Finds the depth maps in `source` (a folder, one of its pictures or a pattern) for the shot's frames.

    Raises JobError (FOOTAGE) if there are none, or if none belongs to a frame.
    """
    path, record = Path(source), load_frames(shot)
    if not path.exists() and not is_pattern(path.name):
        raise footage_error(f"The depth sequence {path} does not exist.", "Check the path.")
    sequence = find_sequence(path)
    counted = counted_of(record)
    numbers = sorted(sequence.files)
    paired = pair(numbers, counted)
    if not paired.numbers:
        raise footage_error(
            f"None of the depth maps {sequence.pattern} ({numbers[0]} to {numbers[-1]}) belongs to a frame "
            f"({counted.frames[0]} to {counted.frames[-1]}).",
            "Number them like the clip's frames.",
        )
    words = pairing_words(f"The depth sequence {sequence.pattern}", numbers, paired)
    if words is not None:
        report.warning(*words)
    width, height = record.get("source_size") or (record["width"], record["height"])
    stretched = float(record.get("reading", {}).get("pixel_aspect", 1.0))
    files = {frame: sequence.files[number] for frame, number in paired.numbers.items()}
    return DepthSequence(path, files, width / height, stretched)


def read_map(file: Path) -> NDArray[np.float32]:
    """Values [h, w] float32 of a depth map as stored, NaN where unknown.

    Values that are not finite, zero, or at least 1e9 in magnitude are unknown. From an EXR, reads the channel Z, else
    one named depth, else Y or the only channel. Raises UnusableMap if the file holds no depth.
    """
    try:
        image = oiio.ImageInput.open(regular_file(file))
    except (OSError, ValueError) as error:
        raise UnusableMap("cannot be read") from error
    if image is None:
        error_of()
        raise UnusableMap("cannot be read")
    try:
        part, channels = _depth_channels(file, image)
        spec = image.spec()
        pixels = image.read_image(part, 0, channels.start, channels.stop, oiio.FLOAT)
        if pixels is None:
            error_of(image)
            raise UnusableMap("cannot be read")
        values = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, -1)
    finally:
        image.close()
    if values.shape[2] > 1 and float(np.ptp(np.nan_to_num(values), axis=2).max()) > _GREY:
        raise UnusableMap("is a colour picture, not a depth map")
    one = values[..., 0].copy()
    one[~(np.isfinite(one) & (one != 0.0) & (np.abs(one) < _FARTHEST))] = np.nan
    if not np.isfinite(one).any():
        raise UnusableMap("contains no depth")
    return one


def _depth_channels(file: Path, image: oiio.ImageInput) -> tuple[int, range]:
    """(part, channels) of a picture's depth. Three channels are valid only if grey. Leaves `image` at that part."""
    best: tuple[int, int, range] | None = None
    seen: list[str] = []
    part, is_exr = 0, image.format_name() == "openexr"
    while image.seek_subimage(part, 0) and (part == 0 or is_exr):
        spec = image.spec()
        try:
            check_size(file.name, spec)
        except JobError as error:
            raise UnusableMap("is too large") from error
        if spec.deep:
            raise UnusableMap("contains deep data")
        names = list(channel_names(spec))
        seen += names
        for rank, channels in _candidates(names, spec.alpha_channel, is_exr):
            if best is None or rank < best[0]:
                best = rank, part, channels
        part += 1
    if best is None:
        raise UnusableMap(f"has no depth channel, only {', '.join(seen[:8])}")
    image.seek_subimage(best[1], 0)
    return best[1], best[2]


def _candidates(names: list[str], alpha: int, is_exr: bool) -> list[tuple[int, range]]:
    """Candidates for the depth channels, as (rank, channels). The lowest rank is the most reliable."""
    found: list[tuple[int, range]] = []
    lower = [name.lower() for name in names]
    for n, name in enumerate(lower):
        layer, _, last = name.rpartition(".")
        dot = layer + "." if layer else ""
        if last == "z" and dot + "x" not in lower:  # X and Z together are a vector
            found.append((0, range(n, n + 1)))
        elif "depth" in name:
            found.append((1, range(n, n + 1)))
        elif last == "y" and dot + "x" not in lower and dot + "ry" not in lower:
            found.append((2, range(n, n + 1)))
    plain = [n for n in range(len(names)) if n != alpha]
    if len(plain) == 1:
        found.append((3, range(plain[0], plain[0] + 1)))
    elif plain[:3] == [0, 1, 2] and (not is_exr or len(plain) == 3):
        found.append((4, range(0, 3)))
    return found
