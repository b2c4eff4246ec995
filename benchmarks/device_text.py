"""Runs the project's kernels on a CPU in their GPU variant (`__CUDA_ARCH__`), plain and under sanitizers.

Warp's cpu device runs the other variant: shuffles through memory, no votes, plain atomics. This tool records launches
on that device, with their buffers before and after. The launches are those of a few small scenes (the rasteriser, on
fibers), of SSIM and the loss, of Adam, and of a field's planes. `device_text.cpp` repeats them with real votes and
shuffles per warp, and atomics. The tool cannot detect races between blocks, errors of stream order, reads of
uninitialised memory, or the rounding of a GPU's exp2 and division.

    python -m benchmarks.device_text                the launches against Warp's cpu device
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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import warp as wp

from torch_backend.deformation import planes_cuda
from torch_backend.raster import RasterSettings, cuda, hit_lists, rasterize, ssim_cuda
from torch_backend.raster import cuda_source as source
from torch_backend.train import adam

NAMES = [name for names in source.POINTERS.values() for name in names]
FLOATS = [name for name, kind in source.FIELDS.items() if kind == "float32"]
BUILDS = {
    "plain": ["-O1"],
    "address,undefined": ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"],
    "thread": ["-O1", "-g", "-fsanitize=thread", "-DTHREADS"],
}
"""Name -> compiler flags."""
BACKWARD = ("raster_blend_backward", "raster_project_backward", "plane_gradients")
"""Kernels whose sums have another order on a GPU; all others agree with Warp's cpu device bit for bit."""

SAME = {name + " = 1;": f"SAME({name});" for name in ("live", "many", "bad[0]")}
"""Flags to which several threads of a block write the same 1. CUDA allows that and C++ does not, so the thread
sanitizer ignores exactly these writes."""


def compiler() -> str | None:
    """Path of a C++ compiler on this machine, or None."""
    return shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


class Launches:
    """Recorder of kernel launches on Warp's cpu device, with all memory reachable by pointers before and after."""

    def __init__(self) -> None:
        self.records: list[bytes] = []
        self.bodies: dict[str, str] = {}
        """Name of a launched kernel -> its function's text."""
        self._known: dict[int, torch.Tensor] = {}

    @contextlib.contextmanager
    def noted(self) -> Iterator[None]:
        """Context that records every launch. A pointer is identified by the tensor whose `data_ptr` returned it; these
        tensors are kept alive."""
        call, ask, modules = cuda._Launcher.__call__, torch.Tensor.data_ptr, (ssim_cuda, adam, planes_cuda)
        launch_on = [module.launch_on for module in modules]
        notes = self

        def noting_ask(self: torch.Tensor) -> int:
            address = ask(self)
            before = notes._known.get(address)
            if address and (before is None or before.nbytes < self.nbytes):
                notes._known[address] = self.detach()
            return address

        def noting_call(self: Any, name: str, args: Any, threads: int, channels: int = 0) -> None:
            if threads:
                whole, body = f"{name}{channels or ''}", (source.blending(channels) if channels else source.stages())
                notes.bodies[whole] = _raster_function(whole, body[name])
                values = [(True, int(getattr(args, pointer)), pointer) for pointer in NAMES]
                values += [(False, _bits(int(getattr(args, size))), size) for size in source.SIZES]
                values += [(False, _bits(float(getattr(args, name))), name) for name in FLOATS]
                notes._note(whole, threads, values, lambda: call(self, name, args, threads, channels))

        def noting_launch(kernel: Any, dim: int, inputs: list[Any], device: torch.device) -> None:
            if dim:
                whole = kernel.key + kernel.module.name[len(kernel.module.name.rstrip("0123456789")) :]
                notes.bodies[whole] = _plain_function(whole, kernel)
                values = [
                    (arg.type is wp.uint64, _bits(value), arg.label)
                    for arg, value in zip(kernel.adj.args, inputs, strict=True)
                ]
                notes._note(whole, dim, values, lambda: launch_on[0](kernel, dim, inputs, device))

        torch.Tensor.data_ptr = noting_ask  # type: ignore[method-assign]
        cuda._Launcher.__call__ = noting_call  # type: ignore[method-assign]
        for module in modules:
            module.launch_on = noting_launch  # type: ignore[attr-defined]
        try:
            yield
        finally:
            del torch.Tensor.data_ptr  # uncovers the base class's method
            cuda._Launcher.__call__ = call  # type: ignore[method-assign]
            for module, plain in zip(modules, launch_on, strict=True):
                module.launch_on = plain  # type: ignore[attr-defined]
            self._known.clear()

    def _note(self, name: str, threads: int, values: list[tuple[bool, int, str]], launch: Callable[[], None]) -> None:
        """Runs a launch and appends its record. Values: (whether it is a pointer, bits, name)."""
        reached: dict[int, tuple[str, torch.Tensor]] = {}
        for points, value, label in values:
            if points and value:
                self._reach(value, label, reached)
        before = {address: _bytes(tensor) for address, (_, tensor) in reached.items()}
        launch()
        parts = [name.encode().ljust(64, b"\0"), struct.pack("<ii", threads, len(values))]
        parts += [struct.pack("<iQ", points, value) for points, value, _ in values]
        parts.append(struct.pack("<i", len(reached)))
        for address, (label, tensor) in reached.items():
            kind = 1 if tensor.is_floating_point() else 2 if self._is_table(tensor) else 0
            parts += [label.encode().ljust(32, b"\0"), struct.pack("<iQq", kind, address, len(before[address]))]
            parts += [before[address], _bytes(tensor)]
        self.records.append(b"".join(parts))

    def _reach(self, address: int, label: str, reached: dict[int, tuple[str, torch.Tensor]]) -> None:
        """Adds the tensor at an address, and those that its elements point to. KeyError for an unknown address."""
        if address in reached:
            return
        tensor = self._known[address]
        reached[address] = (label, tensor)
        if self._is_table(tensor):
            for n, word in enumerate(_flat(tensor).tolist()):
                if word in self._known:
                    self._reach(word, f"{label}.{n}", reached)

    def _is_table(self, tensor: torch.Tensor) -> bool:
        return tensor.dtype == torch.int64 and any(word in self._known for word in _flat(tensor).tolist())

    def write(self, folder: Path) -> None:
        """Writes launches.bin and kernels.inc, for `build` and `run`."""
        (folder / "launches.bin").write_bytes(struct.pack("<i", len(self.records)) + b"".join(self.records))
        (folder / "kernels.inc").write_text(_kernels(self.bodies), encoding="utf-8")


