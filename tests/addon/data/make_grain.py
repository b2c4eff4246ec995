"""Generates two frozen frames with grain for the add-on's tests: flat grey, 96 x 64 pixels, alpha 0.5 in one half.

python tests/addon/data/make_grain.py      (with the backend's Python: it renders and writes the frames)
"""

from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 96, 64
FRAMES = (5, 6)
VALUE = 0.5
"""Grey of the picture, display-referred."""
DEVIATION = (2.0 / 255.0, 4.0 / 255.0, 6.0 / 255.0)
"""Standard deviation of the plate's grain per channel, display-referred."""
FOLDER = Path(__file__).with_name("grain")


def main() -> None:
    """Write grain/NNNNNN.exr into the folder of this file."""
    from torch_backend.footage.display import PLAIN
    from torch_backend.freeze.composite.grain import BINS, Grain, draw
    from torch_backend.freeze.exr import FrameMetadata, write_frozen_exr

    FOLDER.mkdir(exist_ok=True)
    grain = Grain(np.repeat(np.array(DEVIATION, np.float32)[:, None], BINS, axis=1), 0.6, np.eye(3, dtype=np.float32))
    rgba = np.full((HEIGHT, WIDTH, 4), VALUE, np.float32)
    rgba[..., 3] = 1.0
    rgba[:, WIDTH // 2 :] *= 0.5
    ones = np.ones((HEIGHT, WIDTH), np.float32)
    for frame in FRAMES:
        about = FrameMetadata(frame, 6.0, np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32))
        noise = draw(grain, frame, rgba, (WIDTH, HEIGHT))
        path = FOLDER / f"{frame:06d}.exr"
        write_frozen_exr(path, PLAIN.premultiplied_to_light(rgba), ones, ones, ones, about, grain=noise)


if __name__ == "__main__":
    main()
