"""Solve: a camera for every frame, sparse points, undistorted frames, and how good they are."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .solving import SolveConfig, SolveResult, solve_shot
    from .stored import load_points

__all__ = ["SolveConfig", "SolveResult", "load_points", "solve_shot"]


def __getattr__(name: str) -> Any:
    # Not at import: the worker starts through this package, and OpenImageIO must not be in its process.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import solving

    return getattr(solving, name)
