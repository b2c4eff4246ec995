"""A shot, its folder as Blender sees it, and what was made for it in a scene."""
