"""The light of a take's frozen scene at a point: an equirectangular panorama for Blender's world."""
