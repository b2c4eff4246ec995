"""Names of nodes and sockets of the freeze in a compositor, and how far nodes stand apart."""

from __future__ import annotations

GROUP_NAME = "Splannequin Freeze"
FROZEN, DEPTH = "Frozen", "Depth in scene units"
"""Nodes inside the group."""
GAP = 200.0
GRAIN = "Grain"
INVENTED = "Show What Is Invented"
SOFTNESS = "CG Softness"
"""Name of the group's input for the depth over which CG and frozen mix, in scene units."""

AS_WARP = "As Warp"
"""Name of the group's input that fades between the take's own frames and the warped plate."""
