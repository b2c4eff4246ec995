"""The rasteriser's public function."""

import torch
from torch import Tensor

from . import cpu, reference
from .constants import SIDE_MAX
from .settings import RasterOutput, RasterSettings, Scene

_BANDS = {1: 0, 4: 1, 9: 2, 16: 3}


def _shape(name: str, value: Tensor, expected: tuple[int | str, ...]) -> None:
    """Raise ValueError unless `value` has the shape `expected`, where a string stands for any size."""
    shape = value.shape
    if len(shape) != len(expected) or any(
        e != s and not isinstance(e, str) for e, s in zip(expected, shape, strict=True)
    ):
        dimensions = ", ".join(str(e) for e in expected)
        raise ValueError(f"{name} must have shape [{dimensions}], not {list(value.shape)}")


def _check_camera(viewmats: Tensor, Ks: Tensor, width: int, height: int, backend: str) -> None:
    """Raise ValueError for invalid cameras. Values on a GPU are not checked for `backend` 'cuda', to avoid a stall."""
    _shape("viewmats", viewmats, ("C", 4, 4))
    _shape("Ks", Ks, (viewmats.shape[0], 3, 3))
    if not 1 <= width <= SIDE_MAX or not 1 <= height <= SIDE_MAX:
        raise ValueError(f"width and height must be 1 to {SIDE_MAX}, not {width} x {height}")
    # Reading values on a GPU would stall it. There, invalid cameras give an empty image.
    on_host = [value for value in (viewmats, Ks) if backend != "cuda" or not value.is_cuda]
    if not all(bool(torch.isfinite(value).all()) for value in on_host):
        raise ValueError("viewmats and Ks must be finite")
    if any(value is Ks for value in on_host) and not bool((Ks[:, [0, 1], [0, 1]] > 0).all()):
        raise ValueError("Ks must have positive focal lengths")


def _check_scene(scene: Scene) -> None:
    """Raise ValueError for invalid Gaussians or settings."""
    _shape("means", scene.means, ("N", 3))
    n = scene.means.shape[0]
    _shape("quats", scene.quats, (n, 4))
    _shape("log_scales", scene.log_scales, (n, 3))
    _shape("opacity_logits", scene.opacity_logits, (n,))
    if scene.colors is None and scene.sh is None:
        raise ValueError("give colors [N, D], sh [N, K, 3], or both")
    if scene.colors is not None:
        _shape("colors", scene.colors, (n, "D"))
    if scene.sh is not None:
        _shape("sh", scene.sh, (n, "K", 3))
    if scene.background is not None:
        _shape("background", scene.background, (scene.channels,))
    if not scene.settings.near > 0:
        raise ValueError(f"settings.near must be positive, not {scene.settings.near}")
    if scene.settings.threads < 1:
        raise ValueError(f"settings.threads must be at least 1, not {scene.settings.threads}")


def _sh_degree(sh: Tensor | None, rest: Tensor | None, degree: int | None) -> int:
    """Degree to evaluate: `degree`, or if None the full degree of `sh` [N, K, 3] or of `sh` [N, 1, 3] with `rest`
    [N, K - 1, 3]. Raises ValueError for invalid shapes or degrees."""
    if sh is None:
        if rest is not None:
            raise ValueError("sh_rest is given without sh")
        return 0
    bands = sh.shape[1] if sh.dim() == 3 else 0
    if rest is not None:
        _shape("sh", sh, ("N", 1, 3))
        _shape("sh_rest", rest, (sh.shape[0], "K - 1", 3))
        bands += rest.shape[1]
    highest = _BANDS.get(bands)
    if highest is None:
        shapes = list(sh.shape) if rest is None else f"{list(sh.shape)} and {list(rest.shape)}"
        raise ValueError(f"sh must have shape [N, K, 3] with K = 1, 4, 9 or 16, not {shapes}")
    if degree is None:
        return highest
    if not 0 <= degree <= highest:
        raise ValueError(f"sh_degree is {degree}, but sh holds degrees 0 to {highest}")
    return degree


def _resolved(backend: str, means: Tensor) -> str:
    """Name of the backend to run: 'cpu', 'cuda' or 'reference'."""
    if backend not in ("auto", "cpu", "cuda", "reference"):
        raise ValueError(f"backend must be 'auto', 'cpu', 'cuda' or 'reference', not {backend!r}")
    device = means.device.type
    if backend == "reference":
        return backend
    if device not in ("cpu", "cuda") or (device == "cuda" and torch.version.hip is not None):
        raise NotImplementedError(
            f"there is no rasteriser for {'AMD GPU' if device == 'cuda' else device} tensors yet: move the tensors to "
            "the CPU, or pass backend='reference', which is slow"
        )
    if backend == "cpu" and device == "cuda":
        raise ValueError("backend='cpu' needs tensors on the CPU: move them there, or pass backend='auto'")
    return device if backend == "auto" else backend


