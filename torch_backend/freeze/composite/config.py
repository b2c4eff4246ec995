"""Every number of plate detail: how plates are chosen, weighed and mixed."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..views.source_views import SightingConfig
from .foreground_change import HeldConfig


@dataclass(frozen=True)
class DetailConfig:
    """How plates are chosen, weighed and mixed. Lengths are in pixels of pictures 640 wide."""

    sources: int = 5
    """Plates that a frame is made of, at most: its own and that of t* among them."""
    reach: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """How many frames before and after a pose plates are looked for that see what its own hides."""
    depth_error: float = 0.15
    """Share of the depth by which surfaces may be wrong: with the baseline, an error in pixels, at 1 of which a plate
    is believed by half. A cautious figure: near plates are right where far ones only look so."""
    margin: int = 2
    """Pixels around what moves in which the leading plate is not believed: hair, motion blur, the flow's own error."""
    feather: float = 1.5
    """Sigma of the leading plate's matte along its border, pixels."""
    doubt: float = 0.05
    """Sum of weights at which a pixel is half plate, half splats: what plates say is believed in part, as it is wrong
    in part. On truth the best share of a single plate's residual in what moves is 0.4 to 0.65."""
    known_at: tuple[float, ...] = (0.0, -1.0, 1.0)
    """Seconds from t* at whose plates it is asked whether what moves was seen near t*."""
    travel: float = 0.5
    """Pixels that the model moves a point by, from t* to the frame's own plate, from which on that plate is not
    believed there if it bears the motion out: sways too small for the flow."""
    borne_out: float = 0.02
    """By how much, display-referred, the plate's own time must explain it better than t* does."""
    thin: int = 3
    """Half the width in pixels below which such a spot, of either kind, is an outline, which a wrong depth explains."""
    moves: float = 0.25
    """Share of what is seen that the model has to move for plate t* to stand there in place of the splats."""
    beside: tuple[float, float] = (10.0, 20.0)
    """Degrees by which plate t* may see it from another side: up to the first it is believed, from the second on not;
    from further round it shows what is turned away."""
    coarser: tuple[float, float] = (1.5, 2.5)
    """Times as large as in plate t* may a frame see it: up to the first that plate is believed, from the second on not.
    A face of six pixels is none of sixty."""
    returns: float = 2.0
    """Pixels from which what plate t* has at the place of a point is seen by the frame, at most: then it shows that
    point, though their depths differ."""
    moves_surely: float = 0.5
    """As `moves`, where the splats have not fallen apart: what stands still is better as other plates have it."""
    same: float = 0.05
    """Difference between plate t* and the splats, display-referred, up to which that plate is taken along outlines of
    depth and where it does not quite see the surface,"""
    fine: float = 1.0
    """and the sigma of that."""
    outline: float = 0.1
    """Share of itself by which depth jumps at an outline of what moves: an arm that comes towards the camera is rough
    by half of that."""
    jump: float = 0.05
    """The same, for what stands still behind what moves."""
    torn: float = 0.1
    """Low-passed difference between plate t* and the splats, display-referred, from which on these have fallen apart:
    outlines, too, are as that plate has them then."""
    torn_too: float = 0.03
    """The same, for what hangs together with such a spot."""
    ghost: float = 0.06
    """Low-passed difference between plate t* and the splats, display-referred, from which on these show a ghost on what
    stands still behind what is let go of,"""
    ghost_too: float = 0.03
    """and from which on what hangs together with such a spot is of it."""
    ghost_of: tuple[float, float] = (0.8, 0.9)
    """Shares of the difference between plate t* and the leading plate that those are at most: a ghost is a part of what
    that plate shows there."""
    sliver: int = 2
    """Half the width in pixels below which of a ghost nothing is mended: along outlines bits would stand."""
    rim: int = 2
    """Pixels along the outline of what plate t* shows, and along jumps of depth, in which it does not count."""
    medians: int = 3
    """So many times over the median of 5 x 5 pixels' depths is taken there, of 3 x 3 in small pictures."""
    gap: int = 4
    """Half the width in pixels up to which gaps within what moves belong to it: there depth is rough, and what plate t*
    sees flickers from pixel to pixel."""
    unsteady: float = 1.5
    """Pixels by which displacements around such a gap may differ: by more, two surfaces meet in it."""
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
    held: HeldConfig = field(default_factory=HeldConfig)
    """What is held for a while where it was not at t*."""
    sightings: SightingConfig = field(default_factory=SightingConfig)
    """How plates are compared with the model."""
