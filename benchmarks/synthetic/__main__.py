"""Makes the synthetic benchmark: `python -m benchmarks.synthetic --size quick`, in the backend's environment."""

from __future__ import annotations

import argparse
import functools
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from torch_backend.contract import JobError

from .make import BpyMissingError, default_folder, find_bpy, make_scene
from .sizes import HARD, KINDS, LIMITS, REPORT_SEEDS, SIZES, TUNING_SEEDS

if TYPE_CHECKING:
    from .people import Bodies


def arguments(argv: list[str] | None) -> argparse.Namespace:
    """The parsed command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.synthetic", description=__doc__)
    parser.add_argument("--size", choices=list(SIZES), default="quick")
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        help=f"scenes to make (default: the first of {REPORT_SEEDS.start} to {REPORT_SEEDS.stop - 1}, which are for "
        f"reporting; tune on {TUNING_SEEDS.start} to {TUNING_SEEDS.stop - 1})",
    )
    parser.add_argument("--kinds", choices=KINDS, nargs="+", default=["plain"])
    parser.add_argument("--limits", action="store_true", help="also make the four limit scenes of the first seed")
    parser.add_argument("--hard", action="store_true", help="also make the four hard scenes of every seed")
    parser.add_argument("--out", type=Path, default=default_folder(), help="default: %(default)s")
    parser.add_argument("--bpy", help="Python with bpy, or its environment (default: .venv-bpy-5.0)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Makes the scenes; returns 0, or 1 with one sentence on standard error if a scene cannot be made."""
    options = arguments(argv)
    size = SIZES[options.size]
    seeds = options.seeds or list(REPORT_SEEDS)[: size.scenes]
    scenes = [(seed, kind) for kind in options.kinds for seed in seeds]
    if options.limits:
        scenes += [(seeds[0], kind) for kind in LIMITS if (seeds[0], kind) not in scenes]
    if options.hard:
        scenes += [(seed, kind) for kind in HARD for seed in seeds if (seed, kind) not in scenes]
    began = time.perf_counter()

    def say(text: str) -> None:
        print(f"[{time.perf_counter() - began:6.0f} s] {text}", flush=True)

    try:
        bpy = find_bpy(options.bpy)
        for seed, kind in scenes:
            print(make_scene(options.out, size, seed, kind, bpy, lambda: _bodies(size.texture_step), say))
    except (BpyMissingError, JobError, ModuleNotFoundError, RuntimeError, ValueError) as problem:
        print(problem, file=sys.stderr)
        return 1
    return 0


@functools.cache
def _bodies(texture_step: int) -> Bodies:
    try:
        from .people import Bodies

        return Bodies(texture_step)
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            f"{missing.name} is missing: `python -m pip install --no-deps -r requirements/bench.lock` installs it."
        ) from missing


if __name__ == "__main__":
    raise SystemExit(main())
