"""How large a benchmark is, and which scene a seed stands for."""

from __future__ import annotations

from dataclasses import dataclass

FORMAT_VERSION = 1
TUNING_SEEDS = range(0, 10)
REPORT_SEEDS = range(100, 110)
LIMITS = ("moving-shadow", "exposure-ramp", "fast-mover", "rolling-shutter")
"""Kinds of scenes beside `plain`: each breaks one assumption of the method."""
VERDICTS = ("walker", "still", "tripod")
"""Kinds of scenes that the verdict is tried on: somebody walks through, nothing moves, the camera only turns."""
HARD = ("glass", "swinging", "arm", "hair", "held")
"""Kinds of scenes each with a thing that a freeze loses: a window and a mirror, an apple on a thread, an arm that waves
or points, fine hair before a bright window, and what stands still in two states (held.py)."""
HELD = "held"
"""The kind of held.py, and the region of its truth that another state stood in."""
THING = "thing_"
"""What the names of a hard scene's masks begin with in its .npz files."""
KINDS = ("plain", *LIMITS, *VERDICTS, *HARD)
CAMERA_MOVES = ("forward", "pan", "return", "orbit")
MOVING_PX = 0.5
"""A pixel moves if its surface point is ever farther than this, in pixels of the view, from where it is at t*."""
T_STAR_STEP = 8
"""Every how many frames an instant is a candidate (paper, section Experiments)."""


@dataclass(frozen=True)
class Size:
    """Extent of one scene and how many scenes the benchmark has."""

    name: str
    scenes: int
    frames: int
    """Frames of the clip."""
    fps: float
    """Frames per second: small sizes sample the same seconds of people and camera more coarsely."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    t_stars: int
    """Frozen instants with a truth."""
    pose_step: int
    """The truth is rendered at every such pose of the clip."""
    samples: int
    """Cycles samples per rendered pixel."""
    oversize: int
    """The picture is rendered and denoised at this many times its size, then averaged."""
    texture_step: int
    """Pictures on surfaces have their size divided by this: finer than the pixels they would only be noise."""

    def t_star_indices(self) -> list[int]:
        """Zero-based frame indices of the instants: spread over the multiples of 8, never the first if few."""
        candidates = list(range(0, self.frames, T_STAR_STEP))
        if self.t_stars >= len(candidates):
            return candidates
        step = len(candidates) / self.t_stars
        return [candidates[min(int(step * (i + 0.5)), len(candidates) - 1)] for i in range(self.t_stars)]

    def pose_indices(self) -> list[int]:
        """Zero-based frame indices of the poses that have a truth."""
        return list(range(0, self.frames, self.pose_step))


SIZES = {
    size.name: size
    for size in (
        Size("tiny", 1, 12, 6.0, 96, 54, 1, 4, 4, 3, 8),
        Size("quick", 2, 48, 8.0, 240, 135, 3, 4, 4, 3, 4),
        Size("medium", 3, 64, 8.0, 256, 144, 4, 4, 4, 3, 4),
        Size("delivery", 2, 48, 8.0, 640, 360, 2, 6, 4, 2, 2),
        Size("paper", 10, 240, 24.0, 640, 360, 30, 8, 8, 2, 2),
    )
}


def place_of(seed: int, kind: str = "plain") -> str:
    """`room` or `ground`: where the scene of a seed plays. What needs a wall or a ceiling always plays in a room."""
    return "ground" if seed % 10 in (1, 4, 7) and kind not in ("glass", "swinging", "hair") else "room"


def camera_move_of(seed: int, kind: str = "plain") -> str:
    """One of CAMERA_MOVES, or `tripod`."""
    return "tripod" if kind == "tripod" else CAMERA_MOVES[seed % len(CAMERA_MOVES)]
