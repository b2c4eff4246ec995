"""Decodes the packets of a video in order. Undecodable packets keep their place; interlaced frames are deinterlaced."""

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

# Number of frames examined for combing, at each of two places.
_PROBED = 40
# Minimum share of combed frames in an interlaced clip. Share that idet reported as combed: none in three progressive
# clips, nine of ten in an interlaced clip, two of five in film on tape (3:2).
_COMBED_SHARE = 0.2


@dataclass
class Noticed:
    """Observations during decoding."""

    damaged: set[Fraction | None] = field(default_factory=set[Fraction | None])
    """Times of decoded packets that the container marks as incomplete."""
    interlaced: int = 0
    """Number of interlaced frames."""


def decoded(container: Any, stream: Any, noticed: Noticed | None = None, fields: str = "") -> Iterator[Any]:
    """Progressive frames, with an FFmpegError in the place of each undecodable packet. Ends where the file breaks off.

    `fields`: result of `unmarked_fields` for an interlaced clip that is not marked as such.
    """
    noticed = noticed or Noticed()
    return _deinterlaced(stored_frames(container, stream, noticed), noticed, fields)


def unmarked_fields(container: Any, stream: Any) -> str:
    """Field order ("tff", "bff") of frames that are combed but not marked as interlaced; else empty.

    Runs FFmpeg's idet filter at the beginning and in the middle. A frame woven from two fields of different instants
    shows combing at moving edges.
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
    """Counts the next frames by "tff", "bff", "progressive" and "undetermined"."""
    graph: av.filter.Graph | None = None
    found: Counter[str] = Counter()
    try:
        for frame in islice((one for one in frames if not isinstance(one, FFmpegError)), _PROBED):
            if graph is None:
                graph = _graph(frame, ("idet", ""))
            graph.vpush(frame)
            found.update(one.metadata.get("lavfi.idet.multiple.current_frame", "") for one in _pulled(graph))
    except (FFmpegError, ValueError):  # the filter does not support the pixel format, or the size changes
        return Counter()
    return found


def time_of(item: Any) -> Fraction | None:
    """Exact presentation time of a packet or a frame in seconds; None if the container does not store it."""
    return None if item.pts is None or item.time_base is None else item.pts * item.time_base


def stored_frames(
    container: Any, stream: Any, noticed: Noticed | None = None, decoder: Any = None
) -> Iterator[Any]:  # fmt: skip
    """Like `decoded`, but without deinterlacing. `decoder`: a codec context to use in place of the stream's."""
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
    """Packets of a stream, then an empty packet, which flushes the decoder. An error ends the file early.

    Omits a truncated packet at the end of the file.
    """
    packets: Iterator[Any] = container.demux(stream)
    pending: Any = None
    while True:
        error = None
        try:
            packet = next(packets, None)
        except FFmpegError as failure:
            packet, error = None, failure
        if packet is not None and not packet.size and packet.dts is not None:
            continue  # in an AVI, a repeat of the previous frame; a decoder would read it as the end
        at_end = packet is None or not packet.size
        # A truncated last packet holds half a picture. Its error would discard the frames still in the decoder.
        if pending is not None and not (at_end and pending.is_corrupt):
            yield pending
        if at_end:
            if error is not None:
                yield error
            elif packet is not None:
                yield packet
            return
        pending = packet


def _deinterlaced(frames: Iterator[Any], noticed: Noticed, fields: str) -> Iterator[Any]:
    """Deinterlaces frames by FFmpeg's bwdif, from the first interlaced frame on. Keeps the number of frames.

    The filter does not change progressive frames. With `fields` ("tff" or "bff"), all frames count as interlaced.
    """
    graph: av.filter.Graph | None = None
    size: tuple[int, int, str] | None = None
    for frame in frames:
        failed = isinstance(frame, FFmpegError)
        # The filter looks one frame ahead: without a flush, that frame would come after the error or get lost.
        if graph is not None and (failed or _size(frame) != size):
            yield from _flushed(graph)
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
        yield from _flushed(graph)


def _size(frame: av.VideoFrame) -> tuple[int, int, str]:
    return frame.width, frame.height, frame.format.name


def _deinterlacer(frame: av.VideoFrame, fields: str) -> av.filter.Graph:
    """A graph that makes one picture of each frame: keeps the first field and interpolates the other lines."""
    options = f"parity={fields}:deint=all" if fields else "parity=auto:deint=interlaced"
    return _graph(frame, ("bwdif", f"mode=send_frame:{options}"))


def _graph(frame: av.VideoFrame, *filters: tuple[str, str]) -> av.filter.Graph:
    """A chain of filters, given as (name, options), for frames of this size and format."""
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


def _flushed(graph: av.filter.Graph) -> Iterator[Any]:
    graph.vpush(None)
    yield from _pulled(graph)
