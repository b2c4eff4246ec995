"""Frozen frames with plate detail against the plates of a real clip: `python -m benchmarks.detail SHOT --results DIR`.

SHOT is a trained shot folder, which stays unchanged. Frames held out of training are judged at the suggested t* and at
an instant half a clip away. Each of these pictures is compared with the frame's plate: the run's Gaussians alone
(splats), the developed instant's (developed), plate detail without the plate of the same pose (withheld), and the
delivered frame. Figures: PSNR of the whole frame, of the best 90 % of the pixels and of still pixels, and gradients
relative to the plate's. In whole frames people have moved since t*, which no freeze can match. The difference of the
two instants is measured where nothing moves. Writes detail-NAME.json and strips (plate, splats, developed, withheld,
delivered) at 100 % to DIR.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from torch import Tensor

from benchmarks.detail_clip import VARIANTS, DetailClip, open_clip, over
from benchmarks.detail_figures import mean_difference, picture_figures
from benchmarks.report.metrics import known_mean
from benchmarks.report.setting import plain
from benchmarks.sources import in_words
from torch_backend.contract import SWITCH
from torch_backend.footage.images import write_png
from torch_backend.shot import write_json

FIGURES = {"whole_db": "whole, dB", "best_90_db": "best 90 %, dB", "still_db": "still, dB", "gradient": "gradient"}
"""Figure of a picture -> its column in the table."""
CROP = (640, 480)
"""Largest size (width, height) in pixels of each picture in a strip."""
Row = dict[str, Any]


def judge_frame(clip: DetailClip, frame: int, t_star: int) -> tuple[Row, dict[str, Tensor], Tensor]:
    """(figures by variant, pictures by name, still pixels) of one frame of a freeze."""
    plate, withheld = clip.plate(frame), clip.view(frame, t_star, {frame})
    delivered = clip.view(frame, t_star, image=withheld.image)
    still = clip.still(frame, t_star, delivered)
    pictures = {"withheld": withheld.picture, "delivered": delivered.picture}
    if clip.develop:
        image = clip.splats(frame, t_star, clip.field(t_star))
        pictures = {"splats": over(image.color, image.alpha), "developed": withheld.splats, **pictures}
    else:
        pictures = {"splats": withheld.splats, **pictures}
    row: Row = {name: picture_figures(picture, plate, still) for name, picture in pictures.items()}
    row |= {"frame": frame, "still_share": float(still.float().mean())}
    row["plate_share"] = {
        "withheld": float(withheld.detailed.plate.mean()), "delivered": float(delivered.detailed.plate.mean())
    }  # fmt: skip
    return row, {"plate": plate, **pictures}, still


def judge(
    clip: DetailClip, t_stars: Sequence[int], frames: Sequence[int], strips: Path | None = None, worst: int = 0
) -> dict[str, Any]:
    """All figures of a clip. `strips`: a folder for every frame's pictures side by side, or None.

    `worst` > 0 keeps only the strips of the `worst` frames at each t* with the lowest best-90 % dB of `withheld`.
    """
    result: dict[str, Any] = {"t_stars": list(t_stars), "size": [clip.width, clip.height], "freezes": []}
    result["motion_from"] = clip.motion_from
    rows: dict[int, list[Row]] = {t_star: [] for t_star in t_stars}
    differences: list[float] = []
    written: set[Path] = set()
    for n, frame in enumerate(frames):
        before: tuple[Tensor, Tensor] | None = None
        for t_star in t_stars:
            row, pictures, still = judge_frame(clip, frame, t_star)
            rows[t_star].append(row)
            if strips:
                path = strips / f"t{t_star:06d}_{frame:06d}.png"
                save_strip(path, list(pictures.values()))
                written.add(path)
            if before is not None:
                value = mean_difference(before[0], pictures["delivered"], before[1] & still)
                differences += [] if value is None else [255.0 * value]
            before = pictures["delivered"], still
            print(f"[{n + 1}/{len(frames)}] frame {frame}, t* {t_star}: {_line_of(row)}", flush=True)
    for t_star, of_freeze in rows.items():
        result["freezes"].append({"t_star": t_star, "frames": of_freeze, "mean": means(of_freeze)})
        if strips and worst:
            ranked = sorted(of_freeze, key=lambda row: row["withheld"]["best_90_db"])
            written -= {strips / f"t{t_star:06d}_{row['frame']:06d}.png" for row in ranked[worst:]}
    # Only now, so that an interrupted run leaves the strips of the earlier one.
    for path in strips.glob("t[0-9]*_[0-9]*.png") if strips else ():
        if path not in written:
            path.unlink()
    result["instants_differ_255"] = known_mean(differences)
    return result


def means(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """{variant: {figure: mean over the frames that have it}}."""
    return {v: {name: known_mean(row[v][name] for row in rows) for name in FIGURES} for v in VARIANTS if v in rows[0]}


def _line_of(row: Row) -> str:
    return ", ".join(f"{v} {row[v]['best_90_db']:.1f}" for v in VARIANTS if v in row) + " dB best 90 %"


def table(name: str, result: dict[str, Any]) -> list[str]:
    """The means in Markdown, a row per t* and variant."""
    lines = [
        f"| {name} | " + " | ".join(FIGURES.values()) + " |",
        "|---|" + "---:|" * len(FIGURES),
    ]
    for freeze in result["freezes"]:
        for variant, of in freeze["mean"].items():
            cells = [plain(of[figure]) for figure in FIGURES]
            lines.append(f"| t* {freeze['t_star']}, {variant} | " + " | ".join(cells) + " |")
    both = [[row for freeze in result["freezes"] for row in freeze["frames"]]]
    for variant, of in means(both[0]).items() if len(result["freezes"]) > 1 else ():
        cells = [plain(v) for v in of.values()]
        lines.append(f"| both, {variant} | " + " | ".join(cells) + " |")
    share = known_mean(row["still_share"] for row in both[0])
    lines += ["", f"Still: {100 * (share or 0):.0f} % of the pixels, by {result['motion_from']}."]
    if result["instants_differ_255"] is not None:
        lines[-1] += (
            f" In these pixels, the two instants differ by {result['instants_differ_255']:.3f} / 255 on average."
        )
    return lines


# ------------------------------------------------------------------------------------------------- pictures


def save_strip(path: Path, pictures: Sequence[Tensor], crop: tuple[int, int, int, int] | None = None) -> None:
    """Writes pictures [H, W, 3] side by side at 100 %, cropped to `crop` (x, y, width, height) or to the centre."""
    height, width = pictures[0].shape[:2]
    w, h = min(width, CROP[0]), min(height, CROP[1])
    x, y, w, h = crop or ((width - w) // 2, (height - h) // 2, w, h)
    strip = torch.cat([picture[y : y + h, x : x + w] for picture in pictures], dim=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, (strip.clamp(0.0, 1.0) * 255.0).round().byte().contiguous().numpy())


# ------------------------------------------------------------------------------------------------- command line


def chosen_frames(clip: DetailClip, args: argparse.Namespace) -> list[int]:
    """The requested frames, or every `--every`-th frame held out of training. ValueError if unknown or none."""
    frames = args.frames or clip.held_out()[:: args.every]
    unknown = set(frames) - set(clip.frames)
    if unknown or not frames:
        what = f"frame {min(unknown)} is not in the clip" if unknown else "no frame was held out of training"
        raise ValueError(f"{what}: choose frames with --frames ({clip.frames[0]} to {clip.frames[-1]})")
    return frames


def common_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments shared by all benchmarks of a real clip."""
    parser.add_argument("shot", type=Path)
    parser.add_argument("--run", default="main", metavar="NAME")
    parser.add_argument(
        "--t-star",
        type=int,
        nargs="+",
        metavar="N",
        help="instants (default: the suggested one, and one half a clip away)",
    )
    parser.add_argument(
        "--frames", type=int, nargs="+", metavar="N", help="judge these frames (default: all that training left out)"
    )
    parser.add_argument(
        "--every", type=int, default=1, metavar="K", help="judge every K-th of the frames that training left out"
    )
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--worst", type=int, default=10, metavar="N", help="keep strips of the N worst frames per instant (0: of all)"
    )
    develop_argument(parser)
    parser.add_argument("--no-strips", action="store_true", help="write no strips")


