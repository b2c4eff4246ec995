"""Structure from motion: COLMAP in a child process, its input frames and masks, and the check of its result."""
