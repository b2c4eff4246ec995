"""Parameters of training."""

from __future__ import annotations

from dataclasses import dataclass

from .option_choices import DETECTORS, DEVICE, HOST_CONFIGS, HOSTS, METHODS, PRESET, PRESET_STEPS, SUPERVISIONS
from .option_table import Limit, option


@dataclass
class TrainParams:
    """Parameters of one run of the trainer."""

    run: str = option(
        "main",
        flag="--run",
        metavar="NAME",
        help="name of the run",
        label="Run",
        tip="Name of the training run; with a new name, earlier runs are kept",
    )
    """Name of the run's folder in runs/."""
    preset: str = option(
        "preview",
        flag="--preset",
        choices=tuple(PRESET_STEPS),
        help="`preview`, `standard`, `final`: iterations, size and number of Gaussians",
        label="Preset",
        tip="How much to spend on training",
        items={
            "preview": ("Preview", "320 pixels wide, 2000 steps: a quick check of the shot, minutes on a laptop"),
            "standard": ("Standard", "960 pixels wide, 9000 steps: good for movers and for areas that no plate shows"),
            "final": (
                "Final",
                "As wide as the working frames, 30000 steps, most Gaussians: takes longest. On a graphics card, as "
                "wide as the source up to 1920 pixels, with up to a million Gaussians",
            ),
        },
    )
    """preview, standard or final."""
    method: str = option(
        "auto",
        flag="--method",
        choices=METHODS,
        help="how motion is learnt: `auto` (only where something moves; `--host` says with which model), `static` "
        "(nothing moves), or one model for everything: `hexplane` (4DGaussians), `mlp` (Deformable 3DGS), "
        "`control_points` (SC-GS)",
    )
    """auto (`host`, only where something moves), static, or a host for all Gaussians: hexplane, mlp, control_points."""
    host: str = option(
        "hexplane",
        flag="--host",
        choices=HOSTS,
        help="motion model that `--method auto` uses",
        effective_with=("method", ("auto",)),
    )
    """Host that the method `auto` uses."""
    host_config: str = option(
        "default",
        flag="--host-config",
        choices=HOST_CONFIGS,
        help="the motion model's numbers: `default` (ours), `reference` (published)",
    )
    """default (ours) or reference (the published sizes, rates and schedules, as shares of the run)."""
    supervision: str = option(
        "support",
        flag="--supervision",
        choices=SUPERVISIONS,
        help="how Gaussians are anchored at times when no frame shows them: `support` (ours), `paper` (the paper's "
        "rule), `none`",
    )
    """Which losses anchor ill-supervised Gaussians: support, paper or none."""
    detector: str = option(
        "grad_norm",
        flag="--detector",
        choices=DETECTORS,
        help="with `--supervision paper`, how defective Gaussians are detected: `grad_norm` (the paper), `grad_signed` "
        "(the published code), `weight`",
        effective_with=("supervision", ("paper",)),
    )
    """Detector of ill-supervised Gaussians for `paper`: weight, grad_norm, or grad_signed (the published code's)."""
    iterations: int = option(
        0,
        flag="--iterations",
        metavar="N",
        help="training steps",
        words="the preset's",
        limit=Limit("number of training steps (iterations)", 10, 10_000_000, PRESET),
    )
    """Training steps; 0: the preset's."""
    width: int = option(
        0,
        flag="--width",
        metavar="PX",
        help="width of the training images",
        words="the preset's",
        limit=Limit("width of the training images", 16, 16_384, PRESET),
    )
    """Width in pixels of the training images; 0: the preset's."""
    max_gaussians: int = option(
        0,
        flag="--max-gaussians",
        metavar="N",
        help="budget of Gaussians",
        words="the preset's",
        limit=Limit("budget of Gaussians", 100, 20_000_000, PRESET),
    )
    """Budget of Gaussians; 0: the preset's."""
    holdout: int = option(
        -1,
        flag="--holdout",
        metavar="N",
        help="hold out every n-th frame from the training, to measure quality; 0: none",
        words="`preview` 8, others none",
        limit=Limit("distance between held-out frames", 2, 1_000_000, {0: "none", -1: "the preset's"}),
    )
    """Interval of the frames that are held out for testing; 0: none, -1: the preset's."""
    seed: int = option(0, flag="--seed", metavar="N", help="random seed", limit=Limit("random seed", 0, (1 << 53) - 1))
    """Random seed."""
    depth: str = option(
        "",
        flag="--depth",
        metavar="FOLDER",
        is_path=True,
        help="depth maps of the clip's frames, from a phone's sensor or a network: a folder of EXR, 16-bit PNG or "
        "TIFF, numbered like the frames; metric, inverse or relative. They give the depth of movers",
        words="none",
        label="Depth",
        tip="Depth maps of the clip's frames, from a phone's sensor or a network: a folder of EXR, 16-bit PNG or "
        "TIFF, numbered like the frames. Scale and shift are fitted. They give the depth of movers, in the "
        "training and in frozen frames; empty: none",
    )
    """Depth maps of the frames: a folder, one of its files or a pattern; metric, inverse or relative. Empty: none."""
    resume: bool = option(
        True, flag="--restart", switch=True, help="start from scratch instead of the run's checkpoint"
    )
    """Resume from the run's checkpoint if there is one."""
    device: str = option("auto", **DEVICE)
    """cpu, cuda, or auto: the NVIDIA GPU if there is a usable one. A run may resume on another device."""
    extend: int = option(
        0,
        flag="--extend",
        metavar="N",
        commands=("train",),
        help="add N steps to a finished run, which keeps its settings (other flags are ignored)",
        words="none",
        limit=Limit("number of steps to add", 1, 10_000_000, {0: "none"}),
        label="More Steps",
        tip="How many steps Continue Training adds to a finished run; a third of the preset's by default",
    )
    """Steps to add to a finished run, which keeps its settings; 0: none."""
