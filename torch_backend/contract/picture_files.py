"""Checks whether a picture, a movie or a .blend is whole, without decoding it.

Blender reports success for a file that was cut off by a full disk, and reads most truncated files without an error.

Each format is checked by what its specification says about its end: a trailer, a stated size, or a table of offsets.
"""

from __future__ import annotations

import errno
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from .files import LONGEST_LINE, open_regular

_LINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""OpenEXR: number of the compression -> scan lines in a chunk."""


def is_whole_picture(path: Path) -> bool:
    """True if a file is a whole picture, movie or .blend; False if it is truncated or missing.

    For a format without a trailer, a stated size or a table, only an empty file is detected.
    """
    try:
        with open_regular(path) as file:
            size = file.seek(0, 2)
            file.seek(0)
            check = _check_of(file.read(32), path.suffix.lower())
            file.seek(0)
            return size > 0 and (check is None or check(file, size))
    except FileNotFoundError:
        return False
    except (ValueError, struct.error, IndexError, KeyError, OverflowError):
        return False  # the file contradicts itself
    except OSError as error:
        if error.errno == errno.EINVAL:  # an offset that no file can have
            return False
        raise


def _check_of(head: bytes, suffix: str) -> Callable[[BinaryIO, int], bool] | None:
    """Check for a format, found by its first bytes, or by its suffix if it has no magic number; None if unknown."""
    for mark, check in _MARKS:
        if head.startswith(mark):
            return check
    if head[4:8] in (b"ftyp", b"jP  "):
        return _boxes
    if suffix in _SUFFIXES:
        return _SUFFIXES[suffix]
    return _damaged if suffix in _MARKED else None


def _damaged(file: BinaryIO, size: int) -> bool:
    """False: the file lacks the magic number of its format, because its first block was not written."""
    return False


def _compressed_blend(file: BinaryIO, size: int) -> bool:
    """True if Zstandard frames fill the file up to their seek table."""
    file.seek(size - 9)
    frames, _, mark = struct.unpack("<IBI", file.read(9))
    table = 8 * frames
    if mark != 0x8F92EAB1 or table + 17 > size:
        return False
    file.seek(size - 9 - table)
    lengths = sum(length for length, _ in struct.iter_unpack("<II", file.read(table)))
    return lengths + 8 + table + 9 == size


def _png(file: BinaryIO, size: int) -> bool:
    """True if every chunk has the right CRC, and the last one is IEND."""
    at = 8
    while at + 12 <= size:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if at + 12 + length > size:
            return False
        data = file.read(length)
        if struct.unpack(">I", file.read(4))[0] != zlib.crc32(kind + data):
            return False
        if kind == b"IEND":
            return True
        at += 12 + length
    return False


def _ends_with(*ends: bytes) -> Callable[[BinaryIO, int], bool]:
    def check(file: BinaryIO, size: int) -> bool:
        file.seek(max(size - 32, 0))
        return file.read().endswith(ends)

    return check


def _sized(at: int, form: str, more: int = 0) -> Callable[[BinaryIO, int], bool]:
    """Check for a format whose header states the file's size minus `more`, at offset `at` as struct format `form`."""

    def check(file: BinaryIO, size: int) -> bool:
        file.seek(at)
        return size >= struct.unpack(form, file.read(struct.calcsize(form)))[0] + more

    return check


def _exr(file: BinaryIO, size: int) -> bool:
    """True if every chunk in the offset table lies within the file and is not empty."""
    flags = struct.unpack("<4xI", file.read(8))[0]
    is_multipart = bool(flags & 0x1000)
    counts: list[int] = []
    while True:
        header = read_exr_header(file)
        if not header:
            break
        counts.append(_exr_chunks(header))
        if not is_multipart:
            break
    offsets = struct.unpack(f"<{sum(counts)}Q", file.read(8 * sum(counts)))
    before = (4 if is_multipart else 0) + (16 if flags & 0x200 else 4)  # part number, then line or tile, of a chunk
    lengths = struct.Struct("<QQ8x" if flags & 0x800 else "<i")  # deep: sizes of counts, samples, unpacked samples
    for start in offsets:
        file.seek(start + before)
        packed = lengths.unpack(file.read(lengths.size))
        if start < 16 or packed[0] <= 0 or start + before + lengths.size + sum(packed) > size:
            return False
    return bool(offsets)


