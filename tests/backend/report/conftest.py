"""The first frame of the bundled clip and damaged versions of it; the tiny world as a ground-truth folder."""

from pathlib import Path

import av
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from tests.backend.conftest import FIRST, FRAMES, HEIGHT, WIDTH, build_world
from torch_backend.footage.images import write_png
from torch_backend.raster import rasterize
from torch_backend.shot import write_json

CLIP = Path(__file__).parents[3] / "examples" / "sitting.mp4"


@pytest.fixture(scope="session")
def frame() -> torch.Tensor:
    """[480, 640, 3] in 0..1."""
    with av.open(str(CLIP)) as clip:
        pixels = next(clip.decode(video=0)).to_ndarray(format="rgb24")
    return torch.from_numpy(pixels).float() / 255


@pytest.fixture(scope="session")
def damaged(frame):
    """Damages that a metric must detect: blur with sigma 1 and 3, and a ghost shifted by 6 px."""

    def blur(sigma: float) -> torch.Tensor:
        return torch.from_numpy(gaussian_filter(frame.numpy().astype(np.float64), (sigma, sigma, 0))).float()

    return {"blur1": blur(1), "blur3": blur(3), "ghost": 0.5 * (frame + frame.roll(6, 1))}


@pytest.fixture(scope="session")
def write_truth():
    """write_truth(folder): writes a ground-truth folder of the tiny world, with two instants and four poses."""

    def write(folder: Path):
        world = build_world(folder)
        instants, poses = [2, 12], [2, 5, 9, 13]
        for t in instants:
            for p in poses:
                name = f"{FIRST + t:06d}_{FIRST + p:06d}"
                save(folder / "truth" / f"{name}.png", world.image(p, t / (FRAMES - 1)))
                for region, mask in regions_of(world, t, p).items():
                    save(folder / "regions" / f"{name}_{region}.png", mask[..., None].expand(-1, -1, 3).float())
        facts = {"version": 1, "name": "tiny", "cameras": "exact", "shot": "tiny.splannequin", "fps": 2.5}
        facts |= {"t_stars": [FIRST + t for t in instants], "poses": [FIRST + p for p in poses]}
        write_json(folder / "truth.json", {**facts, "regions": ["seen", "never_seen", "moving", "static"]})
        return world

    return write


def save(path: Path, image: torch.Tensor) -> None:
    write_png(path, (image * 255 + 0.5).to(torch.uint8).contiguous().numpy())


def regions_of(world, t: int, p: int) -> dict[str, torch.Tensor]:
    """Ground-truth regions. The wall's depth of 4 gives the pixels of plate t* that show a pose's pixels."""
    without = {k: v[~world.moving] for k, v in world.at(t / (FRAMES - 1)).items()}
    pose = {"viewmats": world.viewmats[p : p + 1], "Ks": world.K[None], "background": torch.full((3,), 0.5)}
    wall = rasterize(**without, **pose, width=WIDTH, height=HEIGHT).colors[0].clamp(0, 1)
    moving = (wall - world.image(p, t / (FRAMES - 1))).abs().amax(2) > 0.05
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    shift = 60 / 4 * (world.viewmats[t, :2, 3] - world.viewmats[p, :2, 3])
    x, y = x + shift[0], y + shift[1]
    seen = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    return {"seen": seen, "never_seen": ~seen, "moving": moving, "static": ~moving}
