"""Times the rasteriser on seeded workloads: `python -m benchmarks.raster [W0 W1 ...] [--json FILE]`.

Rivals: `--reference` (the torch backend in float32) and `--peer MODULE` (see `benchmarks/peers`). Errors are measured
by `benchmarks/numerics.py`.

The workloads are those of `benchmarks/workload.py`. Bodies run alternately, round by round, so that other load on the
machine affects all of them alike.
"""

import argparse
import datetime
import importlib
import json
import os
import pathlib
import platform
import sys
import time
from dataclasses import dataclass
from importlib import metadata
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from benchmarks.peers import Peer, Prepared
from benchmarks.workload import WORKLOADS, Workload, room
from torch_backend.raster import RasterSettings, rasterize

SLOW_MS = 1000.0
"""A body whose first two frames both take longer than this, in ms, gets at most `SLOW_ROUNDS` rounds."""
SLOW_ROUNDS = 5


@dataclass(frozen=True)
class Body:
    """One way to render: a body of this rasteriser, or a peer."""

    backend: str
    """`backend` of `rasterize`, or "peer"."""
    device: str = "cpu"
    threads: int = 1
    degree: int | None = None
    """Degree of the spherical harmonics; None for plain colours."""
    peer: str = ""
    """Import path of the peer's module."""
    graph: bool = False
    """True to capture a frame and its gradient as one CUDA graph, like a training step (`train.recorder`)."""

    def prepare(self, work: Workload) -> Prepared:
        if self.backend == "peer":
            return _peer(self.peer).prepare(work, self.device)

        def put(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array).to(self.device, torch.float32)

        leaves = {
            "means": put(work.means),
            "quats": put(work.quats),
            "log_scales": put(np.log(work.scales)),
            "opacity_logits": put(np.log(work.opacities) - np.log1p(-work.opacities)),
            "viewmats": put(work.viewmat[None]),
        }
        if self.degree is None:
            leaves["colors"] = put(work.colors)
        else:
            generator = torch.Generator().manual_seed(1)
            sh = 0.2 * torch.randn(len(work.means), (self.degree + 1) ** 2, 3, generator=generator)
            leaves["sh"] = sh.to(self.device, torch.float32)
        for leaf in leaves.values():
            leaf.requires_grad_()
        Ks, settings = torch.tensor(work.K)[None].to(self.device), RasterSettings(threads=self.threads)

        def forward() -> torch.Tensor:
            return rasterize(
                leaves["means"],
                leaves["quats"],
                leaves["log_scales"],
                leaves["opacity_logits"],
                leaves.get("colors"),
                leaves.get("sh"),
                viewmats=leaves["viewmats"],
                Ks=Ks,
                width=work.width,
                height=work.height,
                backend=self.backend,
                settings=settings,
                with_contributions=True,
            ).colors[0]

        return Prepared(forward, leaves)


def _peer(module: str) -> Peer:
    return importlib.import_module(module)  # type: ignore[return-value]


class _Case:
    """One workload on one body."""

    def __init__(self, work: Workload, body: Body):
        self.body, self.prepared = body, body.prepare(work)
        self.g = torch.tensor(work.g).to(body.device, torch.float32)
        self._graph = self._captured() if body.graph else None

    def _captured(self) -> torch.cuda.CUDAGraph:
        """Graph of a frame and its gradient. Three plain runs first size the hit list."""
        for _ in range(3):
            self.image()
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self.image()
        return graph

    def image(self) -> torch.Tensor:
        """Runs forward and backward, untimed, and returns the image; the leaves then hold the gradients."""
        for leaf in self.prepared.leaves.values():
            leaf.grad = None
        image = self.prepared.forward()
        torch.autograd.backward(image, self.g)
        return image.detach()

    def run(self) -> tuple[float, float]:
        """Milliseconds of (forward, forward and backward); a graph returns its total for both."""
        if self._graph is not None:
            torch.cuda.synchronize()
            events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
            events[0].record()
            self._graph.replay()
            events[1].record()
            torch.cuda.synchronize()
            return events[0].elapsed_time(events[1]), events[0].elapsed_time(events[1])
        for leaf in self.prepared.leaves.values():
            leaf.grad = None
        if self.body.device == "cuda":
            torch.cuda.synchronize()
            events = [torch.cuda.Event(enable_timing=True) for _ in range(3)]
            events[0].record()
            image = self.prepared.forward()
            events[1].record()
            torch.autograd.backward(image, self.g)
            events[2].record()
            torch.cuda.synchronize()
            return events[0].elapsed_time(events[1]), events[0].elapsed_time(events[2])
        start = time.perf_counter()
        image = self.prepared.forward()
        middle = time.perf_counter()
        torch.autograd.backward(image, self.g)
        return (middle - start) * 1e3, (time.perf_counter() - start) * 1e3


def _figures(values: list[float]) -> dict[str, float]:
    """Median, quartiles, minimum and number of values."""
    low, middle, high = (float(v) for v in np.percentile(values, [25, 50, 75]))
    return {"median": middle, "low": low, "high": high, "min": min(values), "rounds": len(values)}


