"""Generates levels.mp4 for the add-on's tests: 12 frames of 64 x 48, each of one colour, tagged as BT.709 video.

PYTHON tests/addon/data/make_levels.py        (the backend's Python)
"""

from fractions import Fraction
from pathlib import Path

import numpy as np

WIDTH, HEIGHT, FRAMES = 64, 48, 12


def level(frame: int) -> int:
    """Luma of a frame, 16 to 235. Frames are grey, so the colour matrix has no effect."""
    return 20 + 16 * frame


def main() -> None:
    """Write the file into the folder of this file."""
    import av

    with av.open(str(Path(__file__).with_name("levels.mp4")), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(25, 1), options={"qp": "0", "g": "5", "bf": "2"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        context = stream.codec_context
        context.color_primaries = context.color_trc = context.colorspace = context.color_range = 1
        for number in range(1, FRAMES + 1):
            planes = np.full((HEIGHT * 3 // 2, WIDTH), 128, np.uint8)
            planes[:HEIGHT] = level(number)
            frame = av.VideoFrame.from_ndarray(planes, "yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


if __name__ == "__main__":
    main()
