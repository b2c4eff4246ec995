"""Rasteriser: renders images and per-Gaussian contributions from Gaussians and cameras."""

from .api import rasterize
from .settings import RasterOutput, RasterSettings

__all__ = ["RasterOutput", "RasterSettings", "rasterize"]
