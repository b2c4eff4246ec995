"""The Blender side of Splannequin: panel, operators, cameras, compositor, bake, command line.

Imports bpy, numpy, the standard library and, from the backend, only `torch_backend.contract`.
"""
