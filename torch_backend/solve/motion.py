"""The motion matte: per delivered frame what stands still, what moves by itself, and what is not known.

SHOT/solve/motion/NNNNNN.png, grey, of the working frames' size: STILL, UNKNOWN or MOVING. motion.json beside them says
of which frames and cameras they are. What an artist paints lies in SHOT/motion_paint/NNNNNN.png and goes before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import ExitCode, JobError, Reporter, frame_file, read_json
from ..footage import load_frames
from ..footage.images import read_frame, told_by
from ..shot import Shot, atomic_path, content_key, make_folder, write_json
from . import flow
from .flow import FlowConfig, Map
from .stored import load_cameras, load_points

STILL, UNKNOWN, MOVING = 0, 128, 255
MOTION_VERSION = 1
_FLOW_WIDTH = 640
_KEYS_PER_SECOND = 10.0


class _Clip:
    """Frames and cameras of a shot as the flow sees them."""

    def __init__(self, shot: Shot) -> None:
        path, rows = load_cameras(shot), {int(r["frame"]): r for r in load_frames(shot)["frames"]}
        self.shot = shot
        self.frames = [c.frame for c in path.frames]
        self.width, self.height = path.width, path.height
        scale = min(2.0, _FLOW_WIDTH / path.width)
        self.flow_size = tuple(max(32, round(side * scale / 2) * 2) for side in (path.width, path.height))
        self.unit = self.flow_size[0] / 640.0
        self.viewmats = np.array([c.viewmat for c in path.frames], np.float64).reshape(-1, 4, 4)
        ratio = np.array([self.flow_size[0] / path.width, self.flow_size[1] / path.height, 1.0])
        self.Ks = np.array([[[c.K[0], 0, c.K[2]], [0, c.K[1], c.K[3]], [0, 0, 1]] for c in path.frames])
        self.Ks *= ratio[None, :, None]
        self.keys = _keys([float(rows[f]["seconds"]) for f in self.frames])
        points = load_points(shot)["xyz"].astype(np.float64)
        self.depths = [_typical_depth(points, self.viewmats[i]) for i in range(len(self.frames))]
        self._grey: dict[int, NDArray[np.uint8]] = {}
        self._looks: dict[int, flow.Look] = {}

    def plate(self, index: int) -> NDArray[np.uint8]:
        """The working frame [H, W, 3] in 8 bits."""
        pixels = read_frame(self.shot.frames / frame_file(self.frames[index], ".png"))
        return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)

    def grey(self, index: int) -> NDArray[np.uint8]:
        """It in the flow's size, grey."""
        if index not in self._grey:
            grey = cv2.cvtColor(self.plate(index), cv2.COLOR_RGB2GRAY)
            how = cv2.INTER_AREA if self.flow_size[0] < self.width else cv2.INTER_CUBIC
            self._grey[index] = cv2.resize(grey, self.flow_size, interpolation=how)
        return self._grey[index]

    def look(self, index: int) -> flow.Look:
        if index not in self._looks:
            self._looks[index] = flow.Look(self.grey(index))
        return self._looks[index]

    def forget(self, before: int) -> None:
        for store in (self._grey, self._looks):
            for index in [i for i in store if i < before]:
                del store[index]


def _keys(seconds: list[float]) -> list[int]:
    """Indices of the frames that are looked at first: about ten a second, the first and the last among them."""
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    stride = max(1, round(1.0 / (_KEYS_PER_SECOND * step))) if step > 0 else 1
    return sorted({*range(0, len(seconds), stride), len(seconds) - 1})


def _typical_depth(points: NDArray, viewmat: NDArray) -> float:
    """Median depth of the sparse points before a camera; 1 if there are none."""
    z = points @ viewmat[2, :3] + viewmat[2, 3]
    z = z[z > 0]
    return float(np.median(z)) if len(z) else 1.0


def find_motion(shot: Shot, report: Reporter, config: FlowConfig | None = None) -> dict[str, Any]:
    """Writes the motion matte of every delivered frame; what is there for these frames and cameras is left alone.

    Returns motion_pixels_share and unknown_share, means over the frames. JobError if the shot is not solved.
    """
    config = config or FlowConfig()
    key = found_key(shot, config)
    folder = shot.own(shot.solve / "motion")
    there = _record(shot)
    if there.get("key") == key and isinstance(there.get("result"), dict):
        return there["result"]
    clip = _Clip(shot)
    make_folder(folder)
    shares = []
    for index, matte in _mattes(clip, config, report):
        write_grey(folder / frame_file(clip.frames[index], ".png"), matte)
        shares.append(((matte == MOVING).mean(), (matte == UNKNOWN).mean()))
    result = {
        "motion_pixels_share": round(float(np.mean([s[0] for s in shares])), 4),
        "unknown_share": round(float(np.mean([s[1] for s in shares])), 4),
    }
    write_json(folder / "motion.json", {"version": MOTION_VERSION, "key": key, "result": result})
    return result