def interleaved(work: Workload, bodies: dict[str, Body], rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Milliseconds (forward, forward and backward) per body and round; the bodies alternate in each round."""
    cases = {label: _Case(work, body) for label, body in bodies.items()}
    slow = {label for label, case in cases.items() if case.run()[1] > SLOW_MS}  # the first frame compiles and warms up
    slow = {label for label in slow if cases[label].run()[1] > SLOW_MS}
    times: dict[str, list[tuple[float, float]]] = {label: [] for label in cases}
    for number in range(rounds):
        for label, case in cases.items():
            if label not in slow or number < SLOW_ROUNDS:
                times[label].append(case.run())
    return times


def measure(size: tuple[int, int, int], bodies: dict[str, Body], rivals: list[str], rounds: int) -> dict[str, Any]:
    """Figures of all bodies on `room(*size)`, and ratios of each rival's time to each of our bodies' times."""
    times = interleaved(room(*size), bodies, rounds)
    result: dict[str, Any] = {"gaussians": size[0], "width": size[1], "height": size[2], "bodies": {}, "ratios": {}}
    for label, pairs in times.items():
        forward, both = zip(*pairs, strict=True)
        result["bodies"][label] = {"forward_ms": _figures(list(forward)), "forward_backward_ms": _figures(list(both))}
    for rival in rivals:
        for label in bodies:
            if label not in rivals and bodies[label].degree is None:
                pairs = list(zip(times[rival], times[label], strict=False))  # pairs times of the same round
                result["ratios"][f"{rival} / {label}"] = {
                    name: _figures([theirs[i] / ours[i] for theirs, ours in pairs])
                    for i, name in enumerate(("forward", "forward_backward"))
                }
    return result


def machine(device: str) -> dict[str, Any]:
    """The machine, software versions and date of the figures."""
    model = platform.processor()
    if pathlib.Path("/proc/cpuinfo").exists():
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    packages = ("torch", "warp-lang", "numpy", "gsplat")
    versions = {d.name: d.version for d in metadata.distributions() if d.name in packages}
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "system": platform.platform(),
        "cpu": model,
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if device == "cuda" else None,
        "python": platform.python_version(),
        "versions": versions,
    }


def _print_times(title: str, result: dict[str, Any]) -> None:
    for label, figures in result["bodies"].items():
        f, b = figures["forward_ms"], figures["forward_backward_ms"]
        print(
            f"{title}  {label:24s} forward {f['median']:8.2f} [{f['low']:.2f}, {f['high']:.2f}] ms   "
            f"forward+backward {b['median']:8.2f} [{b['low']:.2f}, {b['high']:.2f}] ms   {b['rounds']} rounds"
        )
    for label, ratio in result["ratios"].items():
        f, b = ratio["forward"], ratio["forward_backward"]
        print(
            f"{title}  {label}: forward {f['median']:.1f} [{f['low']:.1f}, {f['high']:.1f}]   "
            f"forward+backward {b['median']:.1f} [{b['low']:.1f}, {b['high']:.1f}] times"
        )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "workloads", nargs="*", default=["W0", "W1", "W2"], metavar="W", help="W0 to W4 (default: W0 W1 W2)"
    )
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--threads",
        type=int,
        nargs="+",
        default=sorted({1, os.cpu_count() or 1}),
        help="threads of the CPU body; torch (reference, peers) uses the largest number",
    )
    parser.add_argument("--reference", action="store_true", help="also time the torch reference in float32 (slow)")
    parser.add_argument(
        "--peer",
        action="append",
        default=[],
        metavar="MODULE",
        help="also time this peer, e.g. benchmarks.peers.gsplat; may be repeated",
    )
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE", help="also write all figures to this JSON file")
    arguments = parser.parse_args()
    unknown = [w for w in arguments.workloads if w not in WORKLOADS]
    if unknown:
        parser.error(f"no such workload: {', '.join(unknown)}; there are {', '.join(WORKLOADS)}")
    if arguments.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch finds no CUDA device on this machine")
    return arguments


def main() -> None:
    arguments = _arguments()
    device, most = arguments.device, max(arguments.threads)
    torch.set_num_threads(most)
    if device == "cuda":
        plain = {"cuda": Body("auto", device)}
        ours = plain | {"cuda, SH 2": Body("auto", device, degree=2)}
    else:
        plain = {f"cpu, {t} threads": Body("cpu", threads=t) for t in arguments.threads}
        ours = plain | {f"{label}, SH 2": Body("cpu", threads=body.threads, degree=2) for label, body in plain.items()}
    rivals = {"torch reference": Body("reference", device, most)} if arguments.reference else {}
    for module in arguments.peer:
        missing = _peer(module).missing(device)
        if missing:
            print(missing)
        else:
            rivals[_peer(module).NAME] = Body("peer", device, most, peer=module)
    report: dict[str, Any] = {"machine": machine(device), "workloads": {}}
    for name in arguments.workloads:
        result = measure(WORKLOADS[name], ours | rivals, list(rivals), arguments.rounds)
        report["workloads"][name] = result
        _print_times(name, result)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
