"""The verbs of the two command lines: the backend's and Blender's have the same words for the same work.

import, solve, train and freeze are the steps, bake is Blender's own. `command_line` makes both parsers of this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .option_table import option
from .options import DEVICE, PARAMS, FreezeParams, ImportParams, SolveParams, TrainParams

BACKEND, BLENDER = "backend", "Blender"
"""The sides that have a command line."""


@dataclass
class NoWords:
    """Asks for nothing of its own."""


@dataclass
class JobWords:
    """The job to run."""

    folder: str = option("", flag="folder", help="folder of the job")
    """Folder of the job."""


@dataclass
class ShotWords:
    """The shot to work on."""

    shot: str = option("", flag="shot", help="shot folder")
    """Shot folder."""


@dataclass
class NewShotWords:
    """The shot to begin."""

    shot: str = option("", flag="shot", help="shot folder, made if it is not there")
    """Shot folder."""


@dataclass
class WholeWords:
    """Where the whole way from a clip leaves what comes out."""

    output: str = option("output", flag="--output", metavar="DIR", help="folder for everything that comes out")
    """Folder for the shot and summary.json."""
    shot_name: str = option("shot", flag="--shot-name", metavar="NAME", help="name of the shot folder inside it")
    """Name of the shot folder in `output`."""
    blend: str = option("", flag="--blend", side=BLENDER, help=".blend to insert the freeze into", words="a new scene")
    """.blend to insert the freeze into; empty: a new scene."""


@dataclass
class BakeWords:
    """A take through the compositor."""

    shot: str = option("", flag="--shot", required=True, help="shot folder")
    """Shot folder."""
    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take."""
    output: str = option("", flag="--output", metavar="DIR", required=True, help="folder for what comes out")
    """Folder for composited/, shot.blend and summary.json."""
    first: int | None = option(
        None, flag="--first", metavar="N", help="first frame to bake", words="the take's, or the .blend's range"
    )
    """First frame to bake; None: the scene's."""
    last: int | None = option(
        None,
        flag="--last",
        metavar="N",
        help="last frame to bake, inclusive",
        words="the take's, or the .blend's range",
    )
    """Last frame to bake, inclusive; None: the scene's."""
    step: int = option(0, flag="--step", metavar="N", help="bake every n-th frame", words="the scene's step")
    """Every how many frames one is baked; 0: the scene's step."""
    device: str = option("auto", **{**DEVICE, "help": "where to freeze what is missing: `auto` takes an NVIDIA GPU"})
    """Where frames of the take that are missing are frozen."""
    blend: str = option("", flag="--blend", help=".blend to insert the freeze into", words="a new scene")
    """.blend to insert the freeze into; empty: a new scene."""
    as_warp: bool = option(
        False,
        flag="--as-warp",
        switch=True,
        help="freeze the plate that the .blend shows by the take's warp, instead of showing the take's frames",
    )
    """Freeze the plate that the .blend shows by the take's warp."""


@dataclass
class MapWords:
    """ST maps of a shot's lens."""

    shot: str = option("", flag="shot", help="shot folder")
    """Shot folder."""
    width: int = option(
        0, flag="--width", metavar="PX", help="width of the maps in pixels", words="the working frames'"
    )
    """Width in pixels; 0: the working frames'."""


@dataclass
class ExportWords:
    """A shot's cameras for other programs."""

    shot: str = option("", flag="shot", help="shot folder")
    """Shot folder."""
    format: str = option("colmap", flag="--format", choices=("colmap", "nerfstudio"), help="what to write")
    """colmap or nerfstudio."""
    text: bool = option(
        False,
        flag="--text",
        switch=True,
        help="a COLMAP model as .txt instead of .bin",
        heeded_with=("format", ("colmap",)),
    )
    """A COLMAP model as text."""
    output: str = option("", flag="--output", metavar="DIR", required=True, help="folder to write into")
    """Folder to write into."""


@dataclass
class DoctorWords:
    """How far to look."""

    gpu: bool = option(
        False,
        flag="--gpu",
        switch=True,
        help="test the graphics card anew: a small frame and its gradients against the processor's",
    )
    """Test the graphics card anew."""


@dataclass
class LiveWords:
    """A live session."""

    shot: str = option("", flag="shot", help="shot folder")
    """Shot folder."""
    run: str = option("main", flag="--run", metavar="NAME", help="name of the run")
    """Name of the run."""
    device: str = option("auto", **{**DEVICE, "help": "where to draw: `auto` takes an NVIDIA GPU"})
    """Where to draw."""


@dataclass(frozen=True)
class Verb:
    """A word of the command lines, and what it asks for."""

    help: str
    """What it does."""
    words: type = NoWords
    """Dataclass of what it asks for besides the parameters of jobs."""
    jobs: Mapping[str, type] = field(default_factory=dict[str, type])
    """Kind of job that it starts -> dataclass of its parameters, in their order."""
    sides: tuple[str, ...] = (BACKEND, BLENDER)
    """Which command lines have it."""
    json: bool = True
    """--json changes what it prints."""
    shown: Mapping[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    """Field -> (what --help calls it, what it says of it), where this verb means more by it than others."""
    now: str = ""
    """What it is called now: the word itself goes with the next version."""


INPUT = (
    "INPUT",
    "video file, image sequence or pattern (shot.####.exr); or a shot folder, which is frozen alone",
)
"""What `freeze` is given."""
VERBS: dict[str, Verb] = {
    "import": Verb("footage into a shot folder", NewShotWords, {"import": ImportParams}),
    "solve": Verb("cameras of a shot", ShotWords, {"solve": SolveParams}),
    "train": Verb("a run of a shot: Gaussians, and what of them moves", ShotWords, {"train": TrainParams}),
    "freeze": Verb(
        "frozen frames of a shot; of a clip, all that is missing first: import, solve, train",
        WholeWords,
        PARAMS,
        shown={"source": INPUT},
    ),
    "take": Verb("`freeze SHOT`", ShotWords, {"freeze": FreezeParams}, (BACKEND,), now="freeze"),
    "bake": Verb("a take through the compositor: DIR/composited and DIR/shot.blend", BakeWords, sides=(BLENDER,)),
    "stmaps": Verb("ST maps of the lens, both ways, into the shot's solve folder", MapWords),
    "export": Verb("cameras and points of a solved shot for other programs", ExportWords),
    "status": Verb("jobs of a shot", ShotWords),
    "doctor": Verb("what this environment can do, as JSON", DoctorWords, json=False),
    "run-job": Verb("the job in a folder (what Blender starts)", JobWords, sides=(BACKEND,)),
    "live": Verb(
        "frozen views as they are asked for on standard input (for Blender)", LiveWords, sides=(BACKEND,), json=False
    ),
}
"""Every verb, in the order of --help."""
COMMANDS: dict[str, Mapping[str, type]] = {name: verb.jobs for name, verb in VERBS.items() if verb.jobs}
"""Verb -> kind of job that it starts -> the dataclass of its parameters."""
