"""What each step may be asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

LAST_FRAME = 1_048_574
"""Blender's last frame number: no scene reaches further."""


@dataclass
class ImportParams:
    """Footage into a shot folder."""

    source: str = ""
    """Video file, image of a sequence, folder of images, or a pattern such as shot.####.exr."""
    first: int | None = None
    """First frame number of the clip to take; None: the first there is."""
    last: int | None = None
    """Last frame number to take, inclusive; None: the last there is."""
    step: int = 0
    """Every how many frames are solved and trained on; 0 chooses. All frames are delivered whatever it is."""
    working_height: int = 0
    """Height in pixels of the working frames; 0: the source's, at most 720."""
    fps: float = 0.0
    """Frames per second of a sequence; 0: the footage's own, 24 for a sequence that says none."""
    layer: str = ""
    """Layer or part of a sequence's pictures to take, by its name or the end of it; empty: the picture itself."""


@dataclass
class SolveParams:
    """Cameras from the working frames."""

    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model: SIMPLE_RADIAL or OPENCV (strong or tangential distortion)."""
    overlap: int = 15
    """Each solved frame is matched with this many following ones (and with quadratically spaced ones beyond)."""
    cameras: str = ""
    """Cameras to take instead of solving: a COLMAP model's folder, a nerfstudio transforms.json, or a CameraPath.
    Pictures are matched to frames by number. Empty: solve."""


@dataclass
class TrainParams:
    """One run of the trainer."""

    run: str = "main"
    """Name of the run's folder in runs/."""
    preset: str = "preview"
    """preview, standard or final."""
    method: str = "auto"
    """auto (the host behind the gate), static, or a host whose field moves all: hexplane, mlp, control_points."""
    host: str = "hexplane"
    """Which host `auto` puts behind the gate."""
    host_config: str = "default"
    """default (ours) or reference (the published sizes, rates and schedules, as shares of the run)."""
    supervision: str = "support"
    """support, paper or none: which anchoring losses hold ill-supervised Gaussians."""
    detector: str = "grad_norm"
    """`paper`, who is ill-supervised: weight, grad_norm, or grad_signed (the published code's signed sum)."""
    iterations: int = 0
    """Training steps; 0: the preset's."""
    width: int = 0
    """Width in pixels of the training images; 0: the preset's."""
    max_gaussians: int = 0
    """Budget of Gaussians; 0: the preset's."""
    holdout: int = -1
    """Every how many frames one is kept out for testing; 0: none, -1: the preset's choice."""
    seed: int = 0
    """Random seed."""
    resume: bool = True
    """Go on from the run's checkpoint if there is one."""
    device: str = "auto"
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used. A run may go on on another device."""
    extend: int = 0
    """Steps to add to a finished run, whose own settings are kept; 0: none."""


PRESET_STEPS = {"preview": 2000, "standard": 9000, "final": 30_000}
"""Training steps of each preset."""
PRESET_WIDTHS = {"preview": 320, "standard": 640, "final": 1280}
"""Width in pixels of each preset's training images, never above the working frames'."""
HOSTS = ("control_points", "hexplane", "mlp")
"""Hosts of the deformation, as their files in deformation/ name themselves."""
METHODS = ("auto", *HOSTS, "static")
"""What `TrainParams.method` may be."""
HOST_CONFIGS = ("default", "reference")
"""What `TrainParams.host_config` may be."""
SUPERVISIONS = ("support", "paper", "none")
"""What `TrainParams.supervision` may be."""
DETECTORS = ("weight", "grad_norm", "grad_signed")
"""What `TrainParams.detector` may be."""


@dataclass
class FreezeParams:
    """Frozen frames from a run."""

    run: str = "main"
    """Run to freeze."""
    take: str = "freeze"
    """Name of the take's folder in takes/."""
    t_star: int | None = None
    """Frame number of the clip at which time stands still; None: suggested from support and sharpness."""
    t_star_per_frame: dict[str, float] = field(default_factory=dict)
    """Clip frame number -> t* as a frame number, one per output frame: freeze ramps. Overrides `t_star`."""
    first: int | None = None
    """First output frame; None: the clip's first."""
    last: int | None = None
    """Last output frame, inclusive; None: the clip's last."""
    step: int = 1
    """Every how many frames, from `first`, one is rendered. Frames of the take that were rendered before stay."""
    camera_path: str = ""
    """JSON file of a CameraPath, in solve units, to render from; empty: the clip's own poses."""
    query: str = "nearest"
    """nearest: each Gaussian is asked at its nearest supported time to t*; plain: at t* itself."""
    width: int = 0
    """Width in pixels of the frozen frames; 0: the source's own."""
    detail: str = "on"
    """on: frozen frames are made of the plates, where they can be believed; off: of the splats alone."""
    develop: str = "on"
    """on: the instant is trained on as the still scene that it is, and kept with the run; off: it stays as the run has
    it. Of keyed instants, six at most."""
    overscan: float = 0.0
    """Picture beyond the frame on every side, in percent of its width and height; -1: what the way back through the
    lens needs. `width` is that of the frame without it."""
    only_missing: bool = False
    """Keep frames of the take that are already rendered from the same run, t* and camera."""
    grain: bool = True
    """Write the plate's grain, measured and drawn anew for every frame, as a layer of its own beside the picture."""
    device: str = "auto"
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used."""


def overscan(text: str) -> float:
    """`FreezeParams.overscan` as a command line gives it: 0 to 100 percent, or "lens" (-1). ValueError on else."""
    try:
        value = -1.0 if text == "lens" else float(text)
    except ValueError:
        value = math.nan
    if text != "lens" and not 0.0 <= value <= 100.0:
        raise ValueError(f"overscan is 0 to 100 percent, or lens, got {text!r}")
    return value


SWITCH = ("on", "off")
"""What `FreezeParams.detail` and `FreezeParams.develop` may be."""
DEVICES = ("auto", "cpu", "cuda")
"""Where a run may train and freeze."""
PARAMS: dict[str, type] = {
    "import": ImportParams,
    "solve": SolveParams,
    "train": TrainParams,
    "freeze": FreezeParams,
}
"""Kind of job -> the dataclass of its parameters."""


@dataclass(frozen=True)
class Limit:
    """What a number among a job's parameters may be."""

    what: str
    """What a sentence calls it."""
    low: float
    """Least."""
    high: float
    """Most."""
    also: Mapping[int, str] = field(default_factory=dict)
    """Values outside of that which have a meaning -> what they are for."""


