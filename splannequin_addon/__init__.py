"""The Blender side of Splannequin: panel, operators, cameras, compositor, bake, command line.

Imports bpy, numpy, the standard library and `torch_backend.contract`, nothing else of the backend.
"""
