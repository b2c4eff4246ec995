"""The Solve step: the camera's motion, and what moves in the clip."""
