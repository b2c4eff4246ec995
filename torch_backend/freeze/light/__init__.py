"""Renders the light of a take's frozen scene at a point as an equirectangular panorama for Blender's world."""
