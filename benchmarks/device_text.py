"""The rasteriser's kernels as a GPU compiles them (`__CUDA_ARCH__`), run on a CPU, plain and under sanitizers.

What the fibers run of the text is its other side: shuffles through memory, no votes, plain atomics. Here every launch
of a few small scenes is written down with its buffers before and after on the fibers, and `device_text.cpp` does it
again with real votes and shuffles per warp, and atomics. What it cannot show: races between blocks, other streams,
memory that was never written, the roundings of a GPU's own exp2 and division.

    python -m benchmarks.device_text                the launches against the fibers
    python -m benchmarks.device_text --sanitize     once more under address and undefined, and under thread (minutes)
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from torch_backend.raster import RasterSettings, cuda, rasterize
from torch_backend.raster import cuda_source as source

NAMES = [name for names in source.POINTERS.values() for name in names]
BUILDS = {
    "plain": ["-O1"],
    "address,undefined": ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"],
    "thread": ["-O1", "-g", "-fsanitize=thread", "-DTHREADS"],
}
"""Name -> flags of the compiler."""
BACKWARD = ("raster_blend_backward", "raster_project_backward")
"""Kernels whose sums are of another order on a GPU; all others agree with the fibers to the bit."""

SAME = {"live = 1;": "SAME(live);", "many = 1;": "SAME(many);"}
"""Flags into which several threads of a block write the same 1, which CUDA allows and C++ does not: all that the thread
sanitizer is kept from telling."""


def compiler() -> str | None:
    """A C++ compiler of this machine."""
    return shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


class Launches:
    """Launches of the CUDA body on fibers, with all that their pointers point to before and after."""

    def __init__(self) -> None:
        self.records: list[bytes] = []
        self.kernels: set[tuple[str, int]] = set()

    @contextlib.contextmanager
    def noted(self) -> Iterator[None]:
        """Notes every launch within."""
        pointed: dict[int, dict[str, torch.Tensor | None]] = {}
        point, call = cuda._point, cuda._Launcher.__call__

        def noting_point(args: Any, **tensors: torch.Tensor | None) -> None:
            pointed.setdefault(id(args), {}).update(tensors)
            point(args, **tensors)

        def noting_call(self: Any, name: str, args: Any, threads: int, channels: int = 0) -> None:
            tensors = pointed[id(args)]
            before = {key: _bytes(value) for key, value in tensors.items()}
            call(self, name, args, threads, channels)
            if threads:
                notes.kernels.add((name, channels))
                notes.records.append(_record(f"{name}{channels or ''}", threads, args, tensors, before))

        notes = self
        cuda._point, cuda._Launcher.__call__ = noting_point, noting_call  # type: ignore[method-assign]
        try:
            yield
        finally:
            cuda._point, cuda._Launcher.__call__ = point, call  # type: ignore[method-assign]

    def write(self, folder: Path) -> None:
        """launches.bin and kernels.inc, for `build` and `run`."""
        (folder / "launches.bin").write_bytes(struct.pack("<i", len(self.records)) + b"".join(self.records))
        (folder / "kernels.inc").write_text(_kernels(sorted(self.kernels)), encoding="utf-8")


def _bytes(tensor: torch.Tensor | None) -> bytes | None:
    if tensor is None:
        return None
    return tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b""


def _record(
    name: str, threads: int, args: Any, tensors: dict[str, torch.Tensor | None], before: dict[str, bytes | None]
) -> bytes:
    sizes = [int(getattr(args, size)) for size in source.SIZES]
    parts = [name.encode().ljust(64, b"\0"), struct.pack(f"<i{len(sizes)}if", threads, *sizes, float(args.near))]
    for pointer in NAMES:
        was = before.get(pointer)
        if was is None:
            parts.append(struct.pack("<q", -1))
        else:
            parts += [struct.pack("<q", len(was)), was, _bytes(tensors[pointer]) or b""]
    return b"".join(parts)


def _kernels(used: list[tuple[str, int]]) -> str:
    """The parameter structure, and a function for each kernel that was launched."""
    fields = "".join(f"uint64_t {name}; " for name in NAMES) + "".join(f"int {name}; " for name in source.SIZES)
    filled = "".join(f"args.{name} = (uint64_t)at[{i}]; " for i, name in enumerate(NAMES))
    filled += "".join(f"args.{name} = sizes[{i}]; " for i, name in enumerate(source.SIZES))
    text = f"struct Args {{ {fields}float near; }};\nusing Kernel = void (*)(Args&, int);\n"
    text += f"enum {{ POINTERS = {len(NAMES)}, SIZES = {len(source.SIZES)} }};\n"
    text += f"static void fill(Args& args, const std::vector<void*>& at, const int* sizes, float near) {{ {filled}"
    text += "args.near = near; }\n"
    named = ", ".join(f'"{name}"' for name in NAMES)
    floats = ", ".join(str(int("float" in kind)) for kind, names in source.POINTERS.items() for _ in names)
    text += f"static const char* const NAMES[] = {{{named}}};\nstatic const int IS_FLOAT[] = {{{floats}}};\n"
    table: list[str] = []
    for name, channels in used:
        body = source.blending(channels)[name] if channels else source.stages()[name]
        whole = f"{name}{channels or ''}"
        for flag, named in SAME.items():
            body = body.replace(flag, named)
        # Macros of a kernel's text end with it.
        defined = {line.split()[1].split("(")[0] for line in body.splitlines() if line.startswith("#define")}
        text += f"static void {whole}(Args& args, int task) {{\n{body}\n}}\n"
        text += "".join(f"#undef {macro}\n" for macro in sorted(defined))
        table.append(f'{{"{whole}", {whole}}}')
    return text + f"static const struct {{ const char* name; Kernel run; }} TABLE[] = {{{', '.join(table)}}};\n"


def build(folder: Path, which: str = "plain") -> Path:
    """Compiles the launches' kernels; the program. RuntimeError with the first complaint if that fails."""
    program = folder / f"device_text_{which.replace(',', '_')}"
    command = [compiler() or "c++", "-std=c++20", "-w", "-pthread", "-ffp-contract=off", *BUILDS[which]]
    command += [f"-I{folder}", str(Path(__file__).with_suffix(".cpp")), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[:300]))
    return program


