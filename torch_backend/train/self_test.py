"""Self-test of a GPU. It compares a small frame with gradients, a loss, Adam steps and the field's planes with the CPU.

It runs in a separate process (`python -m torch_backend doctor --gpu`). The result is stored beside Warp's compiled
kernels, for one driver, GPU and versions of this package, Warp and torch, so the test runs once and again after an
update. A failure is stored only if two consecutive tests fail in the same way.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
import warp as wp
from torch import Tensor

from .. import __version__
from ..cards import nvidia_cards
from ..contract import ExitCode, JobError, check_version, content_key, from_dict, python_child, read_json
from ..deformation import planes, planes_cuda
from ..native import initialised_warp
from ..raster import RasterOutput, RasterSettings, rasterize, ssim, ssim_cuda
from ..shot import write_json
from ..torch_types import backward, norm_of_all
from .adam import FusedAdam
from .losses import photometric
from .recorder import CudaGraphs

SELF_TEST_VERSION = 4
# Timeout in seconds. Without a cache, the kernels take tens of seconds to compile.
_SECONDS = 240.0
_GAUSSIANS, _WIDTH, _HEIGHT = 300, 64, 48
# Largest share of pixels that may differ by more than `_PIXEL`: rounding can move a hit across the alpha threshold.
_FLIPPED = 0.01
_PIXEL = 3e-4
# Largest relative L2 error of a gradient, including hits that cross the alpha threshold (1e-4 to 4e-3 on fibers).
_GRADIENT = 2e-2
_CTRL_C_EXIT = 0xC000013A
"""Windows exit code of a process that was ended by Ctrl-C or by closing its console."""
_NO_NUMBER = 1e9
"""Error reported for values that are not finite."""
_EXACT = 1e-4
"""Largest relative L2 error of results without a threshold."""


@dataclass(frozen=True)
class Check:
    """Result of one comparison between GPU and CPU."""

    what: str
    """Description of the compared result."""
    error: float
    """Measured error."""
    bound: float
    """Largest allowed error."""


@dataclass
class SelfTest:
    """Result of a self-test."""

    version: int = SELF_TEST_VERSION
    """Format version of this record."""
    key: str = ""
    """Driver, GPU and versions that were tested (`self_test_key`)."""
    problem: str = ""
    """The fault that makes the GPU unusable, as a sentence; empty if there is none."""
    planes: str = ""
    """The fault of the plane kernels; empty if there is none. PyTorch operators on the GPU can replace the kernels."""
    recording: str = ""
    """The fault of steps recorded as CUDA graphs; empty if there is none. Steps can be launched unrecorded instead."""
    lasting: bool = True
    """True if another test would give the same result. False if GPU memory or disk was full, or the test was killed."""
    seconds: float = 0.0
    """Duration of the test in seconds, including compilation."""
    checks: list[Check] = field(default_factory=list[Check])
    """Results of the comparisons."""

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the fields that report a fault."""
        return tuple(name for name in ("problem", "planes", "recording") if getattr(self, name))


def self_test_key() -> str:
    """Key of the driver, the GPU and the versions of this package, torch and Warp."""
    cards = [dataclasses.astuple(card) for card in nvidia_cards()[0]]
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    return content_key(SELF_TEST_VERSION, cards, name, __version__, torch.__version__, wp.config.version)


def run_self_test(device: torch.device, key: str = "") -> SelfTest:
    """Tests the kernels on `device`. On 'cpu', CUDA kernels run on fibers (for unit tests). Failures do not raise."""
    found, since = SelfTest(key=key), time.perf_counter()
    found.problem = _problem(found, lambda: [*_frame(device), *_loss(device), *_adam(device)])
    if not found.problem:  # optional kernels last, since a faulty kernel breaks the CUDA context of the process
        found.planes = _problem(found, lambda: _planes(device))
        if device.type == "cuda":
            found.recording = _problem(found, lambda: _recording(device))
    found.seconds = round(time.perf_counter() - since, 2)
    return found


