"""A shot: its folder from Blender's point of view, and its objects in a scene."""
