"""Generates the frozen frames of the add-on's tests: three files of 16 x 12 pixels with reproducible values.

    python tests/addon/data/make_frames.py      (with the backend's Python: it uses the backend's own EXR writer)

overscan/ gets a picture whose frame is the 12 x 10 pixels in the middle. passes/ gets a picture with motion, normals
and positions. All values are exact in half floats. Frame numbers are 5, 6 and 7.
"""

from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 16, 12
FRAMES = (5, 6, 7)
NO_DEPTH = 1e10
MARGIN = (2, 1)
"""Overscan of overscan/000006.exr in pixels: (left and right, above and below)."""


def layers(frame: int) -> dict[str, np.ndarray]:
    """Layers of a frame, top row first: rgba [H, W, 4] scene-linear premultiplied; depth, support and motion [H, W]."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    alpha = np.where(x == 0, 0.5, 1.0)
    alpha[0, 0] = 0.0
    rgb = np.stack([(x * 4 + frame) % 65, (y * 5 + frame * 3) % 65, (x + y * 2 + frame * 7) % 65], axis=2) / 64.0
    depth = np.where(alpha > 0, frame + x / 16.0 + y, NO_DEPTH)
    return {
        "rgba": np.concatenate([rgb * alpha[..., None], alpha[..., None]], axis=2).astype(np.float32),
        "depth": depth.astype(np.float32),
        "support": ((x % 5) / 4.0).astype(np.float32),
        "motion": ((y % 5) / 4.0).astype(np.float32),
    }


def passes(frame: int) -> dict[str, np.ndarray]:
    """Passes by layer name, [H, W, C] float32, top row first. Half floats cannot represent the positions."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    vector = np.stack([x - 8.0, y - 4.0, frame - x / 2.0, y / 4.0 - 2.0], axis=2)
    normal = np.stack([(x % 5) / 4.0 - 0.5, (y % 5) / 4.0 - 0.5, (x + y) % 3 - 1.0], axis=2)
    position = np.stack([1000.0 + x / 16.0, y - 2000.0, (x * y) / 8.0 - 3.0], axis=2)
    layers = {"Vector": vector, "forward": -vector[..., 2:], "backward": vector[..., :2]}
    layers |= {"Normal": normal, "Position": position}
    return {name: layer.astype(np.float32) for name, layer in layers.items()}


def main() -> None:
    """Write the files into the folder of this file."""
    from torch_backend.freeze.exr import FrameMetadata, write_frozen_exr

    k = np.array([[20.0, 0.0, 8.0], [0.0, 20.0, 6.0], [0.0, 0.0, 1.0]], np.float32)
    for frame in FRAMES:
        data = layers(frame)
        about = FrameMetadata(frame, 6.0, np.eye(4, dtype=np.float32), k)
        path = Path(__file__).with_name(f"{frame:06d}.exr")
        write_frozen_exr(path, data["rgba"], data["depth"], data["support"], data["motion"], about)
        if frame == 6:
            over = path.parent / "overscan" / path.name
            over.parent.mkdir(exist_ok=True)
            write_frozen_exr(over, data["rgba"], data["depth"], data["support"], data["motion"], about, MARGIN)
            more = path.parent / "passes" / path.name
            more.parent.mkdir(exist_ok=True)
            found = [data[name] for name in ("rgba", "depth", "support", "motion")]
            write_frozen_exr(more, *found, about, more=passes(frame))


if __name__ == "__main__":
    main()
