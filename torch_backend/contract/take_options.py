"""Parameters of jobs on a take: frozen frames, mattes, several instants in one take, a surface, and light."""

from __future__ import annotations

from dataclasses import dataclass, field

from .light_facts import point_text
from .option_choices import DEVICE, FRAMES, MATTE_FORMATS, PLACEMENT, QUERIES
from .option_table import SWITCH, Limit, Option, option, overscan


@dataclass
class FreezeParams:
    """Parameters of frozen frames from a run."""

    run: str = option("main", flag="--run", metavar="NAME", help="name of the run")
    """Run to freeze."""
    take: str = option(
        "freeze",
        flag="--take",
        metavar="NAME",
        help="name of the take",
        label="Take",
        tip="Name of the frozen frames; with a new name, earlier ones are kept",
    )
    """Name of the take's folder in takes/."""
    t_star: int | None = option(
        None,
        flag="--t-star",
        metavar="N",
        help="frame at which time stands still",
        words="chosen by how many movers it shows and how sharp it is",
        limit=Limit("t*", -FRAMES, FRAMES),
        label="t*",
        tip="Frame number of the clip at which time stands still. Keyframes are followed frame by frame: freeze, "
        "hold and release",
    )
    """Frame number of the clip at which time stands still; None: the best suggestion (`suggested_instants`)."""
    t_star_per_frame: dict[str, float] = field(
        default_factory=dict[str, float], metadata={"option": Option(limit=Limit("t* of a frame", -FRAMES, FRAMES))}
    )
    """Clip frame number -> t* as a frame number, one per output frame: freeze ramps. Overrides `t_star`."""
    first: int | None = option(None, limit=Limit("first frame", -FRAMES, FRAMES))
    """First output frame; None: the clip's first."""
    last: int | None = option(None, limit=Limit("last frame", -FRAMES, FRAMES))
    """Last output frame, inclusive; None: the clip's last."""
    step: int = option(1, limit=Limit("step between frozen frames", 1, 1_000_000))
    """Interval of the rendered frames, from `first`. Frames that the take already has are kept."""
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
    """nearest: each Gaussian is evaluated at its supported time nearest to t*; plain: at t* itself."""
    width: int = option(
        0,
        flag="--freeze-width",
        metavar="PX",
        help="width of the frozen frames",
        words="the source's own",
        limit=Limit("width of the frozen frames", 16, 16_384, {0: "the source's"}),
        label="Width",
        tip="Width in pixels of the frozen frames; 0: as the source, or with another camera as the scene renders",
    )
    """Width in pixels of the frozen frames; 0: the source's own."""
    detail: str = option(
        "on",
        flag="--detail",
        choices=SWITCH,
        help="`on`: frozen frames use plate pixels where these are reliable; `off`: only splats",
        label="Detail",
        tip="Build frozen frames from plate pixels where these are reliable, as sharp as the plate. Off: from splats "
        "only, softer throughout",
    )
    """on: frozen frames are made of the plates where these are reliable; off: of the splats alone."""
    develop: str = option(
        "on",
        flag="--develop",
        choices=SWITCH,
        help="`on`: before rendering, train the scene at t* as a static one, once for each t*; this recovers what the "
        "run lost, and freezes motion that makes other frames worse. `off`: use the run unchanged",
        label="Develop",
        tip="Train the frozen instant further as a static scene before rendering: movers match the plate at t*, and "
        "static parts are sharper. Takes up to a few minutes, once for each t*. Off: use the training's result "
        "unchanged",
    )
    """on: the instant is trained further as a static scene, and stored with the run; off: it is rendered as the run has
    it. At most six keyed instants are developed."""
    overscan: float = option(
        0.0,
        flag="--overscan",
        metavar="PERCENT",
        parse=overscan,
        help="extra picture on every side, or `lens`: as much as adding the lens distortion back needs",
        limit=Limit("overscan in percent", 0, 100, {-1: "what the lens needs"}),
    )
    """Extra picture beyond the frame on every side, in percent of its width and height; -1: as much as redistortion
    needs. `width` is the width without it."""
    placement: str = option("", **PLACEMENT)
    """JSON file of the `Placement` that transforms frozen.ply and frozen.usdc; empty: the shot's, else upright."""
    only_missing: bool = option(False, always=True)
    """Keep frames of the take that are already rendered from the same run, t* and camera."""
    grain: bool = option(
        True, flag="--no-grain", switch=True, help="leave the plate's grain out of the files: a third smaller"
    )
    """Write grain as a separate layer: measured in the plate, with a new random pattern for every frame."""
    passes: bool = option(
        False,
        flag="--passes",
        switch=True,
        help="motion vectors, normals and positions as additional layers of the frames",
        label="Passes",
        tip="Write motion vectors of the camera move (in Blender's Vector layout), normals and positions as "
        "additional layers of the frames, in the scene's axes and units",
    )
    """Write the layers of `FRAME_LAYERS` whose part is passes."""
    deep: bool = option(
        False,
        flag="--deep",
        switch=True,
        help="also a deep EXR for each frame, for Nuke, Fusion and Houdini: two samples where two surfaces meet in a "
        "pixel",
        label="Deep EXR",
        tip="Write a deep EXR with each frame, with two samples where two surfaces meet in a pixel, for deep "
        "compositing in Nuke, Fusion or Houdini. Blender cannot read deep EXRs. Not with Motion Blur",
    )
    """Write takes/NAME/deep/NNNNNN.exr: the frame as deep samples in the scene's units."""
    shutter: float = option(
        0.0,
        flag="--shutter",
        metavar="DEGREES",
        help="motion blur from the move of your own camera path: shutter angle in degrees, 180 for a typical film "
        "camera; render time grows with the length of the blur in pixels, at most 33 times",
        limit=Limit("shutter in degrees", 0, 360),
    )
    """Motion blur from the motion of `camera_path`: shutter angle in degrees, centred on each frame; 0: none."""
    debug_terms: str = option(
        "",
        flag="--debug-terms",
        metavar="DIR",
        is_path=True,
        words="not written",
        help="for developers: write the data that decided the source of each pixel into DIR, one EXR with named "
        "channels per frame; all frames are rendered again",
    )
    """Folder for the terms behind each frame's decisions (`torch_backend/freeze/take/debug_terms.py`); empty: none."""
    device: str = option("auto", **DEVICE)
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used."""


@dataclass
class MatteParams:
    """Parameters of mattes of things in a take, each lassoed at one frame."""

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
    """JSON file of lassos; empty: the previous lassos. An existing matte keeps its lassos unless the file names it."""
    remove: str = option("", flag="--remove", metavar="NAME", help="name of a matte to remove", words="none")
    """Name of a matte to remove; empty: none."""
    matte_format: str = option(
        "exr",
        flag="--matte-format",
        choices=MATTE_FORMATS,
        help="file format of the separate mattes: `exr` (half floats) or `png` (16 bits)",
    )
    """File format of the single mattes: exr or png."""
    device: str = option("auto", **{**DEVICE, "help": "device to render on: `auto` uses an NVIDIA GPU if there is one"})
    """cpu, cuda, or auto: the NVIDIA GPU if there is one that can be used."""


LIVE_SOURCE = "live"
"""In `CombineParams.things`, in place of a take: the clip's own plates."""


