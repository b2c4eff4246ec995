"""Opens footage: which kind it is."""

from __future__ import annotations

import os
from pathlib import Path

from .ocio import Colours
from .sequence import PICTURES, SequenceSource, find_sequence
from .sources import Source, Told, footage_error
from .video import VideoSource


def open_source(
    source: str, fps: float = 0.0, layer: str = "", colours: Colours | None = None, told: Told | None = None
) -> Source:
    """Opens a video file, a folder or file or pattern of a numbered sequence.

    `fps` overrides a sequence's rate, `layer` names the layer of its pictures to take, `colours` what colour space they
    are in; None: what the files say. So does `told` for the rest.

    JobError in one sentence for what is missing, empty, or no footage at all.
    """
    if not source:
        raise footage_error(
            "No footage was given.", "Choose a video file, a picture of a numbered sequence, or a folder."
        )
    path, colours = Path(source), colours or Colours()
    try:
        is_pattern = not path.exists() and any(mark in path.name for mark in ("#", "%", "@", "*"))
        if path.is_dir():
            os.listdir(path)
    except (OSError, ValueError) as error:  # no permission, too long a name, a zero byte in it
        reason = getattr(error, "strerror", None) or error
        raise footage_error(f"The footage {source!r} cannot be opened: {reason}.", "Check the path.") from error
    special = path.exists() and not path.is_file() and not path.is_dir()
    if is_pattern or path.is_dir() or (path.suffix.lower() in PICTURES and not special):
        return _pictures(path, fps, layer, colours, told)
    if special:
        raise footage_error(f"{source} is neither a file nor a folder.", "Choose a video file or an image sequence.")
    if not path.is_file():
        raise footage_error(
            f"The footage {source} does not exist.", "Check the path; a clip on a server must be mounted."
        )
    video = VideoSource(path, colours, told)
    for value, what, own in ((fps, "rate", f"{video.info.fps:g} frames per second"), (layer, "layer", "a single one")):
        if value:
            video.warnings.append((f"The {what} {value!r} is passed over: a video has its own, {own}.", ""))
    return video


def _pictures(path: Path, fps: float, layer: str, colours: Colours, told: Told | None) -> SequenceSource:
    """A sequence. What can only be said of a video is told to be passed over."""
    told = told or Told()
    pictures = SequenceSource(find_sequence(path), fps, layer, colours, told.pixel_aspect)
    for value, what in ((told.matrix, "matrix"), (told.levels, "levels")):
        if value:
            pictures.warnings.append((f"The {what} {value!r} is passed over: pictures hold RGB as it is.", ""))
    return pictures
