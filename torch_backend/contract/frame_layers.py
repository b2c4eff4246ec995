"""Frozen frames: what their layers hold."""

from __future__ import annotations

EXR_LAYERS = ("Combined", "Depth", "Support", "Motion")
"""Passes of a frozen frame: premultiplied scene-linear RGBA, planar depth in solve units, two mattes in [0, 1]."""
NO_DEPTH = 1e10
"""Depth of a pixel that nothing covers (what Blender's own Z pass says)."""
