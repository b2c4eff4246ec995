"""Plates: undistorted source frames at the source's size and bit depth.

Working frames are small, and hold light only up to white, or 64 times white. Frozen frames take their pixels from the
plates instead. If the source has no more detail than the working frames, the working frames are the plates.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..cameras.stored import load_cameras, load_record
from ..contract import ExitCode, JobError, UserError
from ..lens.map_lens import MapLens
from ..lens.plate_lens import PlateLens, load_plate_lenses
from ..lens.undistort import BandUndistorter
from ..shot import Shot, content_key
from ..torch_types import from_numpy
from . import plate_encoding
from .bars import recorded_bars
from .display import display_of
from .images import read_frame, read_png, resize_float, working_size
from .importing import FootageConfig, import_keys, load_frames, source_places
from .numbering import recorded_shift, renumbered
from .ocio import Colours
from .opening import open_source
from .sources import Known, Source, SourceInfo, overrides_of

PLATES_VERSION = 1
STAYS = "Frozen frames stay at the size and depth of the working frames."
"""Last sentence of every note."""
_KEPT, _KEPT_BYTES = 11, 150e6
# A plate shows the picture of its working frame if the mean difference of each channel is below `_AGREE`, and the luma
# of less than `_DISAGREE_SHARE` of the pixels differs by more than `_AGREE`.
_AGREE = 4.0 / 255.0
_DISAGREE_SHARE = 1e-3
_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)


class Plates:
    """Undistorted source frames, read on request. Caches the last few as codes (see `plate_encoding`).

    A cached plate takes 3 to 6 bytes per pixel, up to 50 MB at 3840 x 2160. Not thread-safe.
    """

    width: int
    """Pixels of a plate."""
    height: int
    """Pixels."""
    frames: list[int]
    """Numbers of all source frames of the range, ascending, including those not used in training."""
    deep: bool
    """True if values may lie below 0 and above 1."""
    note: str
    """Sentence for a warning if working frames replace the source; empty if nothing is lost."""
    key: str
    """Key of the footage, the solve and the size."""

    def __init__(self, shot: Shot, size: tuple[int, int] | None = None, keep: int = 0) -> None:
        """`size`: width and height in pixels; None: those of the source. `keep`: maximum number of cached plates.

        The default, 0, caches the plates for a frozen frame and the next one: the frame itself, the second and the
        fourth frame before and after it, and t*. Large plates are limited to `_KEPT_BYTES`, but at least three are
        cached. Raises JobError (FOOTAGE, SOLVE) if the shot is not imported and solved.
        """
        load_cameras(shot)
        record = load_frames(shot)
        # Synthetic ground-truth scenes have cameras without the record of a solve.
        solved = load_record(shot) if shot.solve_record.is_file() else {}
        self._shot = shot
        self._files = {int(row["frame"]): str(row["file"]) for row in record["frames"]}
        self.frames = sorted(self._files)
        self._working = int(record["width"]), int(record["height"])
        self._display = display_of(record)
        self._lenses = _lenses(shot)
        source, self.note = self._find(record)
        info = source.info if source is not None else None
        self.width, self.height = size or ((info.width, info.height) if info is not None else self._working)
        self._keep = keep or min(_KEPT, max(3, int(_KEPT_BYTES / (6.0 * self.width * self.height))))
        self.deep = self._display.bends or (info is not None and info.extended)
        if not self.deep and (self.width, self.height) == self._working:
            source = None  # the working frames have the same pixels
        self._reader = source.plates(self._known(record)) if source is not None else None
        self._warp: tuple[PlateLens | MapLens, BandUndistorter] | None = None
        self._cache: OrderedDict[int, NDArray[Any]] = OrderedDict()
        footage = source.info.key if source is not None else "working frames"
        self.key = content_key(PLATES_VERSION, record.get("key"), solved.get("key"), footage, [self.width, self.height])

    def display(self, frame: int) -> Tensor:
        """A plate [H, W, 3] float32 on the CPU, in the working frames' display, with values beyond 0 to 1 if `deep`.

        Raises ValueError if the shot has no such frame, JobError (FOOTAGE, SOLVE) if its picture cannot be read.
        """
        return from_numpy(self._display.bent(plate_encoding.display(self._codes(frame))))

    def linear(self, frame: int, rows: slice = slice(None)) -> Tensor:
        """A plate in scene-linear Rec.709: all rows, or a slice to save 100 MB at 4K. Raises as `display` does."""
        return from_numpy(plate_encoding.linear(self._codes(frame)[rows]))

    @property
    def kept(self) -> int:
        """Number of cached plates."""
        return len(self._cache)

    def original(self) -> SourceInfo | None:
        """Facts of the footage, also if working frames replace it; None if it is missing or not the imported one."""
        record = load_frames(self._shot)
        config = _config(record)
        for _, source in self._opened(record, config):
            return source.info if self._is_imported(source, record, config) else None
        return None

    def lens(self) -> PlateLens | MapLens | None:
        """The lens shared by all frames; None if frames have different lenses, or the lens is unknown."""
        lenses = set(self._lenses.values()) if isinstance(self._lenses, dict) else set[PlateLens | MapLens]()
        return next(iter(lenses)) if len(lenses) == 1 else None

    def bars(self, frame: int) -> NDArray[np.bool_] | None:
        """Mask [H, W] of the letterbox or pillarbox bars in a plate, from the import's record; None without bars."""
        bars = recorded_bars(load_frames(self._shot), self.height, self.width)
        if not bars.sides:
            return None
        white = np.where(bars.mask(self.height, self.width), np.uint8(255), np.uint8(0))
        codes = self._undistorted(np.repeat(white[..., None], 3, axis=2), frame)[..., 0]
        return codes > np.iinfo(codes.dtype).max // 2

    def close(self) -> None:
        """Frees the cache and closes the footage. Later requests read the plates again."""
        self._cache.clear()
        if self._reader is not None:
            self._reader.close()

    def _codes(self, frame: int) -> NDArray[Any]:
        if frame not in self._files:
            raise UserError(f"the shot has no frame {frame}: it has {self.frames[0]} to {self.frames[-1]}")
        if frame in self._cache:
            self._cache.move_to_end(frame)
            return self._cache[frame]
        while len(self._cache) >= self._keep:
            self._cache.popitem(last=False)
        self._cache[frame] = self._read(frame)
        return self._cache[frame]

    def _read(self, frame: int) -> NDArray[Any]:
        if self._reader is None:
            picture = read_frame(self._shot.plate(frame))
            if self._display.bends:
                picture = self._display.light_of(picture)
            return plate_encoding.resize_plate(picture, self.width, self.height)
        try:
            picture = self._reader.plate(frame)
        except OSError as error:
            raise JobError(
                f"Frame {frame} of the footage can no longer be read: {error}.",
                "Check that its disk is connected and that the file is complete.",
                ExitCode.FOOTAGE,
            ) from error
        return self._undistorted(plate_encoding.resize_plate(picture, self.width, self.height), frame)

    def _undistorted(self, picture: NDArray[Any], frame: int) -> NDArray[Any]:
        """Undistorted codes: float16 stays, integer codes become 16-bit."""
        lens = self._lenses[frame] if isinstance(self._lenses, dict) else None
        if lens is None or lens.is_none:
            return picture
        if self._warp is None or self._warp[0] != lens:
            self._warp = None  # free its memory before building the next one
            self._warp = lens, BandUndistorter(lens.where(self.width, self.height))
        # Interpolated values lie between 8-bit codes.
        kind = np.dtype(np.float16 if picture.dtype == np.float16 else np.uint16)
        into = np.empty(picture.shape, kind)
        return self._warp[1](picture, plate_encoding.display, lambda x: plate_encoding.from_display(x, kind), into)

    # ------------------------------------------------------------------------------------------------- the source

    def _find(self, record: dict[str, Any]) -> tuple[Source | None, str]:
        """(footage, ""), or (None, reason) to use the working frames. The reason is empty if nothing is lost."""
        if _holds_no_more(record, self._working):
            return None, ""
        if isinstance(self._lenses, str):
            return None, f"{self._lenses} {STAYS}"
        config = _config(record)
        for place, source in self._opened(record, config):
            if not source.info.extended and (source.info.width, source.info.height) == self._working:
                return None, ""
            if self._is_imported(source, record, config):
                return source, ""
            return None, f"The footage {place} has changed since the import. {STAYS}"
        return None, f"The footage {self._shot.info().source or 'of this shot'} cannot be read. {STAYS}"

    def _opened(self, record: dict[str, Any], config: FootageConfig) -> Iterator[tuple[str, Source]]:
        """(path, footage) for each place where the footage can be opened, with the settings of the import."""
        # Use the OCIO configuration of the import: the present one may convert colours differently.
        reading: dict[str, Any] = record.get("reading") or {}
        shift = recorded_shift(record)
        colours = Colours(config.colour_space, str(reading.get("ocio", "")))
        for place in source_places(self._shot, record):
            try:
                source = open_source(place, config.fps, config.layer, colours, overrides_of(config))
                yield place, renumbered(source, shift)
            except (JobError, OSError):
                continue

    def _is_imported(self, source: Source, record: dict[str, Any], config: FootageConfig) -> bool:
        """True if the footage is the imported one, by its key or by its first, middle and last picture."""
        info = source.info
        if record.get("key") in import_keys(info, config, self._display, recorded_shift(record)):
            return True
        if working_size(info.width, info.height, config.working_height) != self._working:
            return False
        reader = source.plates(self._known(record))
        try:
            spots = {self.frames[0], self.frames[len(self.frames) // 2], self.frames[-1]}
            return all(self._agrees(n, reader.plate(n)) for n in sorted(spots))
        except (JobError, OSError):
            return False
        finally:
            reader.close()

    def _known(self, record: dict[str, Any]) -> Known:
        rows, start = record["frames"], record.get("start")
        seconds = {int(row["frame"]): float(row["seconds"]) for row in rows}
        return Known(seconds, float(start) if start is not None else None, self._agrees)

    def _agrees(self, frame: int, picture: NDArray[Any]) -> bool:
        """True if a picture of the source matches the raw working frame."""
        try:
            raw = read_png(self._shot.frames / self._files[frame])
        except (OSError, ValueError):
            return True  # there is nothing to compare
        width, height = self._working
        if self._display.bends:  # convert as the import did
            if picture.dtype != np.float16:
                return False
            small = plate_encoding.display(self._display.codes_of(picture, width, height))
        elif picture.dtype == np.float16:
            small = resize_float(np.clip(plate_encoding.display(picture), 0.0, 1.0), width, height)
        else:
            small = plate_encoding.display(plate_encoding.resize_plate(picture, width, height))
        difference = np.clip(small, 0.0, 1.0) - plate_encoding.display(raw)
        # Compare luma: colour at edges depends on chroma upsampling, which differs between versions.
        is_similar = (np.abs(difference @ _LUMA) > _AGREE).mean() < _DISAGREE_SHARE
        return bool(is_similar and np.abs(difference.mean(axis=(0, 1))).max() < _AGREE)


def _config(record: dict[str, Any]) -> FootageConfig:
    recorded: dict[str, Any] = record.get("config") or {}
    return FootageConfig(**{name: recorded[name] for name in FootageConfig.__dataclass_fields__ if name in recorded})


def _holds_no_more(record: dict[str, Any], working: tuple[int, int]) -> bool:
    """True if the record shows that the footage has the working frames' size and no values beyond 0 to 1."""
    return tuple(record.get("source_size", ())) == working and not record.get("extended", True)


def _lenses(shot: Shot) -> dict[int, PlateLens | MapLens] | str:
    """The lens of each frame, or a sentence why the lens is unknown. Raises JobError (SOLVE) if there is no solve."""
    load_cameras(shot)
    try:
        return load_plate_lenses(shot)
    except JobError as error:
        return error.message
