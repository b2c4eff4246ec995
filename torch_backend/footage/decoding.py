"""Packets and frames of a video as they come: what cannot be decoded keeps its place, fields become whole pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import islice
from typing import Any

import av
import av.filter
from av.error import FFmpegError

_PROBED = 40
"""Frames that are examined for fields, at each of two places."""
_COMBED_SHARE = 0.2
"""Share of those that are combed in an interlaced clip, at least."""


@dataclass
class Noticed:
    """What decoding found on its way."""

    damaged: set[Fraction | None] = field(default_factory=set[Fraction | None])
    """Times of packets that were decoded although the container knows them to be incomplete."""
    interlaced: int = 0
    """Frames of two fields."""


def decoded(container: Any, stream: Any, noticed: Noticed | None = None, fields: str = "") -> Iterator[Any]:
    """Whole pictures, and in the place of a packet that cannot be decoded its error. Ends where the file breaks off.

    `fields`: of a clip that is interlaced without saying so, as `unmarked_fields` finds it.
    """
    noticed = noticed or Noticed()
    return _whole_pictures(stored_frames(container, stream, noticed), noticed, fields)


def unmarked_fields(container: Any, stream: Any) -> str:
    """Which field comes first ("tff", "bff") of frames that are not marked as interlaced but are combed; else empty.

    Told by FFmpeg's idet from pictures at the beginning and in the middle: what moves is combed where two fields of
    different instants were woven into one frame. Of three progressive clips it calls no frame combed, of an interlaced
    one nine of ten, of film on tape (3:2) two of five.
    """
    combed: Counter[str] = Counter()
    for spot in (0.0, 0.5):
        if spot:
            try:
                container.seek(int(spot * (container.duration or 0)))
            except FFmpegError:
                break
        seen = _combed(stored_frames(container, stream))
        if seen["tff"] + seen["bff"] >= _COMBED_SHARE * max(_PROBED / 4, seen.total()):
            combed += seen
    return max(("tff", "bff"), key=lambda order: combed[order]) if combed else ""


def _combed(frames: Iterator[Any]) -> Counter[str]:
    """How many of the next frames are "tff", "bff", "progressive" or "undetermined"."""
    graph: av.filter.Graph | None = None
    found: Counter[str] = Counter()
    try:
        for frame in islice((one for one in frames if not isinstance(one, FFmpegError)), _PROBED):
            if graph is None:
                graph = _graph(frame, ("idet", ""))
            graph.vpush(frame)
            found.update(one.metadata.get("lavfi.idet.multiple.current_frame", "") for one in _pulled(graph))
    except (FFmpegError, ValueError):  # the filter knows no such pixels, or the size changes
        return Counter()
    return found


def time_of(item: Any) -> Fraction | None:
    """When a packet or a frame is shown, exactly; None if the container does not say."""
    return None if item.pts is None or item.time_base is None else item.pts * item.time_base


def stored_frames(
    container: Any, stream: Any, noticed: Noticed | None = None, decoder: Any = None
) -> Iterator[Any]:  # fmt: skip
    """As `decoded`, but interlaced frames as they are stored. `decoder`: a codec context in place of the stream's."""
    for packet in _packets(container, stream):
        if isinstance(packet, FFmpegError):
            yield packet
            continue
        if noticed is not None and packet.is_corrupt and packet.pts is not None:
            noticed.damaged.add(time_of(packet))
        try:
            yield from packet.decode() if decoder is None else decoder.decode(packet)
        except FFmpegError as error:
            yield error


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets, the last of them empty: it asks the decoder for what it still holds. An error ends the file early.

    The packet in the middle of which a file ends is left out: it would be half a picture, and its error would cost
    those that the decoder has not given out yet.
    """
    packets: Iterator[Any] = container.demux(stream)
    held: Any = None
    while True:
        error = None
        try:
            packet = next(packets, None)
        except FFmpegError as failure:
            packet, error = None, failure
        if packet is not None and not packet.size and packet.dts is not None:
            continue  # a repeat of the frame before, in an AVI: to a decoder it means the end
        at_end = packet is None or not packet.size
        if held is not None and not (at_end and held.is_corrupt):
            yield held
        if at_end:
            if error is not None:
                yield error
            elif packet is not None:
                yield packet
            return
        held = packet


def _whole_pictures(frames: Iterator[Any], noticed: Noticed, fields: str) -> Iterator[Any]:
    """Frames as many as came; from the first interlaced one on through FFmpeg's bwdif, which leaves others alone.

    With `fields`, "tff" or "bff", all of them are taken for interlaced.

    The filter looks one frame ahead: what it holds is given out before anything that does not go through it.
    """
    graph: av.filter.Graph | None = None
    size: tuple[int, int, str] | None = None
    for frame in frames:
        failed = isinstance(frame, FFmpegError)
        if graph is not None and (failed or _size(frame) != size):
            yield from _rest(graph)
            graph = None
        if failed:
            yield frame
            continue
        noticed.interlaced += bool(frame.interlaced_frame or fields)
        if graph is None and (frame.interlaced_frame or fields):
            graph, size = _deinterlacer(frame, fields), _size(frame)
        if graph is None:
            yield frame
            continue
        graph.vpush(frame)
        yield from _pulled(graph)
    if graph is not None:
        yield from _rest(graph)


def _size(frame: av.VideoFrame) -> tuple[int, int, str]:
    return frame.width, frame.height, frame.format.name


def _deinterlacer(frame: av.VideoFrame, fields: str) -> av.filter.Graph:
    """A graph that makes one picture of each frame: of the field that comes first, the other's lines interpolated."""
    wanted = f"parity={fields}:deint=all" if fields else "parity=auto:deint=interlaced"
    return _graph(frame, ("bwdif", f"mode=send_frame:{wanted}"))


def _graph(frame: av.VideoFrame, *filters: tuple[str, str]) -> av.filter.Graph:
    """A graph of filters (name, options), for frames like this one."""
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or Fraction(1, 1000)
    )
    nodes = [graph.add(name, options) for name, options in filters]
    graph.link_nodes(source, *nodes, graph.add("buffersink")).configure()
    return graph


def _pulled(graph: av.filter.Graph) -> Iterator[Any]:
    while True:
        try:
            yield graph.vpull()
        except (BlockingIOError, EOFError):
            return


def _rest(graph: av.filter.Graph) -> Iterator[Any]:
    graph.vpush(None)
    yield from _pulled(graph)
