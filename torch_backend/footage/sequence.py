"""Frames of a numbered image sequence through OpenImageIO; scene-linear ones become 16-bit sRGB."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from fileseq.exceptions import FileSeqException
from fileseq.filesequence import FileSequence
from numpy.typing import NDArray

from .color import linear_to_srgb
from .sources import SourceFrame, SourceInfo, footage_error, frame_words

PICTURES = {".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".dpx", ".hdr", ".tga", ".bmp", ".webp", ".jp2", ".psd"}
DEFAULT_FPS = 24.0
FEW = 2


def find_sequence(path: Path) -> FileSequence:
    """The sequence that a folder, one file of it, or a pattern (shot.####.exr, shot.%04d.png) stands for.

    JobError if there is none, if a file has no number, or if a folder holds several.
    """
    if path.is_dir():
        return _only_sequence(path)
    if path.exists():
        return _sequence_of_file(path)
    try:
        return FileSequence.findSequenceOnDisk(str(path), strictPadding=False)
    except FileSeqException as error:
        raise footage_error(
            f"No pictures match {path}.", "Check the folder and the pattern: # or %04d stands for the frame number."
        ) from error


def _only_sequence(folder: Path) -> FileSequence:
    found = [s for s in FileSequence.findSequencesOnDisk(str(folder)) if s.extension().lower() in PICTURES]
    found = [s for s in found if s.frameSet() and len(s) >= FEW]
    if not found:
        raise footage_error(
            f"The folder {folder} holds no numbered image sequence.", "Choose a folder with frames, or a video."
        )
    if len(found) > 1:
        names = ", ".join(sorted(f"{s.basename()}{'#' * s.zfill()}{s.extension()}" for s in found)[:4])
        raise footage_error(
            f"The folder {folder} holds {len(found)} image sequences ({names}).",
            "Choose one picture of the sequence you mean.",
        )
    return found[0]


def _sequence_of_file(path: Path) -> FileSequence:
    for sequence in FileSequence.findSequencesOnDisk(str(path.parent)):
        numbered = bool(sequence.frameSet()) and len(sequence) >= FEW
        if numbered and path.name in {Path(name).name for name in sequence}:
            return sequence
    raise footage_error(
        f"{path.name} is a single picture, not part of a numbered sequence.",
        "A freeze needs a clip: choose a video or a sequence.",
    )


class SequenceSource:
    """A numbered sequence. Frame numbers are those of the files; missing and unreadable ones are left out."""

    def __init__(self, sequence: FileSequence, fps: float = 0.0) -> None:
        self.warnings: list[tuple[str, str]] = []
        frame_set = sequence.frameSet()
        numbers = sorted(int(n) for n in frame_set) if frame_set else []
        self._files = {n: Path(sequence.frame(n)) for n in numbers}
        self._files = {n: file for n, file in self._files.items() if file.is_file()}
        if len(self._files) < FEW:
            raise footage_error(f"{sequence} holds fewer than {FEW} pictures.", "Choose a longer sequence.")
        first, spec = self._first_readable()
        linear = _is_linear(first, spec)
        rate = spec.getattribute("framesPerSecond") or spec.getattribute("FramesPerSecond")
        if isinstance(rate, tuple):  # a rational, as OpenEXR stores it
            rate = rate[0] / rate[1] if rate[1] else 0.0
        stats = [f.stat() for f in self._files.values()]
        self.info = SourceInfo(
            width=spec.full_width,
            height=spec.full_height,
            fps=float(fps or rate or DEFAULT_FPS),
            first=min(self._files),
            last=max(self._files),
            deep=linear or str(spec.format) not in ("uint8", "int8"),
            colour="linear" if linear else "srgb",
            key=[str(sequence), len(stats), sum(s.st_size for s in stats), max(s.st_mtime_ns for s in stats)],
        )

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        first = self.info.first if first is None else first
        last = max(self._files) if last is None else last
        missing = [
            n for n in range(max(first, self.info.first), min(last, max(self._files)) + 1) if n not in self._files
        ]
        if missing:
            self.warnings.append(
                (f"The sequence lacks {frame_words(missing)}.", "Those frames are left out of the shot.")
            )
        unreadable = []
        for number in sorted(n for n in self._files if first <= n <= last):
            try:
                pixels, clipped = self._read(self._files[number])
            except OSError:
                unreadable.append(number)
                continue
            yield SourceFrame(number, (number - self.info.first) / self.info.fps, pixels, clipped=clipped)
        if unreadable:
            words = frame_words(unreadable).capitalize()
            self.warnings.append((f"{words} cannot be read: left out of the shot.", "Render or copy it again."))

    def _first_readable(self) -> tuple[Path, oiio.ImageSpec]:
        for file in self._files.values():
            buffer = oiio.ImageBuf(str(file))
            if not buffer.has_error and buffer.spec().width > 0:
                return file, buffer.spec()
            buffer.geterror()
        raise footage_error(
            f"No picture of the sequence in {file.parent} can be read.",
            "Open one in Blender to see whether it is whole.",
        )

    def _read(self, file: Path) -> tuple[NDArray, float]:
        """[H, W, 3] uint8 or uint16 sRGB, and the share of clipped pixels. OSError if unreadable."""
        buffer = oiio.ImageBuf(str(file))
        spec = buffer.spec()
        size, begun = (spec.full_width, spec.full_height), (self.info.width, self.info.height)
        if not buffer.has_error and size != begun:
            raise footage_error(
                f"{file.name} is {size[0]}x{size[1]}, the sequence began with {begun[0]}x{begun[1]}.",
                "All pictures of a sequence need one size.",
            )
        roi = oiio.ROI(
            spec.full_x,
            spec.full_x + spec.full_width,
            spec.full_y,
            spec.full_y + spec.full_height,
            0,
            1,
            0,
            spec.nchannels,
        )
        kind = oiio.FLOAT if self.info.deep else oiio.UINT8
        pixels = None if buffer.has_error else buffer.get_pixels(kind, roi)
        if pixels is None or buffer.has_error:
            raise OSError(f"{file}: {buffer.geterror()}")
        rgb = np.asarray(pixels)[..., _rgb_channels(spec)]
        if not self.info.deep:
            return np.ascontiguousarray(rgb), 0.0
        rgb = np.nan_to_num(rgb, nan=0.0, posinf=65504.0, neginf=0.0)
        clipped = 0.0
        if self.info.colour == "linear":
            clipped = float((rgb > 1.0).any(axis=-1).mean())
            rgb = linear_to_srgb(rgb)
        return np.rint(np.clip(rgb, 0.0, 1.0) * 65535.0).astype(np.uint16), clipped


def _is_linear(file: Path, spec: oiio.ImageSpec) -> bool:
    space = str(spec.getattribute("oiio:ColorSpace") or "").lower()
    if space.startswith("srgb") or ("rec709" in space and "lin" not in space):
        return False
    return "lin" in space or str(spec.format) in ("half", "float", "double") or file.suffix.lower() in (".exr", ".hdr")


def _rgb_channels(spec: oiio.ImageSpec) -> list[int]:
    """Indices of red, green and blue, whatever the order and the layer; one channel is taken three times."""
    names = list(spec.channelnames)
    for prefix in ("", *dict.fromkeys(n.rpartition(".")[0] + "." for n in names if "." in n)):
        wanted = [prefix + c for c in "RGB"]
        if all(w in names for w in wanted):
            return [names.index(w) for w in wanted]
    return [0, 1, 2] if spec.nchannels >= 3 else [0, 0, 0]
