"""What each step may be asked for: parameters, and their options in the one table (`option_table`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from .errors import UserError
from .files import frame_number, is_json_object
from .hosts import host_names
from .light_facts import point_text
from .option_table import MASK_FOUND, SWITCH, Limit, Option, ignored_path, limits_of, mask_path, option, overscan

LAST_FRAME = 1_048_574
"""Blender's last frame number: no scene reaches further."""
PRESET_STEPS = {"preview": 2000, "standard": 9000, "final": 30_000}
"""Training steps of each preset."""
PRESET_WIDTHS = {"preview": 320, "standard": 960, "final": 0}
"""Width in pixels of each preset's training images, never above the working frames'; 0: theirs."""
CARD_WIDTH, CARD_GAUSSIANS = 1920, 1_000_000
"""Of `final` on a graphics card: width in pixels of its images, never above the source's, and most Gaussians."""
CAMERA_MODELS = ("SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""What `SolveParams.camera_model` may be."""
ST_MAP_WAYS = ("undistort", "redistort")
"""What `SolveParams.st_map_way` may be."""
HOSTS = host_names()
"""Hosts of the deformation, as their files in deformation/ name themselves."""
METHODS = ("auto", *HOSTS, "static")
"""What `TrainParams.method` may be."""
HOST_CONFIGS = ("default", "reference")
"""What `TrainParams.host_config` may be."""
SUPERVISIONS = ("support", "paper", "none")
"""What `TrainParams.supervision` may be."""
DETECTORS = ("weight", "grad_norm", "grad_signed")
"""What `TrainParams.detector` may be."""
QUERIES = ("nearest", "plain")
"""What `FreezeParams.query` may be."""
MATTE_FORMATS = ("exr", "png")
"""What `MatteParams.matte_format` may be: suffixes of the files."""
DEVICES = ("auto", "cpu", "cuda")
"""Where a run may train and freeze."""

_FRAMES = ((1 << 31) - 1) * 1.0
_PRESET = {0: "the preset's"}
PLACEMENT: dict[str, Any] = {
    "flag": "--placement",
    "metavar": "FILE",
    "is_path": True,
    "help": "JSON that says where the solve stands in the scene for which splats and cameras leave",
    "words": "as Blender wrote it into the shot; without that upright, in solve units",
}
"""The option that freezing and exporting have."""
DEVICE: dict[str, Any] = {
    "flag": "--device",
    "choices": DEVICES,
    "help": "where to train and freeze: `auto` takes an NVIDIA GPU",
}
"""The option that several dataclasses have."""


@dataclass
class ImportParams:
    """Footage into a shot folder."""

    source: str = option(
        "",
        flag="clip",
        is_path=True,
        commands=("import", "freeze"),
        help="video file, image sequence or pattern (shot.####.exr)",
        label="Clip",
        tip="Video file, or one image of a numbered sequence, of people holding still",
    )
    """Video file, image of a sequence, folder of images, or a pattern such as shot.####.exr."""
    first: int | None = option(
        None,
        flag="--first",
        metavar="N",
        help="first frame number of the clip",
        words="its first",
        limit=Limit("first frame", -_FRAMES, _FRAMES),
        label="First",
        tip="First frame number of the clip to import",
    )
    """First frame number of the clip to take; None: the first there is."""
    last: int | None = option(
        None,
        flag="--last",
        metavar="N",
        help="last frame number, inclusive",
        words="its last",
        limit=Limit("last frame", -_FRAMES, _FRAMES),
        label="Last",
        tip="Last frame number to import, inclusive",
    )
    """Last frame number to take, inclusive; None: the last there is."""
    start: int | None = option(
        None,
        flag="--start",
        metavar="N",
        help="number of the first frame in the shot, such as 1001; `--first`, `--last` and the files keep their own "
        "numbers",
        words="the footage's own",
        limit=Limit("number of the shot's first frame", 0, LAST_FRAME),
        label="Start",
        tip="Number of the first frame in the shot, such as 1001. The range above is in the footage's own numbers",
    )
    """Number that the first frame of the range has in the shot; None: the footage's own. All numbers after the import
    are the shot's."""
    step: int = option(
        0,
        flag="--step",
        metavar="N",
        help="solve and train on every n-th frame; all frames are delivered whatever it is",
        words="chosen",
        limit=Limit("step between solved frames", 1, 100_000, {0: "one that is chosen"}),
        label="Solve Every",
        tip="Interval of the frames that are solved and trained on; all frames are delivered. 0: chosen by the clip's "
        "length. Set a smaller one where a solve loses track; 1: every frame",
    )
    """Interval of the frames that are solved and trained on; 0: chosen by the clip's length. All frames are
    delivered."""
    working_height: int = option(
        0,
        flag="--working-height",
        metavar="PX",
        help="height of the working frames",
        words="the source's, at most 720 lines, of portrait footage at most 1280 x 720 pixels",
        limit=Limit("height of the working frames", 16, 16_384, {0: "the source's"}),
    )
    """Height in pixels of the working frames; 0: the source's, at most 720 lines, or as many pixels in portrait."""
    fps: float = option(
        0.0,
        flag="--fps",
        metavar="F",
        help="frames per second of an image sequence",
        words="its files', else 24",
        label="Frame Rate",
        tip="Frames per second of an image sequence; 0: what its files say, else 24. A video has its own",
    )
    """Frames per second of a sequence; 0: the footage's own, 24 for a sequence that says none."""
    layer: str = option(
        "",
        flag="--layer",
        metavar="NAME",
        help="layer or part of an EXR sequence, by its name or the end of it; a video's stream by its number",
        words="the picture itself",
        label="Layer",
        tip="Layer or part of an EXR sequence to freeze, by its name or the end of it; empty: the picture itself",
    )
    """Layer or part of a sequence's pictures to take, by its name or the end of it, or a video's stream by its number;
    empty: the picture itself, the largest stream."""
    colour_space: str = option(
        "",
        flag="--colour-space",
        metavar="NAME",
        help="colour space of the footage, by its name in the OCIO configuration (`$OCIO`, else the built-in ACES "
        "studio configuration)",
        words="what the files say",
        label="Colour Space",
        tip="Colour space of the footage, by its name in the OCIO configuration ($OCIO, else the built-in ACES studio "
        "configuration: ACEScg, ARRI LogC3 (EI800), ADX10, ...); empty: what the files say",
    )
    """Colour space of the footage as the OCIO configuration names it; empty: what the files say."""
    lut: str = option(
        "",
        flag="--lut",
        metavar="FILE.cube",
        is_path=True,
        help="look of the camera, a 1D or 3D `.cube` table that makes sRGB or Rec.709 video of the footage, for logs "
        "that no OCIO configuration has; in place of `--colour-space`",
        words="none",
        label="Look",
        tip="The camera's .cube table, which makes sRGB or Rec.709 video of log footage; in place of a colour space",
    )
    """File of a look (.cube) through which the footage becomes display-referred; empty: none."""
    pixel_aspect: float = option(
        0.0,
        flag="--pixel-aspect",
        metavar="A",
        help="width of the footage's pixels divided by their height",
        words="what the files say, else square",
        limit=Limit("pixel aspect", 0.25, 4.0, {0: "what the files say"}),
        label="Pixel Aspect",
        tip="Width of the footage's pixels divided by their height, 2 for most anamorphic lenses; "
        "0: what the files say",
    )
    """Width of the footage's pixels over their height; 0: what the files say, else 1."""
    matrix: str = option(
        "auto",
        flag="--matrix",
        choices=("auto", "bt709", "bt601", "bt2020"),
        help="YCbCr matrix of a video: `auto` (what the file says, else by its size), `bt709`, `bt601`, `bt2020`",
        label="Matrix",
        tip="How a video's YCbCr becomes RGB: greens and reds are off where it is the wrong one",
        items={
            "auto": (
                "As Tagged",
                "What the file says; where it says nothing, BT.709 from 1280 columns on, else BT.601",
            ),
            "bt709": ("BT.709", "High definition"),
            "bt601": ("BT.601", "Standard definition"),
            "bt2020": ("BT.2020", "Ultra high definition"),
        },
    )
    """YCbCr matrix of a video: auto, bt709, bt601 or bt2020."""
    levels: str = option(
        "auto",
        flag="--levels",
        choices=("auto", "video", "full"),
        help="range of a video's codes: `auto` (what the file says, else video), `video` (16 to 235), "
        "`full` (0 to 255)",
        label="Levels",
        tip="Which codes of a video are black and white: it looks washed out or crushed where they are the wrong ones",
        items={
            "auto": ("As Tagged", "What the file says; where it says nothing, video levels"),
            "video": ("Video", "Black is 16 and white 235 of 255"),
            "full": ("Full", "Black is 0 and white 255"),
        },
    )
    """Range of a video's codes: auto, video or full."""
    replace: bool = option(
        False,
        flag="--replace",
        switch=True,
        help="import other frames into a shot on which work was done: its solve, runs, takes and paint move to "
        "`replaced/` in the shot folder",
        words="refused",
    )
    """Consent to other frames in a shot on which work was done; that work is kept in SHOT/replaced/."""


@dataclass
class SolveParams:
    """Cameras from the working frames."""

    camera_model: str = option(
        "SIMPLE_RADIAL",
        flag="--camera-model",
        choices=CAMERA_MODELS,
        help="lens: `SIMPLE_RADIAL`, `OPENCV` for strong distortion, or `OPENCV_FISHEYE`",
        label="Lens",
        tip="How the lens bends straight lines",
        items={
            "SIMPLE_RADIAL": ("Ordinary", "One coefficient: phones, most cameras"),
            "OPENCV": ("Strong", "Four coefficients: action cameras, very wide lenses"),
            "OPENCV_FISHEYE": ("Fisheye", "A lens that bends straight lines on purpose, up to 150 degrees wide"),
        },
    )
    """COLMAP camera model: SIMPLE_RADIAL, OPENCV (strong or tangential distortion) or OPENCV_FISHEYE."""
    focal_mm: float = option(
        0.0,
        flag="--focal-mm",
        metavar="MM",
        help="focal length that the lens has, for the sensor of `--sensor-mm`; the solve begins with it",
        words="found by the solve",
        limit=Limit("focal length in mm", 1, 5000, {0: "one that the solve finds"}),
        label="Focal Length",
        tip="Focal length of the lens in millimetres, for the sensor below; 0: the solve finds it",
    )
    """Focal length in mm with which the solve begins; 0: it finds it."""
    sensor_mm: float = option(
        36.0,
        flag="--sensor-mm",
        metavar="MM",
        help="width of the part of the sensor that the picture shows, for `--focal-mm`; 36: full frame",
        limit=Limit("width of the sensor in mm", 1, 200),
        label="Sensor Width",
        tip="Width in millimetres of the part of the sensor that the picture shows; 36 is full frame",
    )
    """Width in mm of what the picture shows of the sensor, along its width; for `focal_mm`."""
    refine_focal: bool = option(
        True,
        flag="--hold-focal",
        switch=True,
        help="hold the focal length of `--focal-mm` as it is; else the solve refines it",
        label="Refine",
        tip="Let the solve correct the focal length. Off: it stays as set",
    )
    """Refine `focal_mm`; else it is held."""
    st_map: str = option(
        "",
        flag="--st-map",
        metavar="FILE",
        is_path=True,
        help="ST map of the lens (EXR, red s, green t): the lens is taken from it, whatever `--camera-model` says",
        words="none",
        label="ST Map",
        tip="ST map of the lens, as a lens department hands it over: the footage is undistorted through it before the "
        "solve, and put back through it at the end. EXR of 32 bits, red s, green t; empty: the solve finds the lens",
    )
    """ST map that holds the lens; empty: the solve finds it."""
    st_map_way: str = option(
        "undistort",
        flag="--st-map-way",
        choices=ST_MAP_WAYS,
        help="what `--st-map` does: `undistort` (a map of the undistorted picture: it takes the lens out of a plate), "
        "`redistort` (a map of the original: it puts the lens back into a render)",
        label="Map",
        tip="Direction of the ST map, which its file does not state",
        items={
            "undistort": ("Undistorts", "It takes the lens out of a plate: each of its pixels looks into the original"),
            "redistort": ("Redistorts", "It puts the lens back into a render: its pixels look into undistorted ones"),
        },
    )
    """One of `ST_MAP_WAYS`."""
    st_map_layer: str = option(
        "",
        flag="--st-map-layer",
        metavar="NAME",
        help="layer of `--st-map` that holds it",
        words="its red and green",
        label="Map Layer",
        tip="Layer of the ST map's file that holds it, by its name or the end of it; empty: its red and green",
    )
    """Layer of the map's file; empty: red and green."""
    retry: bool = option(
        True,
        flag="--no-retry",
        switch=True,
        help="stop at the first solve, even where it is poor; else more features, more pairs, another lens model and "
        "a global mapper are tried, each where it can help",
        label="Try Again",
        tip="Where a solve fails or is poor, try again: with more features, more pairs of frames, another lens model, "
        "a global mapper. Each retry is reported, and what cannot help is skipped",
    )
    """Try again in other ways where the solve fails or is poor."""
    ignore_mask: str = option(
        MASK_FOUND,
        flag="--ignore-mask",
        metavar="MASK",
        parse=ignored_path,
        help="what is not part of the scene (a logo, dirt, the crew), white: a picture for all frames, a sequence, a "
        "video, `alpha`: where the footage is transparent, `found`: what the import found to be burnt in, or `none`",
        label="Ignore",
        tip="Mask of what is not part of the scene, white: a logo, dirt, the hands of the crew. It is not matched, not "
        "learnt and not used to fill. One picture for all frames, a picture of a sequence, or a video",
    )
    """Mask of what is ignored, in white: a picture, a sequence, a video, `MASK_ALPHA` or `MASK_FOUND`. Empty: none."""
    people_mask: str = option(
        "",
        flag="--people-mask",
        metavar="MASK",
        parse=mask_path,
        help="the only places where something may move, white: as `--ignore-mask`; `alpha`: where the footage is "
        "opaque",
        words="everywhere",
        label="People",
        tip="Mask of what may move, white: the camera is solved from the rest, and everything outside stands still. "
        "One picture for all frames, a picture of a sequence, or a video",
    )
    """Mask (white) of the only regions that may move; the solve finds no features in them. Empty: everything may
    move."""
    overlap: int = option(15, limit=Limit("number of following frames that are matched", 1, 31))
    """Number of distances at which each solved frame is matched: 1, 2, 4, ... frames after it."""
    cameras: str = option(
        "",
        flag="--cameras",
        metavar="PATH",
        is_path=True,
        commands=("solve",),
        help="use these cameras instead of solving: a COLMAP folder, a transforms.json or a camera path; in Blender's "
        "command line an Alembic, FBX or USD file, too",
        label="Cameras",
        tip="Folder of a COLMAP model or one of its files, a transforms.json, or a camera path. "
        "Pictures are matched to the clip's frames by the number in their names",
    )
    """Cameras to take instead of solving: a COLMAP model's folder, a nerfstudio transforms.json, or a CameraPath.
    Pictures are matched to frames by number. Empty: solve."""


@dataclass
class TrainParams:
    """One run of the trainer."""

    run: str = option(
        "main",
        flag="--run",
        metavar="NAME",
        help="name of the run",
        label="Run",
        tip="Name of the training run; a new name keeps the old",
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
            "preview": ("Preview", "320 pixels wide, 2000 steps: to see whether the shot holds, minutes on a laptop"),
            "standard": ("Standard", "960 pixels wide, 9000 steps: for what moves, and what no plate shows"),
            "final": (
                "Final",
                "As wide as the working frames, 30000 steps, most Gaussians: takes longest. On a graphics card as "
                "wide as the source, up to 1920 pixels, with up to a million Gaussians",
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
    """auto (the host behind the gate), static, or a host whose field moves all: hexplane, mlp, control_points."""
    host: str = option(
        "hexplane",
        flag="--host",
        choices=HOSTS,
        help="motion model that `--method auto` uses",
        heeded_with=("method", ("auto",)),
    )
    """Which host `auto` puts behind the gate."""
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
        help="what anchors Gaussians at times at which no frame shows them: `support` (ours), `paper` (the paper's "
        "rule), `none`",
    )
    """support, paper or none: which anchoring losses hold ill-supervised Gaussians."""
    detector: str = option(
        "grad_norm",
        flag="--detector",
        choices=DETECTORS,
        help="with `--supervision paper`, how defective Gaussians are detected: `grad_norm` (the paper), `grad_signed` "
        "(the published code), `weight`",
        heeded_with=("supervision", ("paper",)),
    )
    """`paper`, who is ill-supervised: weight, grad_norm, or grad_signed (the published code's signed sum)."""
    iterations: int = option(
        0,
        flag="--iterations",
        metavar="N",
        help="training steps",
        words="the preset's",
        limit=Limit("number of training steps (iterations)", 10, 10_000_000, _PRESET),
    )
    """Training steps; 0: the preset's."""
    width: int = option(
        0,
        flag="--width",
        metavar="PX",
        help="width of the training images",
        words="the preset's",
        limit=Limit("width of the training images", 16, 16_384, _PRESET),
    )
    """Width in pixels of the training images; 0: the preset's."""
    max_gaussians: int = option(
        0,
        flag="--max-gaussians",
        metavar="N",
        help="budget of Gaussians",
        words="the preset's",
        limit=Limit("budget of Gaussians", 100, 20_000_000, _PRESET),
    )
    """Budget of Gaussians; 0: the preset's."""
    holdout: int = option(
        -1,
        flag="--holdout",
        metavar="N",
        help="keep every n-th frame out of training to measure on; 0: none",
        words="`preview` 8, others none",
        limit=Limit("distance between held-out frames", 2, 1_000_000, {0: "none", -1: "the preset's"}),
    )
    """Every how many frames one is kept out for testing; 0: none, -1: the preset's choice."""
    seed: int = option(0, flag="--seed", metavar="N", help="random seed", limit=Limit("random seed", 0, (1 << 53) - 1))
    """Random seed."""
    depth: str = option(
        "",
        flag="--depth",
        metavar="FOLDER",
        is_path=True,
        help="depth maps of the clip's frames, of a phone's sensor or a network: a folder of EXR, 16-bit PNG or TIFF, "
        "numbered as the frames; metric, inverse or relative. They give the depth of what moves",
        words="none",
        label="Depth",
        tip="Depth maps of the clip's frames, of a phone's sensor or a network: a folder of EXR, 16-bit PNG or TIFF, "
        "numbered as the frames. Scale and shift are fitted. They give the depth of movers, in the training and in "
        "frozen frames; empty: none",
    )
    """Depth maps of the frames: a folder, one of its files or a pattern; metric, inverse or relative. Empty: none."""
    resume: bool = option(True, flag="--restart", switch=True, help="do not go on from the run's checkpoint")
    """Go on from the run's checkpoint if there is one."""
    device: str = option("auto", **DEVICE)
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used. A run may go on on another device."""
    extend: int = option(
        0,
        flag="--extend",
        metavar="N",
        commands=("train",),
        help="add N steps to a finished run, which keeps its settings (other flags are ignored)",
        words="none",
        limit=Limit("number of steps to add", 1, 10_000_000, {0: "none"}),
        label="More Steps",
        tip="How many steps Train On adds to a finished run; a third of the preset's at first",
    )
    """Steps to add to a finished run, whose own settings are kept; 0: none."""


@dataclass
class FreezeParams:
    """Frozen frames from a run."""

    run: str = option("main", flag="--run", metavar="NAME", help="name of the run")
    """Run to freeze."""
    take: str = option(
        "freeze",
        flag="--take",
        metavar="NAME",
        help="name of the take",
        label="Take",
        tip="Name of the frozen frames; a new name keeps the old",
    )
    """Name of the take's folder in takes/."""
    t_star: int | None = option(
        None,
        flag="--t-star",
        metavar="N",
        help="frame at which time stands still",
        words="suggested from support and sharpness",
        limit=Limit("t*", -_FRAMES, _FRAMES),
        label="t*",
        tip="Frame number of the clip at which time stands still. Keyed, it is followed frame by frame: "
        "freeze, hold and release",
    )
    """Frame number of the clip at which time stands still; None: suggested from support and sharpness."""
    t_star_per_frame: dict[str, float] = field(
        default_factory=dict[str, float], metadata={"option": Option(limit=Limit("t* of a frame", -_FRAMES, _FRAMES))}
    )
    """Clip frame number -> t* as a frame number, one per output frame: freeze ramps. Overrides `t_star`."""
    first: int | None = option(None, limit=Limit("first frame", -_FRAMES, _FRAMES))
    """First output frame; None: the clip's first."""
    last: int | None = option(None, limit=Limit("last frame", -_FRAMES, _FRAMES))
    """Last output frame, inclusive; None: the clip's last."""
    step: int = option(1, limit=Limit("step between frozen frames", 1, 1_000_000))
    """Every how many frames, from `first`, one is rendered. Frames of the take that were rendered before stay."""
    camera_path: str = option(
        "",
        flag="--camera-path",
        metavar="FILE",
        is_path=True,
        help="JSON camera path to render from",
        words="the clip's poses",
    )
    """JSON file of a CameraPath, in solve units, to render from; empty: the clip's own poses."""
    query: str = option(
        "nearest",
        flag="--freeze-query",
        choices=QUERIES,
        help="`nearest`: each Gaussian at its nearest supported time; `plain`: at t* itself",
    )
    """nearest: each Gaussian is asked at its nearest supported time to t*; plain: at t* itself."""
    width: int = option(
        0,
        flag="--freeze-width",
        metavar="PX",
        help="width of the frozen frames",
        words="the source's own",
        limit=Limit("width of the frozen frames", 16, 16_384, {0: "the source's"}),
        label="Width",
        tip="Width in pixels of the frozen frames; 0: the source's own, or as the scene renders from a camera "
        "of your own",
    )
    """Width in pixels of the frozen frames; 0: the source's own."""
    detail: str = option(
        "on",
        flag="--detail",
        choices=SWITCH,
        help="`on`: frozen frames are made of the plates, where they can be believed; `off`: of the splats alone",
        label="Detail",
        tip="Make frozen frames of the plates, where they can be believed: as sharp as the plate. "
        "Off: of the splats alone, soft throughout",
    )
    """on: frozen frames are made of the plates, where they can be believed; off: of the splats alone."""
    develop: str = option(
        "on",
        flag="--develop",
        choices=SWITCH,
        help="`on`: before it is rendered, the scene at t* is trained on as a still one, once for each t*, which "
        "brings back what the run lost; motion that makes other frames worse is held still. `off`: as the run has it",
        label="Develop",
        tip="Train the frozen instant on as the still scene that it is, before it is rendered: what moves is "
        "there as the plate at t* shows it, and what stands still is sharper. Takes up to a few minutes, once for each "
        "t*. Off: the instant as the training left it",
    )
    """on: the instant is trained on as the still scene that it is, and kept with the run; off: it stays as the run has
    it. Of keyed instants, six at most."""
    overscan: float = option(
        0.0,
        flag="--overscan",
        metavar="PERCENT",
        parse=overscan,
        help="picture beyond the frame on every side, or `lens`: as much as the way back through the lens needs",
        limit=Limit("overscan in percent", 0, 100, {-1: "what the lens needs"}),
    )
    """Picture beyond the frame on every side, in percent of its width and height; -1: what the way back through the
    lens needs. `width` is that of the frame without it."""
    placement: str = option("", **PLACEMENT)
    """JSON file of a `Placement`, by which frozen.ply and frozen.usdc leave; empty: the shot's own, else upright."""
    only_missing: bool = option(False, always=True)
    """Keep frames of the take that are already rendered from the same run, t* and camera."""
    grain: bool = option(
        True, flag="--no-grain", switch=True, help="leave the plate's grain out of the files: a third smaller"
    )
    """Write the plate's grain, measured and drawn anew for every frame, as a layer of its own beside the picture."""
    passes: bool = option(
        False,
        flag="--passes",
        switch=True,
        help="motion vectors, normals and positions as layers of the frames",
        label="Passes",
        tip="Write motion vectors of the camera's move (Blender's Vector layout), normals and positions as further "
        "layers of the frames, in the scene's axes and units",
    )
    """Write the layers of `FRAME_LAYERS` whose part is passes."""
    deep: bool = option(
        False,
        flag="--deep",
        switch=True,
        help="also a deep EXR for each frame, for Nuke, Fusion and Houdini: two samples where two surfaces meet in a "
        "pixel",
        label="Deep EXR",
        tip="Write a deep EXR beside each frame, with two samples where two surfaces meet in a pixel, for deep "
        "compositing in Nuke, Fusion or Houdini. Blender reads none. Not with Motion Blur",
    )
    """Write takes/NAME/deep/NNNNNN.exr: the frame as deep samples in the scene's units."""
    shutter: float = option(
        0.0,
        flag="--shutter",
        metavar="DEGREES",
        help="motion blur by the move of a camera path of your own: degrees of 360 that the shutter is open, as a film "
        "camera's 180; a frame takes as many times as long as its blur is pixels long, 33 times at most",
        limit=Limit("shutter in degrees", 0, 360),
    )
    """Motion blur by the move of `camera_path`, degrees of 360 that the shutter is open around each frame; 0: none."""
    debug_terms: str = option(
        "",
        flag="--debug-terms",
        metavar="DIR",
        is_path=True,
        words="not written",
        help="for developers: write what decided where each pixel comes from into DIR, an EXR of named channels for "
        "each frame; every frame is rendered anew",
    )
    """Folder for the terms behind each frame's decisions (`torch_backend/freeze/take/debug_terms.py`); empty: none."""
    device: str = option("auto", **DEVICE)
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used."""


@dataclass
class MatteParams:
    """Mattes of things in a take, each lassoed at one frame."""

    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take's folder in takes/."""
    polygons: str = option(
        "",
        flag="--polygons",
        metavar="FILE",
        is_path=True,
        help='JSON with the lassos: {"mattes": [{"name": NAME, "frame": N, "polygon": [[x, y], ...]}]}, in pixels '
        "of the frozen frames from the top left corner; lassos of one name add up",
        words="those of the take's mattes",
    )
    """JSON file of lassos; empty: the previous ones. An earlier matte keeps its lassos unless the file has its name."""
    remove: str = option("", flag="--remove", metavar="NAME", help="name of a matte to remove", words="none")
    """Matte that is removed; empty: none."""
    matte_format: str = option(
        "exr",
        flag="--matte-format",
        choices=MATTE_FORMATS,
        help="files of the single mattes: `exr` (half floats) or `png` (16 bits)",
    )
    """Files of the single mattes: exr or png."""
    device: str = option("auto", **{**DEVICE, "help": "where to render: `auto` takes an NVIDIA GPU"})
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used."""


LIVE_SOURCE = "live"
"""In `CombineParams.things`, in place of a take: the clip's own plates."""


@dataclass
class CombineParams:
    """One take made of several: each thing under a matte from a take of its own."""

    take: str = option("combined", flag="--take", metavar="NAME", help="name of the take that is made")
    """Name of the new take's folder in takes/."""
    base: str = option("freeze", flag="--base", metavar="TAKE", help="take that shows everything else")
    """Name of the take that everything else comes from."""
    things: str = option(
        "",
        flag="--things",
        metavar="MATTE=TAKE,...",
        help="which thing comes from which take; both takes must have the matte. `MATTE=live`: it goes on living, as "
        "the clip has it",
        words="none",
    )
    """Pairs of matte and take, separated by commas; `LIVE_SOURCE` in place of a take: the clip itself."""


@dataclass
class SurfaceParams:
    """The frozen scene of a take as a mesh."""

    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take's folder in takes/."""


@dataclass
class LightParams:
    """The light of a take's frozen scene at a point, as a panorama."""

    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take's folder in takes/."""
    position: str = option(
        "0,0,0",
        flag="--position",
        metavar="X,Y,Z",
        parse=point_text,
        help="point that the light falls on, in the axes and units of Blender's scene; with an equals sign where it "
        "begins with a minus: `--position=-1,2,0.5`",
    )
    """Three numbers, separated by commas: the point, in the axes and units of Blender's scene."""
    placement: str = option(
        "",
        **{
            **PLACEMENT,
            "help": "JSON that says where the solve stands in the scene whose axes and units `--position` has",
        },
    )
    """JSON file of a `Placement`; empty: the shot's own, else upright, in solve units."""


STEP_PARAMS: dict[str, type] = {
    "import": ImportParams,
    "solve": SolveParams,
    "train": TrainParams,
    "freeze": FreezeParams,
}
"""Kind of job on the way from a clip to frozen frames -> the dataclass of its parameters."""
PARAMS: dict[str, type] = {
    **STEP_PARAMS,
    "mattes": MatteParams,
    "combine": CombineParams,
    "surface": SurfaceParams,
    "light": LightParams,
}
"""Kind of job -> the dataclass of its parameters."""
LIMITS: dict[type, dict[str, Limit]] = {cls: limits_of(cls) for cls in PARAMS.values()}
"""The numbers of each kind of parameters, by field."""


def check_params(params: object) -> None:
    """ValueError, in a sentence, names the first number of a job's parameters that is out of its `LIMITS`."""
    for name, limit in LIMITS.get(type(params), {}).items():
        chosen = getattr(params, name)
        values: Iterable[Any] = chosen.values() if is_json_object(chosen) else (chosen,)
        for value in values:
            if value is None or value in limit.also or limit.low <= value <= limit.high:  # NaN is none of them
                continue
            also = "".join(f", or {value} for {meaning}" for value, meaning in limit.also.items())
            message = f"The {limit.what} is {value}: it should be {_plain(limit.low)} to {_plain(limit.high)}{also}."
            raise UserError(message)
    odd = [key for key in getattr(params, "t_star_per_frame", {}) if frame_number(key) is None]
    if odd:
        raise UserError(f"t* is given for frame {odd[0]!r}: it should be the number of a frame.")


def _plain(number: float) -> str:
    """A limit as one says it: 0.25, 4, 1000000."""
    return f"{number:.0f}" if float(number).is_integer() else f"{number:g}"
