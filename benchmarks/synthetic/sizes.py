"""Sizes of the benchmark, and properties of a scene that follow from its seed."""

from __future__ import annotations

from dataclasses import dataclass

FORMAT_VERSION = 1
TUNING_SEEDS = range(0, 10)
REPORT_SEEDS = range(100, 110)
LIMITS = ("moving-shadow", "exposure-ramp", "fast-mover", "rolling-shutter")
"""Kinds of scenes that each break one assumption of the method."""
VERDICTS = ("walker", "still", "tripod")
"""Kinds of scenes for testing the verdict: a person walks through, nothing moves, the camera only turns."""
HARD = ("glass", "swinging", "arm", "hair", "held")
"""Kinds of scenes, each with a thing that a freeze tends to lose. These are a window and a mirror, an apple on a
thread, an arm that waves or points, fine hair before a bright window, and things that are still in two states
(held.py)."""
HELD = "held"
"""The kind of held.py, and the region of its truth that showed another state."""
OBJECT_PREFIX = "thing_"
"""Prefix of a hard scene's mask names in its .npz files."""
KINDS = ("plain", *LIMITS, *VERDICTS, *HARD)
CAMERA_MOVES = ("forward", "pan", "return", "orbit")
MOVING_PX = 0.5
"""Displacement of a surface point from its place at t*, in pixels of the view, above which its pixel moves."""
T_STAR_STEP = 8
"""Interval in frames between candidate instants (paper, section Experiments)."""


@dataclass(frozen=True)
class Size:
    """Extent of one scene, and number of scenes in the benchmark."""

    name: str
    scenes: int
    frames: int
    """Number of frames of the clip."""
    fps: float
    """Frames per second; small sizes sample the same motion more coarsely."""
    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""
    t_stars: int
    """Number of frozen instants with truth."""
    pose_step: int
    """Interval in frames between poses at which the truth is rendered."""
    samples: int
    """Cycles samples per rendered pixel."""
    oversize: int
    """Factor by which the picture is rendered and denoised larger, then averaged."""
    texture_step: int
    """Divisor of texture sizes; texels finer than the picture's pixels would only be noise."""

    def t_star_indices(self) -> list[int]:
        """Zero-based frame indices of the instants, spread over the multiples of 8; without the first frame if few."""
        candidates = list(range(0, self.frames, T_STAR_STEP))
        if self.t_stars >= len(candidates):
            return candidates
        step = len(candidates) / self.t_stars
        return [candidates[min(int(step * (i + 0.5)), len(candidates) - 1)] for i in range(self.t_stars)]

    def pose_indices(self) -> list[int]:
        """Zero-based frame indices of the poses with truth."""
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
    """Place of a seed's scene: `room` or `ground`. Kinds that need a wall or a ceiling are always in a room."""
    return "ground" if seed % 10 in (1, 4, 7) and kind not in ("glass", "swinging", "hair") else "room"


def camera_move_of(seed: int, kind: str = "plain") -> str:
    """One of CAMERA_MOVES, or `tripod`."""
    return "tripod" if kind == "tripod" else CAMERA_MOVES[seed % len(CAMERA_MOVES)]