@dataclass
class CombineParams:
    """Parameters of a take combined from several takes: each thing under a matte comes from a chosen take."""

    take: str = option("combined", flag="--take", metavar="NAME", help="name of the new take")
    """Name of the new take's folder in takes/."""
    base: str = option("freeze", flag="--base", metavar="TAKE", help="take that shows everything else")
    """Name of the take that shows everything outside the mattes."""
    things: str = option(
        "",
        flag="--things",
        metavar="MATTE=TAKE,...",
        help="which thing comes from which take; both takes must have the matte. `MATTE=live`: the thing keeps moving "
        "as in the clip",
        words="none",
    )
    """Pairs MATTE=TAKE, separated by commas. `LIVE_SOURCE` in place of a take stands for the clip itself."""


@dataclass
class SurfaceParams:
    """Parameters of the mesh of a take's frozen scene."""

    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take's folder in takes/."""


@dataclass
class LightParams:
    """Parameters of a panorama of the light at a point of a take's frozen scene."""

    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take's folder in takes/."""
    position: str = option(
        "0,0,0",
        flag="--position",
        metavar="X,Y,Z",
        parse=point_text,
        help="point at which to compute the light, in the axes and units of Blender's scene; use an equals sign if it "
        "starts with a minus: `--position=-1,2,0.5`",
    )
    """Three numbers, separated by commas: the point, in the axes and units of Blender's scene."""
    placement: str = option(
        "",
        **{
            **PLACEMENT,
            "help": "JSON with the placement of the solve in the scene that `--position` refers to",
        },
    )
    """JSON file of a `Placement`; empty: the shot's own, else upright, in solve units."""