def run(program: Path, most: int = 1 << 30) -> tuple[list[dict[str, Any]], str]:
    """(a row per launch, what a sanitizer complained of). most: blocks of each launch that are run."""
    environ = {**os.environ, "ASAN_OPTIONS": "detect_stack_use_after_return=0", "TSAN_OPTIONS": "halt_on_error=0"}
    command = [str(program), str(program.parent / "launches.bin"), str(most)]
    done = subprocess.run(command, capture_output=True, text=True, env=environ)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    said = [line for line in done.stderr.splitlines() if "fully support makecontext" not in line]
    return rows, "\n".join(said)


def judge(rows: list[dict[str, Any]], bound: float = 1e-5) -> list[str]:
    """What is wrong with launches: barriers that not all reach, figures that are not the fibers'."""
    wrong: list[str] = []
    for row in rows:
        if not row["met"]:
            wrong.append(f"{row['kernel']}: a vote, shuffle or barrier is not reached by all threads")
        kernel = row["kernel"].rstrip("0123456789")
        for name, (count, of, off) in row["differs"].items():
            if kernel not in BACKWARD or not off <= bound:
                wrong.append(f"{row['kernel']}: {name} differs in {count} of {of} words, by {off:.1e}")
    return wrong


# ------------------------------------------------------------------------------------------------------- the scenes


def _cloud(n: int, seed: int, degree: int, larger: float = 0.0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=g) * torch.tensor([1.2, 0.9, 0.6]) + torch.tensor([0.0, 0.0, 3.0])
    return {
        "means": means, "quats": torch.randn(n, 4, generator=g),
        "log_scales": torch.randn(n, 3, generator=g) * 0.5 - 2.5 + larger,
        "opacity_logits": torch.randn(n, generator=g) * 2.0 + 1.0,
        "sh": torch.randn(n, (degree + 1) ** 2, 3, generator=g) * 0.3,
    }  # fmt: skip


