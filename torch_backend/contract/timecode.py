"""SMPTE timecode: the start that footage carries, and the code of each frame after it (SMPTE ST 12-1)."""

from __future__ import annotations

import re

from .errors import UserError

_TEXT = re.compile(r"(\d\d):(\d\d):(\d\d)([:;.,])(\d\d)")


def parse_timecode(text: str) -> str:
    """The timecode HH:MM:SS:FF, with ";" before FF for drop frame; empty if `text` is invalid."""
    found = _TEXT.fullmatch(text.strip())
    if found is None or int(found[1]) > 23 or int(found[2]) > 59 or int(found[3]) > 59:
        return ""
    return f"{found[1]}:{found[2]}:{found[3]}{':' if found[4] == ':' else ';'}{found[5]}"


def later(timecode: str, frames: int, fps: float) -> str:
    """The timecode `frames` frames after another one (before it if negative), wrapped at midnight. ValueError if it is
    invalid.

    The frame rate is rounded: 23.976 counts as 24, 59.94 as 60. Drop frame, at 29.97 and 59.94 only, skips the first
    frame numbers of every minute except each tenth.
    """
    found = _TEXT.fullmatch(timecode)
    rate = round(fps)
    if found is None or rate < 1:
        raise UserError(f"this is not a timecode at {fps:g} frames per second: {timecode!r}")
    hours, minutes, seconds, number = (int(found[i]) for i in (1, 2, 3, 5))
    drop = rate // 15 if found[4] != ":" and rate % 30 == 0 else 0
    total = 60 * hours + minutes
    count = (60 * total + seconds) * rate + number - drop * (total - total // 10)
    day = 24 * (3600 * rate - 54 * drop)
    count = (count + frames) % day
    if drop:
        tens, rest = divmod(count, 600 * rate - 9 * drop)
        count += 9 * drop * tens + drop * max(0, (rest - drop) // (60 * rate - drop))
    seconds, number = divmod(count, rate)
    mark = found[4] if found[4] == ":" else ";"
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{mark}{number:02d}"


def smpte_bits(timecode: str) -> tuple[int, int]:
    """Two words that OpenEXR and DPX store for a timecode: binary-coded decimals; bit 6 of the first is drop frame."""
    found = _TEXT.fullmatch(timecode)
    if found is None or int(found[5]) > 39:  # the tens of frames have two bits
        raise UserError(f"this timecode cannot be stored in a picture: {timecode!r}")
    fields = [int(found[i]) for i in (5, 3, 2, 1)]
    word = sum((value // 10 << 4 | value % 10) << 8 * i for i, value in enumerate(fields))
    return word | (0 if found[4] == ":" else 1 << 6), 0
