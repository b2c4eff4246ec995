"""Makes whole scenes: geometry, then pictures in a bpy process, then regions. Every step can be resumed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_backend.shot import content_key, need_disk, write_json

from .cameras import intrinsics
from .generate import (
    EXPOSURE_RAMP_STOPS,
    SHUTTER_FRAMES,
    SHUTTER_SECONDS,
    SUBFRAMES,
    frame_number,
    frame_seconds,
    write_geometry,
)
from .panes import GLASS, MIRROR, MIRROR_SHARE
from .regions import views_of, write_regions
from .sizes import FORMAT_VERSION, MOVING_PX, Size, camera_move_of, place_of

if TYPE_CHECKING:
    from .people import Bodies

GENERATOR_VERSION = 1
"""Increase when the same seed gives another scene; folders of other versions are refused."""
ROOT = Path(__file__).resolve().parents[2]
RENDERER = Path(__file__).with_name("render_bpy.py")
USUAL_BPY = ".venv-bpy-5.0"
_LAST_LINES = 5

Say = Callable[[str], None]


class BpyMissingError(RuntimeError):
    """No Python with bpy was found; the message says what to do."""


def default_folder() -> Path:
    """Default folder of scenes: in the user's cache, outside the repository."""
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "splannequin" / "synthetic"


def find_bpy(requested: str | Path | None) -> Path:
    """The Python of an environment with a bpy wheel. `requested`: that Python, its environment's folder, or None."""
    home = Path(os.environ.get("SPLANNEQUIN_HOME") or ROOT).expanduser()  # where set-up makes environments
    places = [Path(requested)] if requested else [home / USUAL_BPY, *sorted(home.glob(".venv-bpy-*"), reverse=True)]
    for place in places:
        for python in (place, place / "bin" / "python", place / "Scripts" / "python.exe"):
            if python.is_file():
                return python
    raise BpyMissingError(
        f"No Python with bpy in {places[0]}: make it with `python3 splannequin.py setup`, or name one by --bpy."
    )


def scene_name(seed: int, kind: str) -> str:
    """Folder name of a scene within the folder of its size."""
    return f"seed-{seed:03d}" if kind == "plain" else f"{kind}-{seed:03d}"


def make_scene(out: Path, size: Size, seed: int, kind: str, bpy: Path, bodies: Callable[[], Bodies], say: Say) -> Path:
    """The folder of a finished scene in `out`/<size>/, made or completed if necessary.

    `bodies` is called only if geometry is missing. ValueError if the folder holds another version's scene, RuntimeError
    with the renderer's last lines if it fails.
    """
    folder = out / size.name / scene_name(seed, kind)
    key = content_key(FORMAT_VERSION, GENERATOR_VERSION, size, seed, kind)
    for name in ("scene.json", "plan.json"):
        record = folder / name
        if record.is_file() and json.loads(record.read_text(encoding="utf-8"))["key"] != key:
            raise ValueError(
                f"{folder} was made by another version of the generator: remove it or choose another --out."
            )
    if (folder / "scene.json").is_file():
        say(f"{size.name}/{folder.name}: already there")
        return folder
    count = size.frames + len(size.t_star_indices()) * len(size.pose_indices())
    need_disk(out, count * size.width * size.height * 3.5 + (300 << 20), "A synthetic scene")
    began = time.perf_counter()
    if not (folder / "plan.json").is_file():
        for part in ("geometry", "textures"):
            shutil.rmtree(folder / part, ignore_errors=True)
        say(f"{size.name}/{folder.name}: geometry and textures")
        write_geometry(folder, seed, kind, size, key, bodies())
    start = time.perf_counter()
    render_pictures(folder, bpy, lambda text: say(f"{size.name}/{folder.name}: {text}"))
    rendered = time.perf_counter()
    write_regions(folder, seed, kind, size, _Eta(say, f"{size.name}/{folder.name}: regions"))
    seconds = {"geometry": start - began, "pictures": rendered - start, "regions": time.perf_counter() - rendered}
    write_record(folder, size, seed, kind, key, seconds)
    say(f"{size.name}/{folder.name}: finished, {sum(seconds.values()):.0f} s in this run")
    return folder


