"""Solve: a camera for every frame, sparse points, undistorted frames, and how good they are."""

from .solving import SolveConfig, SolveResult, load_points, solve_shot

__all__ = ["SolveConfig", "SolveResult", "load_points", "solve_shot"]
