"""Writes docs/numerics.md: errors of every rasteriser body against the float64 oracle, case by case.

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
- **Flips.** Gaussians with alpha below 1/255 at a pixel are dropped. Near this threshold, the last bit of an input can
  change a pixel by up to 4e-3 in any correct implementation. Such pixels are excluded from errors and gradients, and
  tests bound their share. Two implementations agree at a pixel if their alphas differ by less than 3e-4. A pixel that
  is opaque in the end does not reveal a flip in its alpha; its error is included.
- **Background.** Float32 resolves 1 - alpha to 6e-8 at best. Where everything is opaque, the gradient of the
  background is of that size. Its error is therefore relative to at least 1 % of the gradient in an empty scene.
- **Saturated opacity.** Torch's float32 sigmoid of 17 is 1 with gradient 0. The other implementations compute
  exp(-|x|) and keep the gradient.
- **Far from the origin.** World-to-camera transforms use float32. At 1400 units from the origin, cancellation limits
  them to 1e-4 units.
- **Huge Gaussians.** A Gaussian with a projected variance above 1e12 px^2 is culled, because float32 cannot invert
  its covariance. Implementations may round differently at this threshold.
- **Huge colours.** Gradients of positions are proportional to colours and overflow for colours above about 1e30.
- **Beyond the frustum.** The clamp in the projection's Jacobian bounds the size of off-screen splats, and changes
  their orientation there. All implementations do this alike.
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
    summary = (
        f"In the other {close} cases, every body reaches {_CLOSE[0]:.0f} dB, with gradient errors up to "
        f"{_cell(_CLOSE[1])}."
    )
    return [*lines, "", summary]


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
    return f"{int(total):,} cases of {parts.count(',') + 1} properties, one test per property and body: {verdict}."


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
        "| workload, body | flips | dB, all pixels | dB | "
        + " | ".join(i for i in INPUTS if i != "sh")
        + " | bounds |",
        "|---" * (len(INPUTS) + 4) + "|",
    ]
    for name, (least, most) in BARS.items():
        scene = workload(name)
        for body in bodies:
            if body == "cuda" and name != "W0":
                continue  # minutes on fibers
            e = compare(scene, body)
            passed = e.psnr_all >= least and e.gradient <= most
            bounds = (f">= {least:.0f} dB, " if least else "") + f"<= {_cell(most)}"
            cells = " | ".join(f"{e.gradients[i]:.1e}" for i in INPUTS if i in e.gradients)
            lines.append(
                f"| {name}, {body} | {100 * e.flips:.2g} % | {e.psnr_all:.1f} | {e.psnr:.1f} | {cells} | "
                f"{bounds}: {'met' if passed else 'MISSED'} |"
            )
    return lines


def report(bodies: list[str], names: list[str], cases: int) -> str:
    """The whole text of docs/numerics.md."""
    text = [
        "# Numerics of the rasteriser",
        "",
        "Written by `python -m benchmarks.numerics`; do not edit. Errors of each body against the float64 oracle "
        "(torch, autograd) on inputs rounded to float32.",
        "",
        f"{datetime.date.today().isoformat()}; {_machine()}.",
        "",
        "`dB` is the PSNR of the pixels without flips, for a peak of 1 or of the brightest channel. `flips` is the "
        "share of the other pixels. Gradient errors are relative L2 errors.",
        "",
        "Bodies: `cpu` is compiled float32, `reference32` the torch reference in float32, `cuda` the CUDA kernels on "
        "CPU fibers (smaller scenes).",
        "",
        "## Two rooms",
        "",
        "W0: 400 Gaussians, 64 x 48. W1: 20,000 Gaussians, 320 x 180. Gradients are those of a randomly weighted sum "
        "of colours and alphas over the pixels without flips.",
        "",
        *_workloads(bodies),
        "",
        "## Notes on conditioning",
        "",
        _NOTES.rstrip(),
        "",
        "## Generated cases",
        "",
        "`tests/backend/raster/test_properties.py`: " + _generated(cases) + " The environment variable "
        "`SPLANNEQUIN_CASES=20000` generates that many cases per property.",
        "",
        "## Hard cases",
        "",
        "PSNR in dB, and the largest gradient error of any input.",
        "",
        *_cases(bodies, names),
    ]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    bodies = [body for body in BODIES if body != "reference"]
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs" / "numerics.md", metavar="FILE")
    parser.add_argument("--bodies", nargs="+", choices=bodies, default=bodies)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES), metavar="CASE")
    parser.add_argument(
        "--generate", type=int, default=0, metavar="N", help="cases per property (0: the tests' default)"
    )
    arguments = parser.parse_args()
    text = report(arguments.bodies, arguments.cases, arguments.generate)
    partial = arguments.out.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(arguments.out)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