def _mattes(clip: _Clip, config: FlowConfig, report: Reporter):
    """(index, matte [H, W]) of every frame, key frames first."""
    keys = clip.keys
    matches = flow.Matches(lambda k: clip.grey(keys[k]), config, clip.unit)
    scores: dict[int, tuple[Map, Map]] = {}
    final: dict[int, tuple[Map, Map]] = {}
    reach, long = 2 * config.baselines[-1], config.links * config.baselines[-1]
    for turn in range(len(keys) + reach):
        if turn < len(keys):
            report.check_cancelled()
            report.progress("solve: motion", turn + 1, len(keys), f"frame {clip.frames[keys[turn]]}")
            scores[turn] = _own_score(clip, matches, turn, config)
        key = turn - reach
        if key >= 0:
            near = [s for s in flow.neighbours(matches, key, len(keys), config) if abs(s.key - key) <= reach]
            final[key] = flow.fused(scores[key], [(s, *scores[s.key]) for s in near])
            yield keys[key], _label(clip, keys[key], *final[key])
            if key:
                for index in range(keys[key - 1] + 1, keys[key]):
                    yield index, _label(clip, index, *_between(clip, matches, index, key, final))
            for store in (scores, final):
                for old in [k for k in store if k < key - reach]:
                    del store[old]
            matches.forget(key - config.baselines[-1] + 1, key - long)
            clip.forget(keys[max(0, key - config.baselines[-1])])


def _own_score(clip: _Clip, matches: flow.Matches, key: int, config: FlowConfig) -> tuple[Map, Map]:
    """Share of a key frame's matches that tell of motion, and how sure that is."""
    keys = clip.keys
    seen = flow.neighbours(matches, key, len(keys), config)
    scene = flow.Scene(lambda k: clip.look(keys[k]), clip.viewmats[keys], clip.Ks[keys], matches.grid, clip.unit)
    found = flow.evidence(scene, key, seen, clip.depths[keys[key]], config)
    count = found.on + found.off
    return np.clip(found.off / np.maximum(count, 1) * 2.5, 0, 1), np.clip(count / 6, 0, 1) * (count >= 2)


def _between(clip: _Clip, matches: flow.Matches, index: int, key: int, final: dict[int, tuple[Map, Map]]):
    """Score and weight of a frame between two key frames, by flow to both."""
    total, weight = np.float32(0), np.float32(1e-6)
    for other in (key - 1, key):
        at, found = matches.loose(clip.grey(index), clip.grey(clip.keys[other]))
        w = flow.sample(final[other][1], at) * found
        total, weight = total + w * flow.sample(final[other][0], at), weight + w
    return total / weight, weight


def _label(clip: _Clip, index: int, score: Map, weight: Map) -> NDArray[np.uint8]:
    """The matte [H, W] of score and weight on the grid."""
    grey = cv2.resize(clip.grey(index), score.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    guide = flow.Guide(grey, 6, 10.0)
    weight = np.minimum(weight, 3.0)
    known = np.maximum(guide(weight), 0)
    spread = guide(score * weight) / np.maximum(known, 1e-3)
    size = clip.width, clip.height
    spread = cv2.resize(spread, size, interpolation=cv2.INTER_LINEAR)
    known = cv2.resize(known, size, interpolation=cv2.INTER_LINEAR)
    return np.where(known < 0.1, UNKNOWN, np.where(spread > 0.4, MOVING, STILL)).astype(np.uint8)


def found_key(shot: Shot, config: FlowConfig | None = None) -> str:
    """Identifies the frames and cameras that a found matte is of."""
    record = read_json(shot.solve / "solve.json")
    cameras = read_json(shot.solve / "cameras.json")
    return content_key(MOTION_VERSION, config or FlowConfig(), record.get("key"), cameras)


def _record(shot: Shot) -> dict[str, Any]:
    try:
        return read_json(shot.solve / "motion" / "motion.json")
    except (OSError, ValueError):
        return {}


def motion_key(shot: Shot) -> str:
    """Changes when a matte does, found or painted."""
    painted = sorted((shot.root / "motion_paint").glob("*.png"))
    return content_key(_record(shot).get("key"), *painted)


def load_motion(shot: Shot, frame: int) -> NDArray[np.uint8] | None:
    """The matte of a frame, [h, w] of the working frames: the painted one before the found one; None without one."""
    path = shot.solve / "motion" / frame_file(frame, ".png")
    found = read_grey(path) if path.is_file() else None
    painted = shot.root / "motion_paint" / frame_file(frame, ".png")
    if painted.is_file():
        info = shot.info()
        found = _painted(painted, found, info.width, info.height)
    return found


def _painted(path: Path, found: NDArray[np.uint8] | None, width: int, height: int) -> NDArray[np.uint8]:
    """`found` with what was painted over it."""
    buffer = oiio.ImageBuf(str(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None or buffer.has_error:
        raise JobError(
            f"The painted matte {path} cannot be read: {told_by(buffer)}.",
            "Paint it again, or remove it.",
            ExitCode.FOOTAGE,
        )
    pixels = np.asarray(pixels, np.float32)
    channels = pixels.shape[2]
    grey = pixels[..., :3].mean(2) if channels >= 3 else pixels[..., 0]
    alpha = pixels[..., channels - 1] if channels in (2, 4) else np.ones_like(grey)
    grey, alpha = (cv2.resize(p, (width, height), interpolation=cv2.INTER_LINEAR) for p in (grey, alpha))
    label = np.where(grey * 255 < 85, STILL, np.where(grey * 255 > 170, MOVING, UNKNOWN)).astype(np.uint8)
    return np.where(alpha > 0.5, label, found if found is not None else np.uint8(UNKNOWN)).astype(np.uint8)


def write_grey(path: Path, pixels: NDArray[np.uint8]) -> None:
    """[H, W] uint8 as PNG, whole or not at all."""
    ok, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 4])
    if not ok:
        raise OSError(f"cannot write picture {path}")
    with atomic_path(path) as beside:
        beside.write_bytes(data.tobytes())


def read_grey(path: Path) -> NDArray[np.uint8]:
    """[H, W] uint8 of a PNG. ValueError if it cannot be read."""
    pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise ValueError(f"picture {path} cannot be read")
    return pixels