def develop_argument(parser: argparse.ArgumentParser) -> None:
    """Adds `--develop`: whether instants are developed."""
    text = "off: use the Gaussians as the run trained them, without fine-tuning per instant"
    parser.add_argument("--develop", default="on", choices=SWITCH, help=text)


def name_of(shot: Path) -> str:
    """Name of a shot's result files: its folder's name, or the parent's if the folder is called `shot`."""
    return shot.absolute().parent.name if shot.stem == "shot" else shot.stem


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    common_arguments(parser)
    parser.add_argument("--width", type=int, default=0, help="width in pixels (0: that of the plates)")
    args = parser.parse_args(argv)
    clip = open_clip(args.shot, args.run, args.width, args.develop == "on")
    frames = chosen_frames(clip, args)
    name, since = name_of(args.shot), time.perf_counter()
    strips = None if args.no_strips else args.results / f"strips-{name}"
    result = judge(clip, args.t_star or clip.instants(), frames, strips, args.worst)
    result |= {"version": 1, "shot": str(args.shot), "run": args.run, "develop": args.develop}
    result["seconds"] = time.perf_counter() - since
    write_json(args.results / f"detail-{name}.json", result)
    print("\n".join(["", *table(name, result)]))


if __name__ == "__main__":
    sys.exit(main())
