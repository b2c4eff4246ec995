"""Seconds until the first frame of a new process, with an empty and with a full kernel cache: `python
-m benchmarks.cold_start [--rounds N]`. A frame is 100 Gaussians on 64 x 48 px, forward and backward, on the CPU.

Each round starts new processes. `import` is the time to import the rasteriser after torch; `first` and `second` are
the times of the first two calls.
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[1]
CHILD = """
import json, os, time
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
import torch
start = time.perf_counter()
import torch_backend.raster as raster
imported = time.perf_counter()
torch.manual_seed(0)
leaves = [t.requires_grad_() for t in (torch.rand(100, 3) + 1, torch.randn(100, 4), torch.full((100, 3), -3.0),
                                       torch.zeros(100), torch.rand(100, 3))]
def frame():
    began = time.perf_counter()
    out = raster.rasterize(*leaves, viewmats=torch.eye(4)[None], Ks=torch.tensor([[[40.0, 0, 32], [0, 40, 24],
                           [0, 0, 1]]]), width=64, height=48)
    out.colors.sum().backward()
    return time.perf_counter() - began
first, second = frame(), frame()
print(json.dumps({"import": imported - start, "first": first, "second": second}))
"""


def one(cache: pathlib.Path) -> dict[str, float]:
    """Seconds of each part of a new process whose Warp cache is the folder `cache`."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(cache)}
    run = subprocess.run(
        [sys.executable, "-P", "-c", CHILD], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(run.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    results: dict[str, list[dict[str, float]]] = {"empty cache": [], "full cache": []}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            for label in results:
                results[label].append(one(pathlib.Path(folder)))
    for label, runs in results.items():
        figures = {name: [run[name] for run in runs] for name in runs[0]}
        print(
            f"{label:12s}"
            + "".join(
                f"  {name} {statistics.median(v):.3f} s [{min(v):.3f}, {max(v):.3f}]" for name, v in figures.items()
            )
        )


if __name__ == "__main__":
    main()
