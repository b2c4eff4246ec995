"""Writes docs/numerics.md: errors of every rasteriser backend against the float64 reference, case by case.

    python -m benchmarks.numerics [--out docs/numerics.md] [--cases CASE ...] [--bodies BODY ...]

`raster_errors.py` defines the errors, `raster_cases.py` the cases.
"""

from __future__ import annotations

import argparse
import datetime
import math
import os
import pathlib
import platform
import subprocess
import sys
from importlib import metadata

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import torch

from benchmarks.raster_cases import CASES, size
from benchmarks.raster_errors import BODIES, INPUTS, Errors, compare, workload

ROOT = pathlib.Path(__file__).resolve().parents[1]


BARS = {"W0": (0.0, 1e-4), "W1": (100.0, 4e-4)}
"""Workload -> (least PSNR in dB over all pixels, largest relative L2 gradient error of any input)."""
_NOTES = """\
- **Flips.** Alpha below 1/255 is dropped, so a pixel within rounding of the cut changes by up to 4e-3 with the last bit
  of an input. No implementation is wrong there. Such pixels are excluded from errors and gradients, and their share is
  bounded. Pixels are on the same side if their alphas differ by less than 3e-4. A pixel that ends opaque hides a flip
  from its alpha, and that flip stays in the errors.
- **Background.** Float32 keeps 1 - alpha to 6e-8 at best. Behind opaque splats the background's gradient is of that
  size. Its error is therefore relative to at least 1 % of the gradient in an empty scene.
- **Saturated opacity.** torch's float32 sigmoid of 17 is 1, with gradient 0; the others use exp(-|x|), which keeps
  the gradient.
- **Far from the origin.** World to camera is computed in float32: 1400 units from the origin, cancellation leaves an
  error of 1e-4 units.
- **Enormous Gaussians.** A Gaussian above 1e12 px^2 of projected variance is culled, since float32 could not invert its
  covariance. Near that limit, implementations may round to different sides.
- **Enormous colours.** Gradients of positions are proportional to colours, and overflow when colours exceed about 1e30.
- **Outside the frustum.** In every implementation, the Jacobian's clamp bounds the size of splats off screen, but
  rotates them.
"""


def _cell(value: float) -> str:
    return "0" if value == 0 else f"{value:.0e}".replace("e-0", "e-")


def _errors(e: Errors) -> str:
    """PSNR and largest gradient error as a cell of the table of cases."""
    decibels = "exact" if math.isinf(e.psnr) else f"{e.psnr:.0f}"
    finite = all(bool(torch.isfinite(g).all()) for g in e.grads.values())
    return f"{decibels}, {_cell(e.gradient) if finite else 'NOT FINITE'}"


_CLOSE = (120.0, 1e-5)
"""A case is left out of the table if all bodies have at least this PSNR in dB and at most this gradient error."""


def _cases(bodies: list[str], names: list[str]) -> list[str]:
    """Table of the cases in which some body exceeds `_CLOSE`: errors of each body, and the bounds that tests assert."""
    lines = ["| case | " + " | ".join(bodies) + " | asserted |", "|---" * (len(bodies) + 2) + "|"]
    for name in names:
        case = CASES[name]
        errors = [compare(size(name, body), body) for body in bodies]
        if all(e.psnr >= _CLOSE[0] and e.gradient <= _CLOSE[1] for e in errors):  # NaN compares as False
            continue
        gradient = "finite" if case.gradient is None else _cell(case.gradient)
        plain = f" (reference32: {_cell(case.plain)})" if case.plain else ""
        bounds = f"{case.psnr:.0f}, {gradient}{plain}; flips {100 * case.flips:.0f} %"
        title = f"{name}: {case.note}" if case.note else name
        lines.append(f"| {title} | {' | '.join(map(_errors, errors))} | {bounds} |")
    close = len(names) - len(lines) + 2
    reached = f"{_CLOSE[0]:.0f} dB, with gradients within {_cell(_CLOSE[1])}"
    others = f"In the other {close} cases every implementation reaches {reached}."
    return [*lines, "", others]


