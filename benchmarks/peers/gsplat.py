"""gsplat (Apache-2.0) as a peer, through its public function. Install it with `pip install gsplat`."""

import importlib
import importlib.util

import torch

from benchmarks.workload import Workload

from . import Prepared

NAME = "gsplat"


def missing(device: str) -> str | None:
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed: `pip install gsplat` (it compiles with nvcc at first use)."
    if device != "cuda" or not torch.cuda.is_available():
        return "gsplat runs on CUDA only: use --device cuda on a machine with an NVIDIA GPU."
    return None


def prepare(work: Workload, device: str) -> Prepared:
    rasterization = importlib.import_module("gsplat").rasterization

    def put(array) -> torch.Tensor:
        return torch.tensor(array, device=device)

    leaves = {
        "means": put(work.means),
        "quats": put(work.quats),
        "log_scales": put(work.scales).log(),
        "opacity_logits": torch.logit(put(work.opacities)),
        "colors": put(work.colors),
        "viewmats": put(work.viewmat[None]),
    }
    for leaf in leaves.values():
        leaf.requires_grad_()
    Ks = put(work.K[None])

    def forward() -> torch.Tensor:
        images, _, _ = rasterization(
            leaves["means"],
            leaves["quats"],
            leaves["log_scales"].exp(),
            leaves["opacity_logits"].sigmoid(),
            leaves["colors"],
            leaves["viewmats"],
            Ks,
            work.width,
            work.height,
            near_plane=0.01,
            eps2d=0.3,
            packed=False,
            absgrad=True,
        )
        return images[0]

    return Prepared(forward, leaves)
