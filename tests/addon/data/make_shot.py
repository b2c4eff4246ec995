"""Write a shot in the backend's file formats for the add-on's tests, without Blender or the backend."""

import importlib.util
import json
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np

DATA = Path(__file__).resolve().parent
_spec = importlib.util.spec_from_file_location("_addon_tests_make_frames", DATA / "make_frames.py")
assert _spec and _spec.loader
make_frames = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(make_frames)


def png(pixels: np.ndarray) -> bytes:
    """Encode [H, W] or [H, W, C] uint8 as a PNG, without Blender or the backend."""
    height, width, channels = (*pixels.shape, 1)[:3]
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes())) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def write_png(path: Path, pixels: np.ndarray) -> None:
    path.write_bytes(png(pixels))


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rotation matrix [3, 3] by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def make_shot(parent: Path) -> Path:
    """Write a solved shot with frames 5 to 7 of 16 x 12 and one take, in the backend's file formats."""
    folder = parent / "my shot é.splannequin"
    (folder / "frames").mkdir(parents=True)
    (folder / "solve").mkdir()
    width, height, frames = make_frames.WIDTH, make_frames.HEIGHT, make_frames.FRAMES
    info = {"version": 1, "name": "my shot é", "first": 5, "last": 7, "fps": 12.5, "width": width, "height": height}
    (folder / "shot.json").write_text(json.dumps(info), encoding="utf-8")
    listed = [{"frame": n, "seconds": n / 12.5, "file": f"raw/{n:06d}.png", "solve": True} for n in frames]
    listing = {"version": 1, "width": width, "height": height, "fps": 12.5, "colour": "srgb", "frames": listed}
    (folder / "frames" / "frames.json").write_text(json.dumps(listing))
    poses = []
    for n in frames:
        plate = np.full((height, width, 3), 10 * n, np.uint8)
        plate[:, :, 0] = np.arange(width) * 16
        write_png(folder / "frames" / f"{n:06d}.png", plate)
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation((0.2, 1.0, -0.3), 0.1 * n)
        viewmat[:3, 3] = (0.1 * n, -0.2, 3.0)
        poses.append({"frame": n, "viewmat": viewmat.ravel().tolist(), "K": [20.0, 20.0, 9.0, 5.0]})
    path = {"version": 1, "width": width, "height": height, "frames": poses}
    (folder / "solve" / "cameras.json").write_text(json.dumps(path))
    solve = {"version": 1, "registered": 3, "solved_frames": 3, "total_frames": 3, "quality": "A good solve."}
    (folder / "solve" / "solve.json").write_text(json.dumps(solve))
    xyz = np.random.default_rng(0).uniform(-1, 1, (20, 3)).astype(np.float32)
    rgb = np.arange(60, dtype=np.uint8).reshape(20, 3) * 4
    error, track = np.full(20, 0.5, np.float32), np.full(20, 3, np.uint16)
    np.savez(folder / "solve" / "points.npz", xyz=xyz, rgb=rgb, error=error, track=track)
    (folder / "runs" / "main").mkdir(parents=True)
    run = {"run": "main", "gaussians": 12345, "moving_share": 0.05, "heldout_psnr_db": 24.0, "width_px": width}
    (folder / "runs" / "main" / "summary.json").write_text(json.dumps(run))
    add_take(folder, "freeze")
    return folder


def add_take(folder: Path, name: str) -> Path:
    """Add a take of the test frames; return its folder."""
    take = folder / "takes" / name
    take.mkdir(parents=True)
    for n in make_frames.FRAMES:
        shutil.copy(DATA / f"{n:06d}.exr", take)
    facts = {"version": 1, "take": name, "run": "main", "t_star_frame": 6, "query": "nearest", "frames": 3}
    facts |= {"width": make_frames.WIDTH, "height": make_frames.HEIGHT, "first": 5, "last": 7}
    (take / "take.json").write_text(json.dumps(facts))
    return take
