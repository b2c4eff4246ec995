"""Synthetic scenes with truth: people who hold still and drift, seen by a handheld camera (docs/synthetic.md)."""

from .folder import Regions, SyntheticScene

__all__ = ["Regions", "SyntheticScene"]
