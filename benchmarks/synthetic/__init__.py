"""Synthetic scenes with truth: people who hold still and sway, filmed by a handheld camera (docs/synthetic.md)."""

from .folder import Regions, SyntheticScene

__all__ = ["Regions", "SyntheticScene"]
