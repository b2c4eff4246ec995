"""The step Solve: where the camera was, and what moves."""
