"""Every number of plate detail: how plates are chosen, weighed and mixed."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..views.source_views import VisibilityConfig
from .state import StateConfig


@dataclass(frozen=True)
class CompositeConfig:
    """How plates are chosen, weighed and mixed. Lengths are in pixels of pictures 640 wide."""

    sources: int = 5
    """Plates that a frame is made of, at most: its own and that of t* among them. For what the own one hides as many
    are examined on either side, each twice as many frames away as the one before: 1 to 16."""
    depth_error: float = 0.15
    """Share of the depth by which surfaces may be wrong: with the baseline, an error in pixels, at 1 of which a plate
    is trusted by half. A cautious figure: near plates are right where far ones only look so."""
    doubt: float = 0.05
    """Sum of weights at which a pixel is half plate, half splats: what plates say is trusted in part, as it is wrong
    in part. On truth the best share of a single plate's residual in what moves is 0.4 to 0.65."""
    sway: float = 3.0
    """Travel in pixels from t* to a plate at which what moves in it is trusted 1/e: longer ones are known less."""
    sway_trust: float = 0.15
    """How far a plate of another time is trusted in what moves, where the model explains it. Depths that are off by a
    pixel carry plate t* to a wrong place far away in pose; the own plate's residual is at its place, at another time:
    either alone is worse than both."""
    beside: float = 20.0
    """Angle in degrees between the frame's and plate t*'s view of a surface from which on that plate's own pixels are
    not believed of what moves; up to half of it they are."""
    state: StateConfig = field(default_factory=StateConfig)
    """How the posterior of a plate's state is computed."""
    source_views: VisibilityConfig = field(default_factory=VisibilityConfig)
    """How plates are compared with the model."""
