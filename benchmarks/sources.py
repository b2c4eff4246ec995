"""Scenes for the benchmark: folders of truth, real clips, and the synthetic scenes of benchmarks/synthetic.

`python -m benchmarks.sources` runs `python -m benchmarks.synthetic` and ends when its parent ends.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.report.truth import RealScene, TruthFolder, TruthScene
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.synthetic.make import scene_name
from benchmarks.synthetic.shot import SolvedPixels, exact_shot, similarity_to_exact, solved_shot
from benchmarks.synthetic.sizes import LIMITS, REPORT_SEEDS, SIZES, TUNING_SEEDS
from torch_backend.contract import JobError, Reporter, read_json
from torch_backend.motion_search import find_motion
from torch_backend.native import default_threads
from torch_backend.shot import SHOT_SUFFIX, Shot, content_key, locked

ROOT = Path(__file__).resolve().parents[1]


def load_source(source: str, results: Path) -> TruthScene:
    """The scene of `truth:FOLDER`, `shot:FOLDER`, `exact:FOLDER` or `solved:FOLDER`. ValueError for anything else.

    The last two are scenes of benchmarks/synthetic with exact cameras or with cameras solved by COLMAP. Their shot to
    train on is made in RESULTS/shots if missing.
    """
    kind, _, folder = source.partition(":")
    if kind == "truth":
        scene = TruthFolder(folder)
        # Find motion mattes now, so that all runs of a scene train with them, in any order of judging.
        # Unreadable footage has no mattes, and plate detail is not judged either (`evaluate_run`).
        with locked(scene.shot.root / "bench" / "motion.lock"), contextlib.suppress(JobError):
            find_motion(scene.shot, Log())
        return scene
    if kind == "shot":
        return RealScene(Shot.open(folder))
    if kind in ("exact", "solved"):
        return SyntheticTruth(folder, kind, results / "shots")
    raise ValueError(f"scene {source!r}: it should be truth:FOLDER, shot:FOLDER, exact:FOLDER or solved:FOLDER")


class SyntheticTruth:
    """A scene of benchmarks/synthetic with the interface `TruthScene`."""

    kind = "synthetic"
    judged = "whole"

    def __init__(self, folder: str | Path, cameras: str, shots: Path) -> None:
        """FileNotFoundError if the scene is not finished; JobError if its cameras cannot be solved."""
        self.scene = SyntheticScene.load(folder)
        self.cameras = cameras
        self.name = f"{self.scene.size} {self.scene.name}"
        place = shots / f"{self.scene.size}-{self.scene.name}-{cameras}{SHOT_SUFFIX}"
        self.shot = (exact_shot if cameras == "exact" else solved_shot)(self.scene, place, Log())
        # Training uses motion mattes, which a shot with exact cameras lacks.
        find_motion(self.shot, Log())
        self._pixels = SolvedPixels(self.shot)
        self.t_stars, self._poses = list(self.scene.t_stars), list(self.scene.poses)
        steps = np.diff(self._poses)
        self.fps = self.scene.fps / float(steps[0]) if len(steps) and (steps == steps[0]).all() else 0.0
        identity = {name: self.scene.info[name] for name in ("version", "key") if name in self.scene.info}
        self.key = content_key(identity, read_json(self.shot.solve / "cameras.json"))

    def poses(self, t_star: int, held_out: Sequence[int]) -> list[int]:
        """All poses with truth and a camera."""
        return [pose for pose in self._poses if pose in self.scene.world_to_camera]

    def truth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """The rendered truth, undistorted like the clip's frames."""
        return self._resampled(self.scene.truth(t_star, pose), width, height)

    def regions(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """Regions by truth (seen at t* or not, moving or static) and a hard scene's things, by nearest pixel."""
        regions = self._pixels.regions(self.scene.regions(t_star, pose))
        seen, moving = (_nearest(mask, width, height) for mask in (regions.seen, regions.moving))
        objects = {name: _nearest(mask, width, height) for name, mask in regions.objects.items()}
        return {"seen": seen, "never_seen": ~seen, "moving": moving, "static": ~moving, **objects}

    @property
    def metres_per_unit(self) -> float:
        """Metres per solve unit of the shot; 1 with exact cameras."""
        return 1.0 if self.cameras == "exact" else similarity_to_exact(self.scene, self.shot).scale

    def depth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """[height, width] depth in metres along the camera's axis, to a millimetre, inf for sky; by nearest pixel."""
        depth = self._pixels.regions(self.scene.regions(t_star, pose)).depth
        return torch.nn.functional.interpolate(
            torch.from_numpy(depth)[None, None], (height, width), mode="nearest-exact"
        )[0, 0]

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """{thing: render without it, or with it in its other state}, resampled like `truth`."""
        pixels, info = self.scene.behind(t_star, pose), self.scene.info
        names = [each["thing"] for each in info.get("held", [])] + ([info["thing"]] if "thing" in info else [])
        return {} if pixels is None else dict.fromkeys(names, self._resampled(pixels, width, height))

    def _resampled(self, pixels: NDArray[np.uint8], width: int, height: int) -> Tensor:
        image = torch.from_numpy(self._pixels.picture(pixels).astype(np.float32) / 255.0).permute(2, 0, 1)[None]
        if image.shape[-2:] != (height, width):
            image = torch.nn.functional.interpolate(image, (height, width), mode="bicubic", antialias=True)
        return image[0].permute(1, 2, 0).clamp(0.0, 1.0)

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """`moving` and `static` in the clip's own frame and a hard scene's things, by truth; by nearest pixel."""
        regions = self._pixels.regions(self.scene.frame_regions(frame))
        moving = _nearest(regions.moving, width, height)
        objects = {name: _nearest(mask, width, height) for name, mask in regions.objects.items()}
        return {"moving": moving, "static": ~moving, **objects}


def load_synthetic(folder: Path, results: Path, cameras: str = "exact") -> SyntheticTruth:
    """The scene of benchmarks/synthetic in a folder. ValueError for any other kind of scene."""
    truth = load_source(f"{cameras}:{folder.absolute()}", results.absolute())
    if not isinstance(truth, SyntheticTruth):
        raise ValueError(f"{folder}: this is only known of scenes of benchmarks/synthetic")
    return truth


def in_words(main: Callable[[Sequence[str] | None], None]) -> Callable[..., int]:
    """Wraps a command line to return an exit code and to print errors as one sentence."""

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> int:
        torch.set_num_threads(default_threads())
        try:
            main(argv)
        except (JobError, OSError, RuntimeError, ValueError, ModuleNotFoundError) as error:
            print(f"Error: {error}", file=sys.stderr)
            return 1
        return 0

    return run


def _nearest(mask: NDArray[np.bool_], width: int, height: int) -> Tensor:
    """A mask resized by nearest pixel."""
    values = torch.from_numpy(mask.astype(np.float32))[None, None]
    return torch.nn.functional.interpolate(values, (height, width), mode="nearest-exact")[0, 0] > 0.5


def make_scenes(
    size: str,
    tuning: bool,
    cameras: Sequence[str],
    folder: Path,
    bpy: str | None = None,
    kinds: Sequence[str] = ("plain",),
) -> list[str]:
    """Sources of the synthetic scenes of a size. Missing scenes are rendered in a child process.

    `kinds`: names from `synthetic.sizes.KINDS`. If any of them is in `LIMITS`, only the first seed is used. `bpy`: a
    Python with Blender's module; None finds one near the repository. RuntimeError with the child's last line if a
    scene cannot be made.
    """
    seeds = list(TUNING_SEEDS if tuning else REPORT_SEEDS)[: 1 if {*kinds} & {*LIMITS} else SIZES[size].scenes]
    command = [sys.executable, "-P", "-m", "benchmarks.sources", "--size", size, "--out", str(folder)]
    command += [*(["--bpy", bpy] if bpy else []), "--seeds", *map(str, seeds), "--kinds", *kinds]
    with subprocess.Popen(
        command, env=child_environ(), stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        errors = child.stderr.read() if child.stderr else ""
    if child.returncode:
        raise RuntimeError(f"the synthetic scenes could not be made: {last_words(errors)}")
    return [f"{c}:{folder / size / scene_name(seed, kind)}" for c in cameras for kind in kinds for seed in seeds]


def last_words(errors: str) -> str:
    """The last line written by a failed child, without messages of image libraries at exit."""
    lines = [line for line in errors.strip().splitlines() if "nanobind" not in line and not line.startswith(" - ")]
    return lines[-1] if lines else "no output"


def child_environ(**extra: str) -> dict[str, str]:
    """Environment of a child of the benchmark, with this checkout on its path and without the working directory."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1", **extra}


def end_with_parent() -> None:
    """Ends this process by SIGTERM when its standard input closes, which means that its parent has ended."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 1):
                pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


class Warnings(Reporter):
    """A reporter that collects warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(f"{message} {hint}".strip())


class Log(Reporter):
    """A reporter that prints one line per stage."""

    def __init__(self) -> None:
        self._stage = ""

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        if stage != self._stage:
            print(stage, flush=True)
            self._stage = stage

    def metric(self, stage: str, values: Mapping[str, Any]) -> None:
        print(stage, dict(values), flush=True)

    def image(self, label: str, path: str | Path) -> None:
        print(label, path, flush=True)

    def warning(self, message: str, hint: str = "") -> None:
        print(f"note: {message} {hint}", flush=True)


if __name__ == "__main__":
    from benchmarks.synthetic.__main__ import main as make

    end_with_parent()
    sys.exit(make(None))