def _problem(found: SelfTest, compare: Callable[[], list[Check]]) -> str:
    """Runs `compare` and adds its checks to `found`. Returns the fault as a sentence; empty if there is none."""
    try:
        checks = compare()
    except torch.OutOfMemoryError:
        found.lasting = False
        return "its memory is taken by other programs"
    except (OSError, MemoryError, JobError) as error:  # caused by disk or main memory, not by the GPU
        found.lasting = False
        return f"it could not be tested ({str(error) or type(error).__name__})"
    except Exception as error:  # any error of a driver, compiler or kernel is a result of the test
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        return f"a kernel does not build or run on it ({reason})"
    found.checks += checks
    wrong = next((check for check in checks if not check.error <= check.bound), None)
    if wrong is None:
        return ""
    return f"{wrong.what} comes out wrong on it ({wrong.error:.1e} off, {wrong.bound:.0e} is allowed)"


def card_verdict(folder: Path | None = None, test: Callable[[str], SelfTest] | None = None) -> SelfTest:
    """Stored self-test result of this machine's GPU. Runs the test if there is none; a failing test runs twice.

    Args:
        folder: folder of the stored result (default: that of Warp's kernels).
        test: runs a self-test for a key (default: in a child process).
    """
    place, key = (folder or kernel_folder()) / "splannequin-card.json", self_test_key()
    found = _kept(place)
    if found is None or found.key != key:
        test = test or run_in_child
        first = found = test(key)
        # A single failure may come from a killed process or a full disk.
        if first.lasting and first.failed:
            found = test(key)
        keep(found, place.parent, confirmed=found.failed == first.failed)
    return found


def keep(found: SelfTest, folder: Path, confirmed: bool = False) -> None:
    """Stores a result. If it is not `lasting`, or is an unconfirmed failure, deletes the stored result instead."""
    place = folder / "splannequin-card.json"
    try:
        if found.lasting and (confirmed or not found.failed):
            write_json(place, dataclasses.asdict(found))
        else:
            place.unlink(missing_ok=True)
    except OSError:
        pass  # the folder is not writable, so the GPU is tested again next time


def kernel_folder() -> Path:
    """Folder in which Warp stores compiled kernels."""
    return Path(str(initialised_warp().config.kernel_cache_dir))


