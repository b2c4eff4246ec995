"""Generates the add-on tests' frames composited from plates: two frozen frames of 56 x 42 pixels in detail/.

    python tests/addon/data/make_detail.py      (with the backend's Python: it uses the backend's own EXR writers)

Their warps go to detail/warp/. The linear plates that they are composited from, with values from -0.2 to 50, go to
detail/plate/. Frame numbers are 5 and 6.

The left third shows the unchanged plate. In the middle third the plate is moved by fractions of a pixel. In the right
third it is blended with another picture. At the sizes 56 and 42, pixel centres are inexact in float32.

detail_ap1/ holds frame 6 and its warp again, as written for ACEScg footage.
"""

import json
import shutil
from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 56, 42
FRAMES = (5, 6)
FOLDER = Path(__file__).with_name("detail")
PROBE = (0.78125, 0.390625, 0.1953125)
"""What a take's facts state of linear footage: the light that its probe colour stands for."""


def plate(frame: int) -> np.ndarray:
    """[H, W, 3] float32, scene-linear, top row first."""
    rng = np.random.default_rng(frame)
    pixels = rng.uniform(-0.2, 1.2, (HEIGHT, WIDTH, 3))
    hot = rng.uniform(size=(HEIGHT, WIDTH)) < 0.1
    pixels[hot] = rng.uniform(25.0, 50.0, (int(hot.sum()), 3))
    return pixels.astype(np.float32)


def places(frame: int) -> np.ndarray:
    """[H, W, 2] float64: plate position that each pixel shows, in pixels from the top left, in steps of 1/256."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    moves = x >= WIDTH // 3
    x += moves * 1.4 * np.sin(y / 5.0 + frame)
    y += moves * 0.9 * np.cos(x / 7.0)
    return np.clip(np.round(256.0 * np.stack([x, y], axis=2)) / 256.0, 0.0, [WIDTH - 1.0, HEIGHT - 1.0])


def matte(frame: int) -> np.ndarray:
    """[H, W] in 0..1."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.where(x < 2 * WIDTH // 3, 1.0, ((x + y + frame) % 5) / 4.0).astype(np.float32)


def moved(pixels: np.ndarray, frame: int) -> np.ndarray:
    """[H, W, C] float64: a picture sampled bilinearly at `places`."""
    at = places(frame)
    first = np.minimum(at.astype(int), [WIDTH - 2, HEIGHT - 2])
    (x, y), (fx, fy) = np.moveaxis(first, 2, 0), np.moveaxis((at - first)[..., None, :], 3, 0)
    pixels = pixels.astype(np.float64)
    upper = (1 - fx) * pixels[y, x] + fx * pixels[y, x + 1]
    return (1 - fy) * upper + fy * ((1 - fx) * pixels[y + 1, x] + fx * pixels[y + 1, x + 1])


def splat_picture(frame: int) -> np.ndarray:
    """[H, W, 3] float32: picture of the splats, in multiples of 1/64."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    return (np.stack([x * 2 + frame, y * 2 + frame, x + y], axis=2) % 65 / 64.0).astype(np.float32)


def alpha() -> np.ndarray:
    """[H, W]: 0 in the bottom right corner, 0.5 around it, else 1."""
    whole = np.ones((HEIGHT, WIDTH), np.float32)
    whole[-4:, -4:], whole[-2:, -2:] = 0.5, 0.0
    return whole


def frozen(frame: int) -> np.ndarray:
    """[H, W, 3] float64: the frozen frame, scene-linear, premultiplied."""
    share = (matte(frame) * alpha())[..., None]
    return share * moved(plate(frame), frame) + (alpha()[..., None] - share) * splat_picture(frame)


def source(frame: int) -> np.ndarray:
    """[H, W] float32: frame numbers that a half float cannot represent."""
    return np.where(matte(frame) > 0, 100_001.0 + frame, 0.0).astype(np.float32)


def add_take(shot: Path, **footage: object) -> Path:
    """Add the take `detail` of these frames to a shot, with facts of the footage in take.json; return its folder."""
    take = shot / "takes" / "detail"
    shutil.copytree(FOLDER, take, ignore=shutil.ignore_patterns("plate"))
    write_facts(take, **footage)
    return take


def write_facts(take: Path, **footage: object) -> None:
    """Write take.json of the take `detail`, by default of the linear plates in detail/plate/."""
    facts = {"version": 1, "take": "detail", "run": "main", "t_star_frame": 6, "query": "nearest", "frames": 2}
    facts |= {"width": WIDTH, "height": HEIGHT, "first": 5, "last": 6, "camera_path": ""}
    if footage:
        of = {"file": str(FOLDER / "plate" / "000005.exr"), "beside": "", "size": [WIDTH, HEIGHT], "first": 5}
        of |= {"last": 6, "probe": list(PROBE), "space": "linear, Rec.709", "map": "", "unlike": ""}
        facts["footage"] = of | footage
    (take / "take.json").write_text(json.dumps(facts))


def main() -> None:
    """Write the files into detail/."""
    import OpenImageIO as oiio
    import torch

    from torch_backend.freeze.composite.warp import WarpMetadata, snap, write_warp
    from torch_backend.freeze.exr import DetailLayers, FrameMetadata, linear_spec, write_exr, write_frozen_exr

    ones, size = np.ones((HEIGHT, WIDTH), np.float32), np.array([WIDTH, HEIGHT])
    for frame, folder, light in (*((n, FOLDER, "rec709") for n in FRAMES), (6, FOLDER.with_name("detail_ap1"), "ap1")):
        (folder / "warp").mkdir(parents=True, exist_ok=True)
        color, share = frozen(frame).astype(np.float32), matte(frame) * alpha()
        st = (places(frame) + 0.5) / size
        st[..., 1] = 1.0 - st[..., 1]
        splat = np.concatenate([splat_picture(frame) * alpha()[..., None], alpha()[..., None]], axis=2)
        name = f"{frame:06d}.exr"
        write_frozen_exr(
            folder / name, np.concatenate([color, alpha()[..., None]], axis=2), frame * ones, ones, 0.5 * ones,
            FrameMetadata(frame, 6.0, np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), light=light),
            detail=DetailLayers(splat, share, source(frame)),
        )  # fmt: skip
        fill = (alpha() - share)[..., None] * splat_picture(frame)
        about = WarpMetadata(frame, frame, 6.0, WIDTH, HEIGHT, light=light)
        write_warp(folder / "warp" / name, snap(torch.from_numpy(st), (WIDTH, HEIGHT)), share, fill, alpha(), about)
        if folder == FOLDER:
            spec = linear_spec(WIDTH, HEIGHT, ("R", "G", "B"), (oiio.FLOAT,) * 3)
            write_exr(FOLDER / "plate" / name, spec, [plate(frame)])


if __name__ == "__main__":
    main()
