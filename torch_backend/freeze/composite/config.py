"""Configuration of the compositor."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..views.source_views import VisibilityConfig
from .state import StateConfig


@dataclass(frozen=True)
class CompositeConfig:
    """How plates are chosen, weighed and mixed. Lengths are in pixels of pictures 640 wide."""

    sources: int = 5
    """Largest number of plates per frame, including its own plate and plate t*. The others are chosen from this many
    candidates on either side of the primary plate, at distances of 1, 2, 4, 8 and 16 frames."""
    depth_error: float = 0.15
    """Assumed relative depth error. The baseline to a plate turns it into an error in pixels; at 1 pixel the plate's
    weight is halved. The value is cautious, because distant plates can look consistent and still be misplaced."""
    doubt: float = 0.05
    """Sum of weights at which half of the plates' residual is applied, as residuals are partly wrong. Against ground
    truth, the best share of a single plate's residual on movers is 0.4 to 0.65."""
    sway: float = 3.0
    """Scene flow in pixels from t* to a plate at which the plate's weight on movers falls to 1/e: long flow is less
    certain."""
    sway_trust: float = 0.15
    """Weight of a plate of another time on movers that the model explains. A depth error of one pixel misplaces plate
    t* in views far away in pose. The residual of the frame's own plate is in place, but of another time. Using both is
    better than either alone."""
    max_mover_angle: float = 20.0
    """Angle in degrees between the frame's and plate t*'s viewing rays of a mover, above which plate t*'s own pixels
    are not used. Their weight is full up to half of this angle."""
    state: StateConfig = field(default_factory=StateConfig)
    """Parameters of the posterior of a plate's state."""
    source_views: VisibilityConfig = field(default_factory=VisibilityConfig)
    """Parameters of the comparison of plates with the model."""
