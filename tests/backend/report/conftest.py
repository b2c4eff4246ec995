"""The first frame of the bundled clip, and what is done to it."""

from pathlib import Path

import av
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

CLIP = Path(__file__).parents[3] / "examples" / "sitting.mp4"


@pytest.fixture(scope="session")
def frame() -> torch.Tensor:
    """[480, 640, 3] in 0..1."""
    with av.open(str(CLIP)) as clip:
        pixels = next(clip.decode(video=0)).to_ndarray(format="rgb24")
    return torch.from_numpy(pixels).float() / 255


@pytest.fixture(scope="session")
def damaged(frame):
    """The damages of design/metrics.md: blur with sigma 1 and 3, and a ghost 6 px aside."""

    def blur(sigma: float) -> torch.Tensor:
        return torch.from_numpy(gaussian_filter(frame.numpy().astype(np.float64), (sigma, sigma, 0))).float()

    return {"blur1": blur(1), "blur3": blur(3), "ghost": 0.5 * (frame + frame.roll(6, 1))}
