"""The lens: between pixels of the original and of the undistorted frames, and resampling through it."""
