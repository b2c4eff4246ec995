"""Gaussians and cameras in, images and per-Gaussian contributions out."""

from .api import rasterize
from .settings import RasterOutput, RasterSettings

__all__ = ["RasterOutput", "RasterSettings", "rasterize"]