def _flat(tensor: torch.Tensor) -> torch.Tensor:
    """The elements of a dense tensor in memory order."""
    return tensor.detach().as_strided((tensor.numel(),), (1,))


def _bytes(tensor: torch.Tensor) -> bytes:
    return _flat(tensor).view(torch.uint8).numpy().tobytes()


def _bits(value: float) -> int:
    """Bits of an int as 64 bits, or of a float as float32."""
    return struct.unpack("<I", struct.pack("<f", value))[0] if isinstance(value, float) else value & (2**64 - 1)


def _raster_function(whole: str, body: str) -> str:
    """Function text of a rasteriser kernel, whose arguments are a structure filled once per launch by `fill`."""
    return _function(whole, f"Args& args = args_of_launch;\n{body}")


_TAKEN = {
    wp.uint64: "uint64_t {} = values[{}];", wp.int32: "int {} = (int)values[{}];",
    wp.float32: "float {} = same_bits<float>((int)values[{}]);",
}  # fmt: skip


def _plain_function(whole: str, kernel: Any) -> str:
    """Function text of a kernel whose arguments are numbers and pointers, and whose threads are independent."""
    cells = [cell.cell_contents for cell in kernel.func.__closure__]
    (native,) = (each for each in cells if hasattr(each, "native_snippet"))
    taken = "".join(f"const {_TAKEN[arg.type].format(arg.label, i)} " for i, arg in enumerate(kernel.adj.args))
    return _function(whole, f"{taken}const int tid = task;\n{native.native_snippet}")


def _function(whole: str, body: str) -> str:
    for flag, named in SAME.items():
        body = body.replace(flag, named)
    # Macros are local to a kernel's text.
    defined = {line.split()[1].split("(")[0] for line in body.splitlines() if line.startswith("#define")}
    text = f"static void {whole}(const uint64_t* values, int task) {{\n{body}\n}}\n"
    return text + "".join(f"#undef {macro}\n" for macro in sorted(defined))


