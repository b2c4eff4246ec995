"""Opens footage as a video or as an image sequence."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

import av
import OpenImageIO as oiio
from av.error import FFmpegError

from ..contract import JobError, is_pattern, regular_file
from .images import error_of
from .ocio import Colours
from .sequence import SequenceSource
from .sequence_files import PICTURES, find_sequence, numbered_neighbours, unreadable_pictures
from .sources import Overrides, Source, footage_error
from .video import VideoSource


def open_source(
    source: str, fps: float = 0.0, layer: str = "", colours: Colours | None = None, overrides: Overrides | None = None
) -> Source:
    """Opens a video file, or a numbered sequence by its folder, one of its files or a pattern.

    `fps` overrides the rate of a sequence. `layer` is the layer of a sequence, or the stream number of a video.
    `colours` and `overrides` override what the files declare; None: no overrides.

    Raises JobError if the footage is missing, empty or of an unknown kind.
    """
    if not source:
        raise footage_error(
            "No footage was given.", "Choose a video file, a picture of a numbered sequence, or a folder."
        )
    path, colours = Path(source), colours or Colours()
    try:
        is_sequence = not path.exists() and is_pattern(path.name)
        if path.is_dir():
            os.listdir(path)
    except (OSError, ValueError) as error:  # no permission, a name that is too long or has a zero byte
        reason = getattr(error, "strerror", None) or error
        raise footage_error(f"The footage {source!r} cannot be opened: {reason}.", "Check the path.") from error
    if is_sequence or path.is_dir() or (path.is_file() and not opens_as_video(path)):
        return _pictures(path, fps, layer, colours, overrides)
    if path.exists() and not path.is_file():
        raise footage_error(f"{source} is neither a file nor a folder.", "Choose a video file or an image sequence.")
    if not path.is_file():
        raise footage_error(
            f"The footage {source} does not exist.", "Check the path; a clip on a server must be mounted."
        )
    video = open_video(path, colours, overrides, layer)
    layer = "" if video.has_streams else layer
    for value, what, kept in (
        (fps, "rate", f"its own, {video.info.fps:g} frames per second"),
        (layer, "layer", "only one"),
    ):
        if value:
            video.warnings.append((f"The {what} {value!r} is ignored: a video has {kept}.", ""))
    return video


def opens_as_video(path: Path) -> bool:
    """True if a file is to be opened as a video: any file except a still picture that OpenImageIO reads."""
    if path.suffix.lower() not in PICTURES:
        return True
    picture = oiio.ImageInput.open(regular_file(path))
    if picture is None:  # damaged: `SequenceSource` reports it
        error_of()
        return False
    try:
        if picture.format_name() == "png":  # OpenImageIO only reads the first picture of an animated PNG
            with av.open(regular_file(path)) as container:
                return container.format.name == "apng"
        return bool(picture.spec().get_int_attribute("oiio:Movie"))
    except FFmpegError:
        return False
    finally:
        picture.close()


def open_video(
    path: Path, colours: Colours | None = None, overrides: Overrides | None = None, layer: str = ""
) -> VideoSource:
    """Opens a video. Raises JobError for a still picture, and for an animated picture that cannot be read."""
    try:
        video = VideoSource(path, colours, overrides, layer)
    except JobError as error:
        if path.suffix.lower() in PICTURES:
            raise footage_error(
                f"{path.name} is an animated picture that cannot be read as a clip.",
                "Convert it to a video (MP4) or to numbered PNG pictures.",
            ) from error
        _refuse_pictures(path)
        raise
    if (video.info.last or 1) <= 1 and not _is_clip(path):
        _refuse_pictures(path)
        raise footage_error(
            f"{path.name} is a single picture.", "A freeze needs a clip: choose a video or a numbered sequence."
        )
    return video


def _refuse_pictures(path: Path) -> None:
    """Raises JobError if a file belongs to numbered pictures of an unreadable format. Ignores numbered videos."""
    found = numbered_neighbours(path)
    if found is not None and not any(_is_clip(path.parent / name) for name in list(found.files.values())[:3]):
        raise unreadable_pictures(found.pattern)


def _is_clip(path: Path) -> bool:
    """True if a file is a video with at least two frames."""
    try:
        return len(list(islice(VideoSource(path).frames(None, 2), 2))) == 2
    except JobError:
        return False


def _pictures(path: Path, fps: float, layer: str, colours: Colours, overrides: Overrides | None) -> SequenceSource:
    """Opens a sequence. Warns that options for videos are ignored."""
    overrides = overrides or Overrides()
    pictures = SequenceSource(find_sequence(path), fps, layer, colours, overrides.pixel_aspect, overrides.look)
    for value, what in ((overrides.matrix, "matrix"), (overrides.levels, "levels")):
        if value:
            pictures.warnings.append((f"The {what} {value!r} is ignored: pictures already store RGB.", ""))
    return pictures
