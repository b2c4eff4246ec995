"""Every number of plate detail: how plates are chosen, weighed and mixed."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..views.source_views import VisibilityConfig
from .state import StateConfig


@dataclass(frozen=True)
class CompositeConfig:
    """How plates are chosen, weighed and mixed. Lengths are in pixels of pictures 640 wide."""

    sources: int = 5
    """Plates that a frame is made of, at most: its own and that of t* among them."""
    reach: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """How many frames before and after a pose plates are looked for that see what its own hides."""
    depth_error: float = 0.15
    """Share of the depth by which surfaces may be wrong: with the baseline, an error in pixels, at 1 of which a plate
    is believed by half. A cautious figure: near plates are right where far ones only look so."""
    doubt: float = 0.05
    """Sum of weights at which a pixel is half plate, half splats: what plates say is believed in part, as it is wrong
    in part. On truth the best share of a single plate's residual in what moves is 0.4 to 0.65."""
    known_at: tuple[float, ...] = (0.0, -1.0, 1.0)
    """Seconds from t* at whose plates it is asked whether what moves was seen near t*."""
    rough: int = 1
    """Pixels of decisions around a place that a plate has to show, too, to fill it where something moves: depth is
    rough there, what it is seen to show changes from pixel to pixel along edges, and single ones would stand out."""
    sway: float = 3.0
    """Travel in pixels from t* to a plate at which what moves in it is believed 1/e: longer ones are known less."""
    sway_trust: float = 0.15
    """How far a plate of another time is believed in what moves, where the model explains it. Depths that are off by a
    pixel carry plate t* to a wrong place far away in pose; the own plate's residual is at its place, at another time:
    either alone is worse than both."""
    agreement: float = 0.03
    """Low-passed difference, display-referred, between a plate of another time and plate t* at which the first is
    believed 1/e in what moves: it may show another state."""
    beside: tuple[float, float] = (10.0, 20.0)
    """Angle in degrees between the frame's and plate t*'s view of a surface: up to the first that plate's own pixels
    are believed of what moves, from the second on not."""
    state: StateConfig = field(default_factory=StateConfig)
    """How the posterior of a plate's state is computed."""
    source_views: VisibilityConfig = field(default_factory=VisibilityConfig)
    """How plates are compared with the model."""