def _run(backend: str, scene: Scene) -> RasterOutput:
    """Run a backend on a scene."""
    if backend == "reference":
        return reference.rasterize(scene)
    if backend == "cuda":
        from . import cuda  # only when needed, because the import of Warp is slow

        return cuda.rasterize(scene)
    return cpu.rasterize(scene)


def rasterize(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    colors: Tensor | None = None,
    sh: Tensor | None = None,
    *,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    settings: RasterSettings | None = None,
    backend: str = "auto",
    with_depth: bool = False,
    with_contributions: bool = False,
    with_top: bool = False,
    sh_degree: int | None = None,
    sh_rest: Tensor | None = None,
) -> RasterOutput:
    """Splat N Gaussians into C pinhole views.

    Gaussians: means [N, 3] world; quats [N, 4] wxyz of any non-zero norm; log_scales [N, 3] natural logs of world
    units; opacity_logits [N]; colors [N, D] with any channels, and/or sh [N, K, 3], K = (degree + 1)^2, degree 0 to 3.
    Colour of `sh`: the harmonics in the direction from camera to mean, plus 0.5, floored at 0, without ceiling. A
    gradient passes the floor if descending it would raise the colour. With both, the output has the 3 channels of `sh`
    first, then those of `colors`. `sh_degree` limits the degree. If degree 0 is a separate tensor, for example for an
    optimiser with two rates, pass sh [N, 1, 3] and sh_rest [N, K - 1, 3]: the CPU backend then copies neither.

    Cameras: viewmats [C, 4, 4] world to camera, OpenCV axes; Ks [C, 3, 3] px, pixel centres at +0.5, no skew.
    background is [D], or None for black. `with_depth`, `with_contributions` (weight_sum, weight_max) and `with_top`
    (top_ids, top_weights: mattes) request outputs that cost extra.

    Returns a RasterOutput; its attributes give shapes and units. Gradients flow from colors, alphas and depth_expected
    to means, quats, log_scales, opacity_logits, colors, sh, sh_rest, viewmats and background. `constants.py` states the
    rules of culling and blending; NaN and infinite Gaussians are culled and get zero gradients.

    backend: 'cpu' (float32, compiled), 'cuda' (float32, compiled, NVIDIA; CPU tensors run the same kernels on fibers:
    very slow, for tests), 'reference' (torch, the inputs' float type and device, slow). 'auto' selects by the device of
    `means`, to which all inputs are moved. A call on a GPU does not synchronise with the host if viewmats and Ks are
    also on the GPU, and it can be captured as a CUDA graph with its backward pass (see `cuda.py`). Cameras on the GPU
    are therefore not checked; non-finite values or non-positive focal lengths give an empty image.

    Raises ValueError for invalid arguments, NotImplementedError for a device without a backend, RuntimeError if Warp
    cannot use the GPU.

    Source: Kerbl et al. 2023, "3D Gaussian Splatting"; Zwicker et al. 2001, "EWA Volume Splatting"; opacity
    compensation: Yu et al. 2024, "Mip-Splatting"; |gradient|: Ye et al. 2024, "AbsGS".
    """
    backend = _resolved(backend, means)
    _check_camera(viewmats, Ks, width, height, backend)
    degree = _sh_degree(sh, sh_rest, sh_degree)
    if sh is not None and sh_rest is not None and (backend != "cpu" or not sh_rest.shape[1]):
        sh, sh_rest = torch.cat([sh, sh_rest[:, : (degree + 1) ** 2 - 1]], dim=1), None
    dtype = means.dtype if backend == "reference" else torch.float32

    def ready(value: Tensor) -> Tensor:
        return value.to(device=means.device, dtype=dtype).contiguous()

    scene = Scene(
        means=ready(means),
        quats=ready(quats),
        log_scales=ready(log_scales),
        opacity_logits=ready(opacity_logits),
        colors=None if colors is None else ready(colors),
        sh=None if sh is None else ready(sh),
        viewmats=ready(viewmats),
        Ks=ready(Ks.detach()) if backend == "cuda" else Ks.detach().to("cpu", torch.float64),
        background=None if background is None else ready(background),
        width=width,
        height=height,
        sh_degree=degree,
        settings=settings or RasterSettings(),
        with_depth=with_depth,
        with_contributions=with_contributions,
        with_top=with_top,
        sh_rest=None if sh_rest is None else ready(sh_rest),
    )
    _check_scene(scene)
    return _run(backend, scene)
