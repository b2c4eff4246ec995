"""Packets and frames of a video as they come: what cannot be decoded keeps its place, fields become whole pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import av
import av.filter
from av.error import FFmpegError


@dataclass
class Noticed:
    """What decoding found on its way."""

    damaged: set[Fraction | None] = field(default_factory=set[Fraction | None])
    """Times of packets that were decoded although the container knows them to be incomplete."""
    interlaced: int = 0
    """Frames of two fields."""


def decoded(container: Any, stream: Any, noticed: Noticed | None = None) -> Iterator[Any]:
    """Whole pictures, and in the place of a packet that cannot be decoded its error. Ends where the file breaks off."""
    noticed = noticed or Noticed()
    return _whole_pictures(stored_frames(container, stream, noticed), noticed)


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


def _whole_pictures(frames: Iterator[Any], noticed: Noticed) -> Iterator[Any]:
    """Frames as many as came; from the first interlaced one on through FFmpeg's bwdif, which leaves others alone.

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
        noticed.interlaced += bool(frame.interlaced_frame)
        if graph is None and frame.interlaced_frame:
            graph, size = _deinterlacer(frame), _size(frame)
        if graph is None:
            yield frame
            continue
        graph.vpush(frame)
        yield from _pulled(graph)
    if graph is not None:
        yield from _rest(graph)


def _size(frame: av.VideoFrame) -> tuple[int, int, str]:
    return frame.width, frame.height, frame.format.name


def _deinterlacer(frame: av.VideoFrame) -> av.filter.Graph:
    """A graph that makes one picture of each frame: of the field that comes first, the other's lines interpolated."""
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or Fraction(1, 1000)
    )
    bwdif = graph.add("bwdif", "mode=send_frame:parity=auto:deint=interlaced")
    graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
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
