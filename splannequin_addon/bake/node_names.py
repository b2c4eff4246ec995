"""Names of the freeze's nodes and sockets in a compositor, and the spacing of nodes."""

from __future__ import annotations

GROUP_NAME = "Splannequin Freeze"
FROZEN, DEPTH = "Frozen", "Depth in scene units"
"""Names of nodes inside the group."""
GAP = 200.0
GRAIN = "Grain"
INVENTED = "Show What Is Invented"
SOFTNESS = "CG Softness"
"""Name of the group's input for the depth range, in scene units, over which CG and frozen frames mix."""

AS_WARP = "As Warp"
"""Name of the group's input that fades between the take's frames and the warped plate."""