def _kept(place: Path) -> SelfTest | None:
    try:
        data = read_json(place)
        check_version(data, str(place), SELF_TEST_VERSION)
        return from_dict(SelfTest, {**data, "checks": [from_dict(Check, row) for row in data["checks"]]})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def run_in_child(key: str) -> SelfTest:
    """Runs the self-test in a child process."""
    # In a child: a faulty kernel leaves the CUDA context of its process unusable, and a driver may hang.
    command = python_child(sys.executable, "torch_backend", "doctor", "--gpu")
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH", "")) if part)
    try:
        ran = subprocess.run(
            **command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, encoding="utf-8",
            errors="replace", stdin=subprocess.DEVNULL, timeout=_SECONDS,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return SelfTest(key=key, problem=f"it did not answer within {_SECONDS:.0f} s", lasting=False)
    except OSError as error:
        return SelfTest(key=key, problem=f"it could not be tested ({error})", lasting=False)
    try:
        answer = cast(dict[str, Any], json.loads(ran.stdout[ran.stdout.index("{") :])["gpu"]["test"])
        checks = [from_dict(Check, row) for row in answer["checks"]]
        return from_dict(SelfTest, {**answer, "key": key, "checks": checks})
    except (ValueError, KeyError, TypeError):
        if ran.returncode == ExitCode.ENVIRONMENT:
            return SelfTest(key=key, problem="it could not be tested", lasting=False)
        last = (ran.stderr.strip().splitlines() or ["no output"])[-1]
        problem = f"the process that tested it ended with code {ran.returncode} ({last})"
        return SelfTest(key=key, problem=problem, lasting=_crashed(ran.returncode))


def _crashed(code: int) -> bool:
    """True for the exit code of a process that crashed, as opposed to one that was killed or exited."""
    if os.name == "nt":
        return code & 0xC0000000 == 0xC0000000 and code & 0xFFFFFFFF != _CTRL_C_EXIT
    return -code in {getattr(signal, name) for name in ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGILL", "SIGFPE")}


# ------------------------------------------------------------------------------------------------------- the checks


def _relative(value: Tensor, truth: Tensor) -> float:
    """Relative L2 error of `value` against `truth`; `_NO_NUMBER` if it is not finite."""
    value, truth = value.detach().cpu().double(), truth.detach().cpu().double()
    error = float(norm_of_all(value - truth) / norm_of_all(truth).clamp_min(1e-12))
    return min(error, _NO_NUMBER) if error == error else _NO_NUMBER


def _scene() -> dict[str, Tensor]:
    """Gaussians in front of the camera, of various sizes and opacities, with SH of degree 1."""
    g, n = torch.Generator(device="cpu").manual_seed(11), _GAUSSIANS

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, device="cpu")

    means = normal(n, 3) * torch.tensor([1.3, 1.0, 0.7], device="cpu") + torch.tensor([0.0, 0.0, 4.0], device="cpu")
    return {
        "means": means, "quats": normal(n, 4), "log_scales": 0.5 * normal(n, 3) - 2.3,
        "opacity_logits": 2.0 * normal(n), "sh": 0.4 * normal(n, 4, 3),
    }  # fmt: skip


def _camera(device: torch.device) -> dict[str, Any]:
    """Camera of the test scene, as arguments of `rasterize`."""
    K = torch.tensor([[[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]], device="cpu")
    return {"viewmats": torch.eye(4, device=device)[None], "Ks": K.to(device)}


def _rendered(device: torch.device, backend: str) -> tuple[RasterOutput, dict[str, Tensor]]:
    """Render of the test scene, and gradients of a weighted sum of its colours and depths by all inputs."""
    leaves: dict[str, Any] = {name: value.to(device).requires_grad_() for name, value in _scene().items()}
    out = rasterize(
        **leaves, **_camera(device), width=_WIDTH, height=_HEIGHT,
        background=torch.full((3,), 0.5, device=device), backend=backend, with_depth=True, with_contributions=True,
        settings=RasterSettings(threads=1),
    )  # fmt: skip
    weights = torch.randn(out.colors.shape, generator=torch.Generator(device="cpu").manual_seed(3), device="cpu")
    if out.depth_expected is None:
        raise RuntimeError("the frame was rendered without depth")
    total = (out.colors * weights.to(device)).sum() + out.depth_expected.clamp_max(10.0).sum() / 64.0
    backward(total)
    return out, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _frame(device: torch.device) -> list[Check]:
    """Compares projection, tiling and blending, forward and backward."""
    truth, true_gradients = _rendered(torch.device("cpu"), "cpu")
    seen, gradients = _rendered(device, "cuda")
    errors = (seen.colors.detach().cpu() - truth.colors.detach()).abs().amax(-1)
    flipped = float((~(errors <= _PIXEL)).float().mean())  # counts NaN as different
    checks = [Check("a frame", flipped, _FLIPPED)]
    checks += [
        Check(f"the gradient of {name}", _relative(gradients[name], value), _GRADIENT)
        for name, value in true_gradients.items()
    ]
    return checks


def _loss(device: torch.device) -> list[Check]:
    """Compares SSIM, the photometric loss and their gradients."""
    g = torch.Generator(device="cpu").manual_seed(4)
    image, target = torch.rand(2, 40, 56, 3, generator=g, device="cpu")
    ignored = torch.rand(40, 56, generator=g, device="cpu") > 0.9

    def compared(name: str, bodies: tuple[Callable[..., Tensor], Callable[..., Tensor]], *more: Any) -> list[Check]:
        found: list[tuple[Tensor, Tensor]] = []
        for run_device, body in zip((torch.device("cpu"), device), bodies, strict=True):
            leaf = image.to(run_device, copy=True).requires_grad_()
            inputs = [value.to(run_device) if isinstance(value, Tensor) else value for value in more]
            value = body(leaf, target.to(run_device), *inputs)
            backward(value)
            found.append((value, _gradient(leaf)))
        (value, gradient), (device_value, device_gradient) = found
        return [
            Check(name, _relative(device_value, value), _EXACT),
            Check(f"the gradient of {name}", _relative(device_gradient, gradient), _EXACT),
        ]

    checks = compared("SSIM", (ssim.ssim, ssim_cuda.ssim))
    return [*checks, *compared("the loss", (photometric, ssim_cuda.photometric), 0.2, ignored)]


def _adam(device: torch.device) -> list[Check]:
    """Compares two Adam steps with an `lr_unit_distance`, on rows at different distances."""
    g = torch.Generator(device="cpu").manual_seed(5)
    start, *gradients = torch.randn(3, 5000, 3, generator=g, device="cpu")
    found: list[Tensor] = []
    for run_device, kernel in ((torch.device("cpu"), False), (device, True)):
        parameter = torch.nn.Parameter(start.to(run_device, copy=True))
        optimizer = FusedAdam([{"params": [parameter], "lr_unit_distance": 2.0}], lr=0.1, kernel=kernel)
        for gradient in gradients:
            parameter.grad = gradient.to(run_device)
            optimizer.step()
        found.append(parameter.detach().cpu() - start)
    return [Check("a step of Adam", _relative(found[1], found[0]), _EXACT)]


def _recording(device: torch.device) -> list[Check]:
    """Compares three Adam steps on a render: one launched and two replayed, against three launched."""
    start = {name: value.to(device) for name, value in _scene().items()}
    camera = _camera(device)
    found: list[Tensor] = []
    for records in (False, True):
        leaves: dict[str, Any] = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
        optimizer = FusedAdam(list(leaves.values()), lr=1e-2)

        def step(leaves: dict[str, Any] = leaves, optimizer: FusedAdam = optimizer) -> Tensor:
            total = rasterize(**leaves, **camera, width=_WIDTH, height=_HEIGHT, backend="cuda").colors.square().sum()
            optimizer.zero_grad(set_to_none=True)
            backward(total)
            optimizer.step(guard=[total])
            return total.detach()

        step()
        if records:
            optimizer.zero_grad(set_to_none=True)
            with optimizer.recording(device) as table:
                replay, _ = CudaGraphs(device).record(step)
            for _ in range(2):
                optimizer.send(table)
                replay()
        else:
            step()
            step()
        found.append(torch.cat([(leaves[name] - value).flatten() for name, value in start.items()]))
    return [Check("a recorded step", _relative(found[1], found[0]), _GRADIENT)]


def _planes(device: torch.device) -> list[Check]:
    """Compares plane features (products of samples), the smoothness penalty and the gradients of both."""
    g = torch.Generator(device="cpu").manual_seed(6)
    sizes = [(9, 11), (9, 7), (11, 7), (5, 9), (5, 11), (5, 7)]
    at = 2.4 * torch.rand(257, 4, generator=g, device="cpu") - 1.2
    samples = [torch.rand(1, planes.LANES, *size, generator=g, device="cpu") + 0.5 for size in sizes]
    pull = torch.randn(len(at), planes.LANES, generator=g, device="cpu")
    found: list[dict[str, Tensor]] = []
    for run_device, body in ((torch.device("cpu"), planes), (device, planes_cuda)):
        leaves = [p.to(run_device).contiguous(memory_format=torch.channels_last).requires_grad_() for p in samples]
        points = at.to(run_device, copy=True).requires_grad_()
        features = body.features(points, leaves)
        backward((features * pull.to(run_device)).sum())
        results = {"the field": features, "the gradient of its points": _gradient(points)}
        results["the gradient of its planes"] = _gradients(leaves)
        for leaf in leaves:
            leaf.grad = None
        value = body.penalty(leaves, [(1.0, 0.5, 0.1)] * 6)
        backward(value)
        found.append({**results, "the field's smoothness": value, "the gradient of its smoothness": _gradients(leaves)})
    truth, seen = found
    return [Check(name, _relative(seen[name], value), _EXACT) for name, value in truth.items()]


def _gradient(leaf: Tensor) -> Tensor:
    if leaf.grad is None:
        raise RuntimeError("a leaf has no gradient")
    return leaf.grad


def _gradients(leaves: list[Tensor]) -> Tensor:
    return torch.cat([_gradient(leaf).flatten() for leaf in leaves])