def read_exr_header(file: BinaryIO) -> dict[str, bytes]:
    """Attributes of the EXR header at the current position of a file; empty after the last header."""
    found: dict[str, bytes] = {}
    while name := _text(file):
        _text(file)  # its type
        length = struct.unpack("<i", file.read(4))[0]
        if length < 0 or length > LONGEST_LINE:
            raise ValueError("an attribute is too long")
        found[name] = file.read(length)
    return found


def _text(file: BinaryIO) -> str:
    """Text up to a zero byte. ValueError if there is no zero byte."""
    found = bytearray()
    while (byte := file.read(1)) != b"\0":
        if not byte or len(found) > 255:
            raise ValueError("a name has no end")
        found += byte
    return found.decode("latin-1")


def _exr_chunks(header: dict[str, bytes]) -> int:
    """Number of chunks in a part."""
    if "chunkCount" in header:
        return int(struct.unpack("<i", header["chunkCount"])[0])
    _, top, _, bottom = struct.unpack("<4i", header["dataWindow"])
    lines = _LINES_PER_CHUNK[header["compression"][0]]
    return int(-(-(bottom - top + 1) // lines))


def _tiff(file: BinaryIO, size: int) -> bool:
    """True if the directory and all its strips or tiles are in the file."""
    order = "<" if file.read(2) == b"II" else ">"
    version = struct.unpack(order + "H", file.read(2))[0]
    big = version == 43
    where = struct.unpack(order + ("4xQ" if big else "I"), file.read(12 if big else 4))[0]
    if not where or where >= size:
        return False
    file.seek(where)
    entries = struct.unpack(order + ("Q" if big else "H"), file.read(8 if big else 2))[0]
    entry, inline = (order + "HHQ", 8) if big else (order + "HHI", 4)
    found: dict[int, tuple[int, ...]] = {}
    for n in range(min(entries, 4096)):
        file.seek(where + (8 if big else 2) + n * (struct.calcsize(entry) + inline))
        tag, kind, count = struct.unpack(entry, file.read(struct.calcsize(entry)))
        form = {3: "H", 4: "I", 16: "Q"}.get(kind)
        if tag not in (273, 279, 324, 325) or form is None:
            continue
        if count * struct.calcsize(order + form) > inline:
            file.seek(struct.unpack(order + ("Q" if big else "I"), file.read(inline))[0])
        found[tag] = struct.unpack(f"{order}{count}{form}", file.read(struct.calcsize(f"{order}{count}{form}")))
    starts, lengths = found.get(273) or found[324], found.get(279) or found[325]
    return all(start and start + length <= size for start, length in zip(starts, lengths, strict=True))


def _iris(file: BinaryIO, size: int) -> bool:
    """Silicon Graphics: True if the run-length encoded rows of the table, or the plain rows, are in the file."""
    compressed, depth, _, width, height, layers = struct.unpack(">2xBBHHHH", file.read(12))
    if not compressed:
        return size >= 512 + width * height * layers * depth
    file.seek(512)
    rows = height * layers
    starts = struct.unpack(f">{rows}I", file.read(4 * rows))
    lengths = struct.unpack(f">{rows}I", file.read(4 * rows))
    return all(start and start + length <= size for start, length in zip(starts, lengths, strict=True))


def _targa(file: BinaryIO, size: int) -> bool:
    """True if all pixels are in the file; run-length encoded pixels are counted packet by packet."""
    head = file.read(18)
    comment, mapped, kind = head[0], head[1], head[2]
    width, height, bits = struct.unpack("<HHB", head[12:17])
    pixel_bytes, pixels_left = (bits + 7) // 8, width * height
    if mapped or not pixel_bytes or not pixels_left:
        return False
    if not kind & 8:
        return size >= 18 + comment + pixels_left * pixel_bytes
    data, at = file.read(), comment
    while pixels_left > 0 and at < len(data):
        run = (data[at] & 0x7F) + 1
        at += 1 + pixel_bytes * (1 if data[at] & 0x80 else run)
        pixels_left -= run
    return pixels_left <= 0 and at <= len(data)


def _radiance(file: BinaryIO, size: int) -> bool:
    """True if all rows of an HDR picture are in the file, counted run by run."""
    data = file.read()
    start = data.index(b"\n\n") + 2
    end = data.index(b"\n", start)
    _, height, _, width = data[start:end].split()
    at, wide = end + 1, int(width)
    for _ in range(int(height)):
        if not (8 <= wide < 32768 and data[at : at + 2] == b"\2\2"):
            at += 4 * wide  # a row without runs
            continue
        at += 4
        for _ in range(4):
            left = wide
            while left > 0:
                count = data[at]
                left -= count - 128 if count > 128 else count
                at += 2 if count > 128 else 1 + count
    return at <= len(data)


def _boxes(file: BinaryIO, size: int) -> bool:
    """ISO media (MP4, MOV, JPEG 2000): True if boxes fill the file, and one is a movie's index or the picture."""
    at, kinds = 0, set[bytes]()
    while at + 8 <= size:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if length == 1:
            length = struct.unpack(">Q", file.read(8))[0]
        length = length or size - at  # 0: up to the end
        if length < 8 or at + length > size:
            return False
        kinds.add(kind)
        at += length
    if b"jp2c" in kinds:
        return _ends_with(b"\xff\xd9")(file, size)
    return at == size and b"moov" in kinds


def _matroska(file: BinaryIO, size: int) -> bool:
    """True if the segment's size, which is filled in when the file is closed, is known and fits the file."""
    head = file.read(256)
    at = head.index(b"\x18\x53\x80\x67") + 4
    length = 9 - head[at].bit_length()
    value = int.from_bytes(head[at : at + length], "big") & ((1 << (7 * length)) - 1)
    return value != (1 << (7 * length)) - 1 and at + length + value <= size


def _ogg(file: BinaryIO, size: int) -> bool:
    """True if the last page ends a stream."""
    file.seek(max(size - (1 << 17), 0))
    data = file.read()
    at = data.rindex(b"OggS")
    segments = data[at + 26]
    return bool(data[at + 5] & 4) and at + 27 + segments + sum(data[at + 27 : at + 27 + segments]) <= len(data)


_MARKS: tuple[tuple[bytes, Callable[[BinaryIO, int], bool]], ...] = (
    (b"\x89PNG\r\n\x1a\n", _png),
    (b"\xff\xd8", _ends_with(b"\xff\xd9")),
    (b"\xff\x4f\xff\x51", _ends_with(b"\xff\xd9")),  # a bare JPEG 2000 code stream
    (b"\x76\x2f\x31\x01", _exr),
    (b"II*\0", _tiff),
    (b"II+\0", _tiff),
    (b"MM\0*", _tiff),
    (b"MM\0+", _tiff),
    (b"RIFF", _sized(4, "<I", 8)),  # WebP and AVI
    (b"BM", _sized(2, "<I")),
    (b"SDPX", _sized(16, ">I")),
    (b"XPDS", _sized(16, "<I")),
    (b"\x80\x2a\x5f\xd7", _sized(20, ">I")),  # Cineon
    (b"\xd7\x5f\x2a\x80", _sized(20, "<I")),
    (b"#?RADIANCE", _radiance),
    (b"\x01\xda", _iris),
    (b"\x1a\x45\xdf\xa3", _matroska),
    (b"OggS", _ogg),
    (b"\x28\xb5\x2f\xfd", _compressed_blend),
    (b"BLENDER17", _ends_with(b"ENDB" + bytes(28))),  # the header of the last, empty block, since 5.0
    (b"BLENDER-", _ends_with(b"ENDB" + bytes(20))),
)
_SUFFIXES: dict[str, Callable[[BinaryIO, int], bool]] = {".tga": _targa}
_MARKED = {
    ".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".bmp", ".dpx", ".cin", ".hdr", ".rgb", ".jp2", ".j2c",
    ".mp4", ".mov", ".mkv", ".webm", ".avi", ".ogv", ".blend",
}  # fmt: skip
"""Suffixes of formats whose files begin with a magic number."""
