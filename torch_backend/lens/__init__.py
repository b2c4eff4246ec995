"""Lens models: mapping between pixels of original and undistorted frames, ST maps, and resampling."""