def _generated(cases: int) -> str:
    """Runs the property tests; returns their number of generated cases and pytest's verdict."""
    command = [sys.executable, "-P", "-m", "pytest", "-q", "tests/backend/raster/test_properties.py"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **({"SPLANNEQUIN_CASES": str(cases)} if cases else {})}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    counts = [line for line in run.stdout.splitlines() if line.startswith("rasteriser:")]
    if not counts:
        raise SystemExit(f"the property tests did not run:\n{run.stdout[-2000:]}{run.stderr[-1000:]}")
    total, _, parts = counts[0].removeprefix("rasteriser: ").partition(" generated cases ")
    verdict = run.stdout.splitlines()[-1].strip("= ").partition(" in ")[0]
    properties = parts.count(",") + 1
    return f"{int(total):,} cases of {properties} properties, one test per property and implementation: {verdict}."


def _machine() -> str:
    model = platform.processor() or platform.machine()
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ", no GPU"
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("torch", "warp-lang", "numpy"))
    return f"{model}, {os.cpu_count()} cores{gpu}; {platform.system()}, Python {platform.python_version()}, {versions}"


def _workloads(bodies: list[str]) -> list[str]:
    """Table of the rooms of benchmarks/workload.py: errors over all pixels and per input, with `BARS`."""
    lines = [
        "| workload, implementation | flips | dB, all pixels | dB | "
        + " | ".join(i for i in INPUTS if i != "sh")
        + " | bars |",
        "|---" * (len(INPUTS) + 4) + "|",
    ]
    for name, (least, most) in BARS.items():
        scene = workload(name)
        for body in bodies:
            if body == "cuda" and name != "W0":
                continue  # minutes on fibers
            e = compare(scene, body)
            held = e.psnr_all >= least and e.gradient <= most
            bounds = (f">= {least:.0f} dB, " if least else "") + f"<= {_cell(most)}"
            cells = " | ".join(f"{e.gradients[i]:.1e}" for i in INPUTS if i in e.gradients)
            lines.append(
                f"| {name}, {body} | {100 * e.flips:.2g} % | {e.psnr_all:.1f} | {e.psnr:.1f} | {cells} | "
                f"{bounds}: {'held' if held else 'MISSED'} |"
            )
    return lines


def report(bodies: list[str], names: list[str], cases: int) -> str:
    """The whole text of docs/numerics.md."""
    text = [
        "# Numerics of the rasteriser",
        "",
        "Generated by `python -m benchmarks.numerics`; do not edit. Errors of each implementation against the float64 "
        "reference (torch, autograd) on inputs rounded to float32.",
        "",
        f"{datetime.date.today().isoformat()}; {_machine()}.",
        "",
        "`dB` is the PSNR at pixels without flips, for a peak of 1 (or the brightest channel); `flips` is the share of "
        "the other pixels. Errors of gradients are relative L2.",
        "",
        "Implementations: `cpu` is compiled float32, `reference32` the torch reference in float32, `cuda` the CUDA "
        "kernels on CPU fibers (smaller scenes).",
        "",
        "## Two rooms",
        "",
        "W0: 400 Gaussians, 64 x 48. W1: 20,000 Gaussians, 320 x 180. Gradients are taken of a random weighting of "
        "colours and alphas, at pixels without flips.",
        "",
        *_workloads(bodies),
        "",
        "## Notes on conditioning",
        "",
        _NOTES.rstrip(),
        "",
        "## Generated cases",
        "",
        "`tests/backend/raster/test_properties.py`: " + _generated(cases) + " `SPLANNEQUIN_CASES=20000` in the "
        "environment runs that many cases of each property.",
        "",
        "## Hard cases",
        "",
        "PSNR in dB, and the largest error of any gradient.",
        "",
        *_cases(bodies, names),
    ]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    others = [body for body in BODIES if body != "reference"]
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs" / "numerics.md", metavar="FILE")
    parser.add_argument("--bodies", nargs="+", choices=others, default=others)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES), metavar="CASE")
    parser.add_argument("--generate", type=int, default=0, metavar="N", help="cases per property, not the tests' usual")
    arguments = parser.parse_args()
    text = report(arguments.bodies, arguments.cases, arguments.generate)
    partial = arguments.out.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(arguments.out)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
