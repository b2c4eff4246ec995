"""The backend of Splannequin: footage, cameras, Gaussians, freeze.

It runs in a separate process with a separate Python, and never imports bpy. This file stays light, because Blender
imports `torch_backend.contract` through it.
"""

__version__ = "0.3.0"
