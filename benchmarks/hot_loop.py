"""How near blending comes to the limit of its inner loops: `python -m benchmarks.hot_loop [W1 W2 W3] [--json FILE]`.

The limit: the very text of the forward and the backward row loop (`cpu_source.FORWARD_ROW`, `BACKWARD_ROW`), compiled
the same way, over one tile of 16 full rows and 16 Gaussians, all of it in the first-level cache, every row lit and
every branch predictable. It leaves out what blending does besides: fetching Gaussians, row masks, sums over lanes,
mispredicted branches, tile set-up and images. The best of many short runs counts.

Lanes: 16 for every row of a hit that is worked on, counted by blending built with a counter. Cycles: core clock,
measured beside by a chain of dependent additions and exclusive ors, one cycle each.

Share = (limit in cycles per lane x lanes) / (seconds of the blending stage x clock x threads).
"""

import argparse
import contextlib
import ctypes
import functools
import json
import os
import pathlib
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from benchmarks.workload import WORKLOADS, Workload, room
from torch_backend import native
from torch_backend.raster import RasterSettings, cpu, rasterize
from torch_backend.raster import cpu_source as source

CHANNELS = 3
"""Channels of the limit and of the workloads."""
_HITS = 16
_CHAIN, _FORWARD, _BACKWARD = range(3)

_CHAIN_TEXT = r"""
long long x = P.visible, y = P.hits;
for (long long i = 0; i < P.n; i++) x = (x + y) ^ i;
P.visible = x;
"""
_OPERANDS = r"""
const int NCH = @NCH@;
const long long RS = P.record_stride;
F T[16];
int slots[16];
unsigned masks[16];
float dys[16][16], shifts[16][16], levels[16][16];
for (int l = 0; l < 16; l++) {
    const float* r = P.record + l * RS;
    F dy = LANE + 0.5f - r[1];
    slots[l] = l; masks[l] = (unsigned)P.width;
    store(dys[l], dy); store(shifts[l], 0.5f - r[0] - r[3] * dy); store(levels[l], fma(r[4] * dy, dy, (F)r[5])); }
"""
_RESET = r"""
    // T falls with every hit; it is set back before it reaches the stop.
    if (turn % 16 == 0) for (int i = 0; i < 16; i++) T[i] = (F)1.f;
"""
_FORWARD_TEXT = (
    _OPERANDS
    + r"""
F C[NCH][16], totals[16], peaks[16];
for (int c = 0; c < NCH; c++) for (int i = 0; i < 16; i++) C[c][i] = (F)0.f;
for (long long turn = 0; turn < P.n; turn++) {
"""
    + _RESET
    + r"""
    for (int l = 0; l < 16; l++) {
"""
    + source.HIT
    + r"""
        F total = (F)0.f, peak = (F)0.f;
"""
    + source.ROWS
    + source.FORWARD_ROW
    + r"""
        }
        totals[l] = total; peaks[l] = peak;
    }
}
F all = (F)0.f;
for (int i = 0; i < 16; i++) { all += T[i] + totals[i] + peaks[i]; for (int c = 0; c < NCH; c++) all += C[c][i]; }
store(P.image, all);
"""
)
_BACKWARD_TEXT = (
    _OPERANDS
    + r"""
F left[16], G[NCH][16], all = (F)0.f;
const bool want_abs = P.want_abs != 0;
for (int i = 0; i < 16; i++) {
    left[i] = (F)P.background[0]; for (int c = 0; c < NCH; c++) G[c][i] = LANE * P.background[c]; }
for (long long turn = 0; turn < P.n; turn++) {
"""
    + _RESET
    + r"""
    for (int l = 0; l < 16; l++) {
"""
    + source.HIT
    + source.BACKWARD_SUMS
    + source.ROWS
    + source.BACKWARD_ROW
    + r"""
        }
        all += s0 + s1 + s2 + s3 + s4 + s5 + ax + ay;
        for (int c = 0; c < NCH; c++) all += gc[c];
    }
}
for (int i = 0; i < 16; i++) all += T[i] + left[i];
store(P.image, all);
"""
)


@dataclass(frozen=True)
class HotLoop:
    """The limit on this machine, for three channels."""

    forward_cycles_per_lane: float
    backward_cycles_per_lane: float
    clock_hz: float
    """Core clock measured beside the loops."""


@dataclass(frozen=True)
class BlendTimes:
    """Blending of one workload: medians of the stage's time within whole frames, and its work."""

    forward_s: float
    backward_s: float
    forward_lanes: int
    """16 for every row of a hit that is worked on."""
    backward_lanes: int
    threads: int

    def shares(self, limit: HotLoop) -> tuple[float, float]:
        """Share of the limit, (forward, backward): 1 would be the hot loop's own speed on every thread."""
        ahead = limit.forward_cycles_per_lane * self.forward_lanes / (self.forward_s * self.threads)
        back = limit.backward_cycles_per_lane * self.backward_lanes / (self.backward_s * self.threads)
        return ahead / limit.clock_hz, back / limit.clock_hz


@functools.cache
def _limit_kernel():
    text = source.assemble([_CHAIN_TEXT, _FORWARD_TEXT, _BACKWARD_TEXT], {"NCH": CHANNELS})
    return native.build("raster_hot_loop", text)