def _kernels(bodies: dict[str, str]) -> str:
    """The rasteriser's parameter structure, and a function for each launched kernel."""
    fields = "".join(f"uint64_t {name}; " for name in NAMES) + "".join(f"int {name}; " for name in source.SIZES)
    filled = "".join(f"args_of_launch.{name} = values[{i}]; " for i, name in enumerate([*NAMES, *source.SIZES]))
    floats = len(NAMES) + len(source.SIZES)
    kept = "".join(f"float {name}; " for name in FLOATS)
    text = f"struct Args {{ {fields}{kept}}};\nstatic Args args_of_launch;\n"
    text += f"static void fill(const uint64_t* values) {{ {filled}"
    text += "".join(
        f"args_of_launch.{name} = same_bits<float>((int)values[{floats + i}]); " for i, name in enumerate(FLOATS)
    )
    text += "}\n"
    rows = [f'{{"{name}", {name}, {int(name.startswith("raster_"))}}}' for name in sorted(bodies)]
    text += "".join(bodies[name] for name in sorted(bodies))
    text += "static const struct { const char* name; Kernel run; bool blocks; } "
    return text + f"TABLE[] = {{{', '.join(rows)}}};\n"


def build(folder: Path, which: str = "plain") -> Path:
    """Compiles the launched kernels and returns the program. RuntimeError with the first compiler error."""
    program = folder / f"device_text_{which.replace(',', '_')}"
    command = [compiler() or "c++", "-std=c++20", "-w", "-pthread", "-ffp-contract=off", *BUILDS[which]]
    command += [f"-I{folder}", str(Path(__file__).with_suffix(".cpp")), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[:300]))
    return program


def run(program: Path, most: int = 1 << 30) -> tuple[list[dict[str, Any]], str]:
    """(a row per launch, messages of the sanitizer). `most`: greatest number of blocks to run of each launch."""
    environ = {**os.environ, "ASAN_OPTIONS": "detect_stack_use_after_return=0", "TSAN_OPTIONS": "halt_on_error=0"}
    command = [str(program), str(program.parent / "launches.bin"), str(most)]
    done = subprocess.run(command, capture_output=True, text=True, env=environ)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    messages = [line for line in done.stderr.splitlines() if "fully support makecontext" not in line]
    return rows, "\n".join(messages)


def judge(rows: list[dict[str, Any]], bound: float = 1e-5) -> list[str]:
    """Faults of launches: barriers that not all threads reach, and results that differ from Warp's cpu device."""
    wrong: list[str] = []
    for row in rows:
        if not row["met"]:
            wrong.append(f"{row['kernel']}: a vote, shuffle or barrier is not reached by all threads")
        kernel = row["kernel"].rstrip("0123456789")
        for name, (count, of, distance) in row["differs"].items():
            if kernel not in BACKWARD or not distance <= bound:
                wrong.append(f"{row['kernel']}: {name} differs in {count} of {of} words, by {distance:.1e}")
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
    """Draws a frame and its gradients; returns (number of its hits, capacity of its hit list)."""
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
    """Gaussians with NaN, infinite or extreme parameters among valid ones."""
    cloud = _cloud(n, 9, 1)
    nan, inf = float("nan"), float("inf")
    cloud["means"][:3] = torch.tensor([[nan, 0, 3], [1e30, 0, 3], [0, 0, 1e-3]])
    cloud["log_scales"][3:7, 0] = torch.tensor([31.0, -40.0, inf, 20.0])
    cloud["quats"][7:10] = torch.tensor([[0.0] * 4, [1e-30] * 4, [1e30] * 4])
    cloud["opacity_logits"][10:14] = torch.tensor([inf, -inf, nan, 1e30])
    cloud["sh"][14] = nan
    return cloud