def render_pictures(folder: Path, bpy: Path, say: Say) -> None:
    """Runs the renderer as a child process that ends when this process ends."""
    log = folder / "render.log"
    last: list[str] = []
    eta = _Eta(say, "pictures")
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    with open(log, "ab") as errors:
        process = subprocess.Popen(
            [str(bpy), "-P", str(RENDERER), str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
            encoding="utf-8",
            errors="replace",
        )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith('{"done"'):
                    message = json.loads(line)
                    eta(message["done"], message["total"])
                elif line.strip():
                    last = [*last[1 - _LAST_LINES :], line.strip()]
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe:
                    pipe.close()
    if code != 0:
        raise RuntimeError(f"The renderer ended with code {code}, see {log}: {' '.join(last)}")


class _Eta:
    """Prints progress every few seconds, with the remaining time estimated from the mean pace."""

    def __init__(self, say: Say, what: str, every: float = 5.0) -> None:
        self.say, self.what, self.every = say, what, every
        self.began = self.printed_at = time.perf_counter()

    def __call__(self, done: int, total: int) -> None:
        now = time.perf_counter()
        if done == total or now - self.printed_at >= self.every:
            self.printed_at = now
            left = (now - self.began) / done * (total - done)
            self.say(f"{self.what} {done} of {total}" + (f", {left:.0f} s left" if done < total else ""))


def write_record(folder: Path, size: Size, seed: int, kind: str, key: str, seconds: dict[str, float]) -> None:
    """Writes scene.json, which marks the scene as complete."""
    meter = json.loads((folder / "meter.json").read_text(encoding="utf-8"))
    plan: dict[str, Any] = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    cameras = [
        {"frame": frame_number(i), "seconds": float(t), "world_to_camera": view.matrix.tolist()}
        for i, (t, view) in enumerate(zip(frame_seconds(size), views_of(seed, size, kind), strict=True))
    ]
    record = {
        "version": FORMAT_VERSION,
        "generator": GENERATOR_VERSION,
        "key": key,
        "name": folder.name,
        "seed": seed,
        "kind": kind,
        "size": size.name,
        "place": place_of(seed, kind),
        "camera_move": camera_move_of(seed, kind),
        "width": size.width,
        "height": size.height,
        "fps": size.fps,
        "K": intrinsics(size.width, size.height).tolist(),
        "units": "metres, z up; world_to_camera in OpenCV axes; K in pixels with centres at +0.5",
        "cameras": cameras,
        "t_stars": [frame_number(i) for i in size.t_star_indices()],
        "poses": [frame_number(i) for i in size.pose_indices()],
        "moving_px": MOVING_PX,
        "limits": _limits(kind),
        "people": plan["people"],
        "rendered": {
            "bpy": meter["bpy"],
            "samples": size.samples,
            "denoiser": "OpenImageDenoise on the light, before colours",
            "view_transform": "Standard (sRGB)",
            "exposure_stops": meter["stops"],
            "seconds_of_last_run": {name: round(value, 2) for name, value in seconds.items()},
            "size": asdict(size),
        },
    }
    if "thing" in plan:
        record["thing"] = plan["thing"]["name"]
    if "held" in plan:
        record["held"] = plan["held"]
        record["motion_blur"] = {
            "shutter_frames": SHUTTER_FRAMES,
            "pictures_averaged": SUBFRAMES,
            "truth": "the blur of the camera at its pose; what is frozen has none of its own",
        }
    write_json(folder / "scene.json", record)


def _limits(kind: str) -> dict[str, Any]:
    """Figures of a limit or hard scene for scene.json."""
    if kind == "exposure-ramp":
        return {"exposure_stops_over_clip": EXPOSURE_RAMP_STOPS, "truth": "with the exposure of frame t*"}
    if kind == "rolling-shutter":
        return {"readout_seconds": SHUTTER_SECONDS, "truth": "all rows at the time and the camera of the middle row"}
    if kind == "glass":
        return {"reflected": {GLASS: "16 % straight on", MIRROR: f"{MIRROR_SHARE:.0%}"}}
    if kind == "moving-shadow":
        return {"truth": "with the shadow of frame t*"}
    return {}