def limits(repeats: int = 60) -> HotLoop:
    """Measure the limit on the calling thread, in about a tenth of a second after the first call."""
    run, block = _limit_kernel(), source.Block()
    records = torch.zeros(_HITS, 16)
    # Wide, faint Gaussians about the tile: alpha between 0.006 and 0.008 everywhere.
    records[:, 0:2] = torch.linspace(4, 12, _HITS)[:, None]
    records[:, 2], records[:, 3], records[:, 4], records[:, 5] = -5e-4, 0.1, -5e-4, float(np.log2(0.008))
    records[:, source.HEAD : source.HEAD + CHANNELS] = torch.linspace(0.1, 0.9, _HITS)[:, None]
    sink, background = torch.zeros(64), torch.full((CHANNELS,), 1e-3)
    block.record, block.record_stride, block.image = records.data_ptr(), records.shape[1], sink.data_ptr()
    block.background, block.want_abs = background.data_ptr(), 1
    block.width = 0xFFFF  # the rows, as bits
    block.visible, block.hits = 1, 3

    def seconds(stage: int, turns: int) -> float:
        block.n = turns
        start = time.perf_counter()
        run(ctypes.addressof(block), stage, 0)
        return time.perf_counter() - start

    # The difference of a long and a short run, the best of each, holds no launch.
    turns = {_CHAIN: 500_000, _FORWARD: 160, _BACKWARD: 80}
    best = {(stage, times): 1e9 for stage in turns for times in (1, 2)}
    for _ in range(repeats):
        for stage, times in best:
            best[stage, times] = min(best[stage, times], seconds(stage, times * turns[stage]))
    each = {stage: (best[stage, 2] - best[stage, 1]) / count for stage, count in turns.items()}
    clock, lanes = 2 / each[_CHAIN], _HITS * 16 * 16
    return HotLoop(each[_FORWARD] * clock / lanes, each[_BACKWARD] * clock / lanes, clock)


class _Frames:
    """One workload as tensors; colours and their gradient, the outputs of a training step."""

    def __init__(self, work: Workload, threads: int):
        values = (
            work.means,
            work.quats,
            np.log(work.scales),
            np.log(work.opacities) - np.log1p(-work.opacities),
            work.colors,
        )
        self.leaves = [torch.tensor(value, requires_grad=True) for value in values]
        self.options = {
            "viewmats": torch.tensor(work.viewmat)[None],
            "Ks": torch.tensor(work.K)[None],
            "width": work.width,
            "height": work.height,
            "settings": RasterSettings(threads=threads),
            "backend": "cpu",
            "with_contributions": True,
        }
        self.g = torch.tensor(work.g)[None]

    def run(self) -> None:
        for leaf in self.leaves:
            leaf.grad = None
        torch.autograd.backward(rasterize(*self.leaves, **self.options).colors, self.g)


@contextlib.contextmanager
def _blending(kernel) -> Iterator[None]:
    """Have frames blend with `kernel` (block, stage, worker)."""
    own = cpu._compile(CHANNELS)
    cpu._kernels[CHANNELS] = kernel
    try:
        yield
    finally:
        cpu._kernels[CHANNELS] = own


@functools.cache
def _counting_kernel():
    text = source.blend_source(CHANNELS)
    assert text.count(source.ROWS) == 2, "blending does not hold its two row loops"
    text = text.replace(source.ROWS, source.ROWS + "((long long*)P.weight_sum)[stage]++;")
    return native.build("raster_blend_counting", text)


def count_rows(frames: _Frames) -> list[int]:
    """Rows entered in one frame, forward and backward."""
    counts, run = torch.zeros(2, dtype=torch.int64), _counting_kernel()

    def count(address: int, stage: int, worker: int) -> None:
        block = source.Block.from_address(address)
        kept = block.weight_sum
        block.weight_sum = counts.data_ptr()
        run(address, stage, worker)
        block.weight_sum = kept

    with _blending(count):
        frames.run()
    return counts.tolist()


def blend_times(work: Workload, threads: int, rounds: int = 15) -> BlendTimes:
    """Time the blending stages of `rounds` forward and backward passes of `work` (three colours), and count rows."""
    rows, rows_back = count_rows(_Frames(work, 1))
    frames = _Frames(work, threads)
    own, times = cpu.run_workers, {source.BLEND: [], source.BLEND_BACKWARD: []}
    blend = cpu._compile(CHANNELS)

    def timed(run, block: source.Block, stage: int, workers: int) -> None:
        start = time.perf_counter()
        own(run, block, stage, workers)
        if run is blend:
            times[stage].append(time.perf_counter() - start)

    frames.run()
    cpu.run_workers = timed
    try:
        for _ in range(rounds):
            frames.run()
    finally:
        cpu.run_workers = own
    return BlendTimes(
        float(np.median(times[source.BLEND])),
        float(np.median(times[source.BLEND_BACKWARD])),
        16 * rows,
        16 * rows_back,
        threads,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workloads", nargs="*", default=["W1", "W2", "W3"], metavar="W", help="W0 to W3")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, os.cpu_count() or 1}))
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE")
    arguments = parser.parse_args()
    results = []
    for name in arguments.workloads:
        work = room(*WORKLOADS[name])
        for threads in arguments.threads:
            # Beside each row: a machine shared with others has fast and slow minutes.
            limit, times = limits(), blend_times(work, threads, arguments.rounds)
            ahead, back = times.shares(limit)
            results.append(
                {
                    "workload": name,
                    "limit": asdict(limit),
                    **asdict(times),
                    "forward_share": ahead,
                    "backward_share": back,
                }
            )
            per = times.threads * limit.clock_hz
            print(
                f"{name}  {threads} threads at {limit.clock_hz / 1e9:.2f} GHz; cycles per lane, of the limit's:  "
                f"forward {times.forward_s * 1e3:6.2f} ms, {times.forward_s * per / times.forward_lanes:.2f} of "
                f"{limit.forward_cycles_per_lane:.2f}, {ahead:.0%}   backward {times.backward_s * 1e3:6.2f} ms, "
                f"{times.backward_s * per / times.backward_lanes:.2f} of {limit.backward_cycles_per_lane:.2f}, "
                f"{back:.0%}",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
