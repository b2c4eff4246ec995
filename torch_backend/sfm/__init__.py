"""Structure from motion: COLMAP in a child process, its frames, masks and verdict."""