def _drawn(cloud: dict[str, torch.Tensor], width: int, height: int, cameras: int = 1, **more: Any) -> tuple[int, int]:
    """A frame and its gradients; how many hits it has, and how many its list holds."""
    g = torch.Generator().manual_seed(0)
    leaves = {name: value.clone().requires_grad_() for name, value in cloud.items()}
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-0.2, 0.2, cameras) if cameras > 1 else 0.0
    viewmats.requires_grad_()
    K = torch.tensor([[0.9 * width, 0.0, width / 2], [0.0, 0.9 * width, height / 2], [0.0, 0.0, 1.0]])
    out = rasterize(
        **leaves, viewmats=viewmats, Ks=K.repeat(cameras, 1, 1), width=width, height=height, backend="cuda",
        background=torch.rand(3, generator=g), with_contributions=True, **more,
    )  # fmt: skip
    loss = (out.colors * torch.randn(out.colors.shape, generator=g)).sum() + out.alphas.sum()
    loss.backward()
    assert out.hits is not None
    many, room = (int(n) for n in out.hits)
    return many, room


def broken(n: int = 48) -> dict[str, torch.Tensor]:
    """Gaussians whose numbers are none, or beyond all measure, among sound ones."""
    cloud = _cloud(n, 9, 1)
    nan, inf = float("nan"), float("inf")
    cloud["means"][:3] = torch.tensor([[nan, 0, 3], [1e30, 0, 3], [0, 0, 1e-3]])
    cloud["log_scales"][3:7, 0] = torch.tensor([31.0, -40.0, inf, 20.0])
    cloud["quats"][7:10] = torch.tensor([[0.0] * 4, [1e-30] * 4, [1e30] * 4])
    cloud["opacity_logits"][10:14] = torch.tensor([inf, -inf, nan, 1e30])
    cloud["sh"][14] = nan
    return cloud


def note_scenes(launches: Launches) -> list[tuple[int, int]]:
    """Small frames and gradients that meet every branch: odd sizes, hits that outnumber their list, Gaussians over many
    tiles, several cameras, tiles whose numbers take 32 bits, harmonics that lie unaligned, what is not finite.

    Returns the hits of each frame, and how many its list holds.
    """
    hits: list[tuple[int, int]] = []

    def draw(*asked: Any, **more: Any) -> None:
        hits.append(_drawn(*asked, **more))

    step, wide = cuda._HITS_STEP, source.WIDE_FROM
    cuda._HITS_STEP = 1
    cuda.forget_demands()
    try:
        with launches.noted():
            draw(_cloud(90, 1, 2), 50, 37, settings=RasterSettings(antialiased=True, absgrad=True), with_depth=True)
            draw(_cloud(20, 1, 1), 112, 80, with_top=True)
            draw(_cloud(30, 2, 1, larger=2.5), 112, 80, with_top=True)  # more hits than the list of the last call
            draw(_cloud(30, 2, 1, larger=2.5), 112, 80, with_top=True)  # listed now
            draw(_cloud(70, 3, 0), 40, 33, cameras=3)
            source.WIDE_FROM = 1
            draw(_cloud(50, 4, 3), 50, 20)
            draw(broken(), 40, 30)
    finally:
        cuda._HITS_STEP, source.WIDE_FROM = step, wide
        cuda.forget_demands()
    return hits


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sanitize", action="store_true", help="under address, undefined and thread sanitizers, too")
    sanitize = parser.parse_args().sanitize
    if compiler() is None:
        print("There is no C++ compiler (c++, g++ or clang++) on the PATH.", file=sys.stderr)
        return 2
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as made:
        launches = Launches()
        note_scenes(launches)
        launches.write(Path(made))
        for which in BUILDS if sanitize else ("plain",):
            rows, said = run(build(Path(made), which), 4 if which == "thread" else 1 << 30)
            blocks = sum(row["blocks"] for row in rows)
            worst = max((off for row in rows for _, _, off in row["differs"].values()), default=0.0)
            print(f"{which}: {len(rows)} launches, {blocks} blocks, gradients off by {worst:.1e} at most", flush=True)
            wrong += [f"{which}: {line}" for line in [*judge(rows), *said.splitlines()[:40]]]
            wrong += [] if len(rows) == len(launches.records) else [f"{which}: it ended after {len(rows)} launches"]
    print("\n".join(wrong) or "nothing is wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
