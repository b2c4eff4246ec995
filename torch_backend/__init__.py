"""The backend of Splannequin: footage, cameras, Gaussians, freeze. Its own process, its own Python; never imports bpy.

This file stays light: Blender reads `torch_backend.contract` through it.
"""

__version__ = "0.3.0"