_FRAMES = ((1 << 31) - 1) * 1.0
_PRESET = {0: "the preset's"}
LIMITS: dict[type, dict[str, Limit]] = {
    ImportParams: {
        "first": Limit("first frame", -_FRAMES, _FRAMES),
        "last": Limit("last frame", -_FRAMES, _FRAMES),
        "step": Limit("step between solved frames", 1, 100_000, {0: "one that is chosen"}),
        "working_height": Limit("height of the working frames", 16, 16_384, {0: "the source's"}),
    },
    SolveParams: {"overlap": Limit("number of following frames that are matched", 1, 1000)},
    TrainParams: {
        "iterations": Limit("number of training steps (iterations)", 10, 10_000_000, _PRESET),
        "width": Limit("width of the training images", 16, 16_384, _PRESET),
        "max_gaussians": Limit("budget of Gaussians", 100, 20_000_000, _PRESET),
        "holdout": Limit("distance between held-out frames", 2, 1_000_000, {0: "none", -1: "the preset's"}),
        "seed": Limit("random seed", 0, (1 << 53) - 1),
        "extend": Limit("number of steps to add", 1, 10_000_000, {0: "none"}),
    },
    FreezeParams: {
        "t_star": Limit("t*", -_FRAMES, _FRAMES),
        "t_star_per_frame": Limit("t* of a frame", -_FRAMES, _FRAMES),
        "first": Limit("first frame", -_FRAMES, _FRAMES),
        "last": Limit("last frame", -_FRAMES, _FRAMES),
        "step": Limit("step between frozen frames", 1, 1_000_000),
        "width": Limit("width of the frozen frames", 16, 16_384, {0: "the source's"}),
        "overscan": Limit("overscan in percent", 0, 100, {-1: "what the lens needs"}),
    },
}
"""The numbers of each kind of parameters, by field."""


def check_params(params: Any) -> None:
    """ValueError, in a sentence, names the first number of a job's parameters that is out of its `LIMITS`."""
    for name, limit in LIMITS.get(type(params), {}).items():
        given = getattr(params, name)
        values = given.values() if isinstance(given, dict) else (given,)
        for value in values:
            if value is None or value in limit.also or limit.low <= value <= limit.high:  # NaN is none of them
                continue
            also = "".join(f", or {value} for {meaning}" for value, meaning in limit.also.items())
            message = f"The {limit.what} is {value}: it should be {limit.low:.0f} to {limit.high:.0f}{also}."
            raise ValueError(message)
    odd = [key for key in getattr(params, "t_star_per_frame", {}) if not key.lstrip("-").isdecimal()]
    if odd:
        raise ValueError(f"t* is given for frame {odd[0]!r}: it should be the number of a frame.")