def note_scenes(launches: Launches) -> list[tuple[int, int]]:
    """Draws small frames and gradients that reach every branch: odd sizes, more hits than the list holds, Gaussians
    over many tiles, several cameras, 32-bit tile numbers, unaligned harmonics, non-finite values.

    Returns (number of hits, capacity of the hit list) of each frame.
    """
    hits: list[tuple[int, int]] = []

    def draw(*args: Any, **more: Any) -> None:
        hits.append(_drawn(*args, **more))

    step, wide = hit_lists.HITS_STEP, source.WIDE_FROM
    hit_lists.HITS_STEP = 1
    hit_lists.forget_demands()
    try:
        with launches.noted():
            draw(_cloud(90, 1, 2), 50, 37, settings=RasterSettings(antialiased=True, absgrad=True), with_depth=True)
            draw(_cloud(20, 1, 1), 112, 80, with_top=True)
            draw(_cloud(30, 2, 1, larger=2.5), 112, 80, with_top=True)  # more hits than the list of the last call holds
            draw(_cloud(30, 2, 1, larger=2.5), 112, 80, with_top=True)  # now the list holds them
            draw(_cloud(70, 3, 0), 40, 33, cameras=3)
            source.WIDE_FROM = 1
            draw(_cloud(50, 4, 3), 50, 20)
            draw(broken(), 40, 30)
    finally:
        hit_lists.HITS_STEP, source.WIDE_FROM = step, wide
        hit_lists.forget_demands()
    return hits


def note_training_kernels(launches: Launches) -> None:
    """Runs SSIM, the loss, Adam and a field's planes with their gradients, including edge cases: odd sizes, ignored
    pixels, rows out of view, a skipped step, points that are NaN or outside the box, planes of one node, channel counts
    not divisible by four."""
    g = torch.Generator().manual_seed(12)
    with launches.noted():
        for shape in ((11, 11, 1), (17, 23, 3)):
            image, target = torch.rand(2, *shape, generator=g)
            ssim_cuda.ssim(image.requires_grad_(), target).backward()
            ssim_cuda.ssim(image.detach(), target)
            ignored = torch.rand(shape[:2], generator=g) > 0.7
            ssim_cuda.photometric(image, target, 0.2, ignored).backward()
        leaves = [torch.nn.Parameter(torch.randn(*size, generator=g)) for size in ((70, 3), (1300, 4), (5,))]
        options = [{"rows": True, "lr_unit_distance": 2.0}, {"clamp": (-0.5, 0.5)}, {"lr": 0.1}]
        groups = [{"params": [leaf], **more} for leaf, more in zip(leaves, options, strict=True)]
        optimizer = adam.FusedAdam(groups, lr=0.01, kernel=True)
        for has_nan in (False, True, False):
            grads = [torch.randn(leaf.shape, generator=g) for leaf in leaves]
            if has_nan:
                grads[1][::3] = float("nan")
            for leaf, grad in zip(leaves, grads, strict=True):
                leaf.grad = grad
            visible = torch.rand(70, generator=g) > 0.4
            optimizer.step(visible=visible, guard=[torch.ones(3)])
        for channels, columns in ((16, 7), (5, 7), (8, 1)):
            sizes = [(5, 6), (9, columns), (9, 6), (3, columns), (3, 6), (3, 9)]
            planes = [torch.rand(1, channels, *size, generator=g) + 0.5 for size in (*sizes, *sizes)]
            planes = [p.contiguous(memory_format=torch.channels_last).requires_grad_() for p in planes]
            where = 1.3 * torch.randn(77, 4, generator=g)
            where[:3] = torch.tensor([[float("nan")] * 4, [float("inf")] * 4, [-1.0, 1.0, 0.0, 1.0]])
            features = planes_cuda.features(where.requires_grad_(), planes)
            features.backward(torch.randn(features.shape, generator=g))
            planes_cuda.penalty(planes, [(0.5, 0.3, 0.1)] * 12).backward()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--sanitize", action="store_true", help="also run under the address, undefined-behaviour and thread sanitizers"
    )
    sanitize = parser.parse_args().sanitize
    if compiler() is None:
        print("There is no C++ compiler (c++, g++ or clang++) on the PATH.", file=sys.stderr)
        return 2
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        launches = Launches()
        note_scenes(launches)
        note_training_kernels(launches)
        launches.write(Path(folder))
        for which in BUILDS if sanitize else ("plain",):
            rows, said = run(build(Path(folder), which), 4 if which == "thread" else 1 << 30)
            blocks = sum(row["blocks"] for row in rows)
            worst = max((distance for row in rows for _, _, distance in row["differs"].values()), default=0.0)
            print(
                f"{which}: {len(rows)} launches, {blocks} blocks, largest gradient difference {worst:.1e}", flush=True
            )
            wrong += [f"{which}: {line}" for line in [*judge(rows), *said.splitlines()[:40]]]
            wrong += [] if len(rows) == len(launches.records) else [f"{which}: it ended after {len(rows)} launches"]
    print("\n".join(wrong) or "nothing is wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
