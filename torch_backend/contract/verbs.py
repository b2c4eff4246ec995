"""Verbs of both command lines, the backend's and Blender's, which have the same verb for the same work.

import, solve, train and freeze are the steps; only Blender has bake. `command_line` makes both parsers from this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .option_choices import DEVICE, PLACEMENT
from .option_table import option
from .options import STEP_PARAMS, ImportParams, SolveParams
from .take_options import CombineParams, FreezeParams, LightParams, MatteParams, SurfaceParams
from .train_options import TrainParams

BACKEND, BLENDER = "backend", "Blender"
"""The sides that have a command line."""


@dataclass
class NoWords:
    """No arguments besides those of jobs."""


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
    """The shot to create."""

    shot: str = option("", flag="shot", help="shot folder; created if it does not exist")
    """Shot folder."""


@dataclass
class WholeWords:
    """Where to write the results of all steps from a clip."""

    output: str = option("output", flag="--output", metavar="DIR", help="output folder")
    """Folder for the shot and summary.json."""
    shot_name: str = option("shot", flag="--shot-name", metavar="NAME", help="name of the shot folder inside it")
    """Name of the shot folder in `output`."""
    blend: str = option("", flag="--blend", side=BLENDER, help=".blend to insert the freeze into", words="a new scene")
    """.blend to insert the freeze into; empty: a new scene."""


@dataclass
class BakeWords:
    """A take to render through the compositor."""

    shot: str = option("", flag="--shot", required=True, help="shot folder")
    """Shot folder."""
    take: str = option("freeze", flag="--take", metavar="NAME", help="name of the take")
    """Name of the take."""
    output: str = option("", flag="--output", metavar="DIR", required=True, help="output folder")
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
    """Interval of the frames to bake; 0: the scene's step."""
    device: str = option(
        "auto", **{**DEVICE, "help": "device to freeze missing frames on: `auto` uses an NVIDIA GPU if there is one"}
    )
    """Device on which missing frames of the take are frozen."""
    blend: str = option("", flag="--blend", help=".blend to insert the freeze into", words="a new scene")
    """.blend to insert the freeze into; empty: a new scene."""
    part: str = option(
        "all",
        flag="--part",
        choices=("all", "frames", "file"),
        help="`all`; with several computers at once, first `frames` (only the pictures, each renamed into place when "
        "complete), then `file` once (only shot.blend and summary.json)",
    )
    """all; frames: only the pictures; file: only shot.blend and summary.json."""
    as_warp: bool = option(
        False,
        flag="--as-warp",
        switch=True,
        help="freeze the plate of the .blend with the take's warp, instead of showing the take's frames",
    )
    """Freeze the plate that the .blend shows with the take's warp."""


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
    """A shot's cameras and splats for other programs."""

    shot: str = option("", flag="shot", help="shot folder")
    """Shot folder."""
    format: str = option(
        "colmap",
        flag="--format",
        choices=("colmap", "nerfstudio", "chan", "nk", "ply", "usd"),
        help="`colmap`, `nerfstudio`: the solve; `chan`, `nk`: the animated camera for Nuke; `ply`: the splats of a "
        "take; `usd`: the splats and the animated camera",
    )
    """colmap, nerfstudio, chan or nk: cameras; ply: the splats of a take; usd: both."""
    take: str = option(
        "freeze",
        flag="--take",
        metavar="NAME",
        help="take whose splats are written",
        effective_with=("format", ("ply", "usd")),
    )
    """Name of the take."""
    placement: str = option("", **PLACEMENT)
    """JSON file of a `Placement`; empty: the shot's, else upright. colmap and nerfstudio exports are transformed only
    if a file is named."""
    text: bool = option(
        False,
        flag="--text",
        switch=True,
        help="a COLMAP model as .txt instead of .bin",
        effective_with=("format", ("colmap",)),
    )
    """Write a COLMAP model as text."""
    output: str = option("", flag="--output", metavar="DIR", required=True, help="folder to write into")
    """Folder to write into."""


@dataclass
class DoctorWords:
    """Extent of the check."""

    gpu: bool = option(
        False,
        flag="--gpu",
        switch=True,
        help="test the graphics card again: compare a small frame and its gradients with the processor's",
    )
    """Test the graphics card again."""


@dataclass
class LiveWords:
    """A live session."""

    shot: str = option("", flag="shot", help="shot folder")
    """Shot folder."""
    run: str = option("main", flag="--run", metavar="NAME", help="name of the run")
    """Name of the run."""
    device: str = option("auto", **{**DEVICE, "help": "device to render on: `auto` uses an NVIDIA GPU if there is one"})
    """Device to draw on."""


@dataclass
class FarmWords:
    """Shots for a render farm."""

    action: str = option("export", flag="action", choices=("export", "measure"), help="`export` or `measure`")
    """export: write a job for a farm. measure: write rates from the records of a farm's tasks in the shots."""
    shots: tuple[str, ...] = option(
        "",
        flag="shots",
        many=True,
        is_path=True,
        metavar="SHOT",
        help="shot folders, or clips whose shots are created on the farm",
    )
    """Shot folders, or clips."""
    output: str = option(
        "", flag="--output", is_path=True, metavar="DIR", required=True, help="folder for the job's files"
    )
    """Folder for template.json and parameters.json, or for the rates.json of `measure`."""
    t_star: str | None = option(
        None,
        flag="--t-star",
        metavar="N,N",
        help="frames at which time stands still; each becomes a separate take",
        words="one frame, chosen by how many movers it shows and how sharp it is",
    )
    """Instants of every shot, separated by commas; None: one suggested instant."""
    t_star_list: str = option(
        "",
        flag="--t-star-list",
        is_path=True,
        metavar="FILE",
        help="text file with a line for each shot: its name and its instants",
        words="the same for all",
    )
    """File with a line per shot: NAME N N N."""
    frames: int = option(10, flag="--frames", metavar="N", help="frames per task of freeze and bake")
    """Frames of one task."""
    bake: bool = option(
        False, flag="--bake", switch=True, help="through Blender's compositor, too: OUTPUT_FOLDER/SHOT/TAKE/composited"
    )
    """Bake each take."""
    shots_folder: str = option(
        "",
        flag="--shots-folder",
        is_path=True,
        metavar="DIR",
        help="folder for the shots of clips",
        words="next to each clip",
    )
    """Folder for the shots of clips; empty: next to each clip."""
    shots_per_job: int = option(15, flag="--shots-per-job", metavar="N", help="maximum number of shots in one template")
    """Largest number of shots in one template. Farms limit the length of a template."""
    request: str = option(
        "",
        flag="--request",
        is_path=True,
        metavar="FILE",
        help="parameters of the steps as JSON, {step: {name: value}}, instead of options",
        words="the options",
    )
    """JSON file of parameters, which override the options."""
    rates: str = option(
        "",
        flag="--rates",
        is_path=True,
        metavar="FILE",
        help="rates.json of `farm measure`, to estimate with",
        words="ours",
    )
    """File of measured rates for the estimate."""
    session_tasks: int = option(
        0,
        flag="--session-tasks",
        metavar="N",
        help="for the estimate: tasks of a step that a host runs before it enters the job's environment again",
        words="all that it does of one",
    )
    """Tasks per session of the farm's engine; 0: all tasks of a step that a host does."""


@dataclass
class TaskWords:
    """One task of a farm's job."""

    step: str = option(
        "",
        flag="step",
        choices=("import", "solve", "train", "open", "freeze", "finish", "bake", "deliver"),
        help="what to do",
    )
    """Step of the template."""
    shot: str = option("", flag="--shot", metavar="SHOT", required=True, help="shot folder")
    """Shot folder on this computer."""
    request: str = option("", flag="--request", metavar="FILE", required=True, help="what the template asks for")
    """JSON: parameters of the steps, and names of the takes."""
    paths: tuple[str, ...] = option("", flag="--paths", metavar="STEP.NAME=PATH", many=True, help="paths of parameters")
    """Paths of parameters on this computer, each as STEP.NAME=PATH."""
    t_star: str = option("", flag="--t-star", metavar="N", help="instant of the take", words="suggested")
    """Instant of the take."""
    first: int = option(0, flag="--first", metavar="N", help="first frame of the part")
    """First frame of the part."""
    frames: int = option(0, flag="--frames", metavar="N", help="frames of the part", words="the whole take")
    """Number of frames in the part; 0: the whole take."""
    output: str = option("", flag="--output", metavar="DIR", help="folder for what is baked")
    """Folder for baked files."""
    path_rules: str = option("", flag="--path-rules", metavar="FILE", help="the engine's path mapping rules")
    """File of the engine's path mapping rules."""


@dataclass(frozen=True)
class Verb:
    """A verb of the command lines, and its arguments."""

    help: str
    """Description for --help."""
    words: type = NoWords
    """Dataclass of its arguments besides the parameters of jobs."""
    jobs: Mapping[str, type] = field(default_factory=dict[str, type])
    """Kind of job that it starts -> dataclass of its parameters, in order."""
    sides: tuple[str, ...] = (BACKEND, BLENDER)
    """Sides whose command lines have the verb."""
    json: bool = True
    """True if --json changes what the verb prints."""
    shown: Mapping[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    """Field -> (metavar, help), if the field means more for this verb than for others."""
    now: str = ""
    """New name of a deprecated verb, which the next version removes; empty: not deprecated."""


INPUT = (
    "INPUT",
    "video file, image sequence or pattern (shot.####.exr); or a shot folder, which only runs the freeze",
)
"""Metavar and help of the input of `freeze`."""
VERBS: dict[str, Verb] = {
    "import": Verb("import footage into a shot folder", NewShotWords, {"import": ImportParams}),
    "solve": Verb("solve the cameras of a shot", ShotWords, {"solve": SolveParams}),
    "train": Verb("train a run of a shot: Gaussians and their motion", ShotWords, {"train": TrainParams}),
    "freeze": Verb(
        "render the frozen frames of a shot; for a clip, run the missing steps first: import, solve, train",
        WholeWords,
        STEP_PARAMS,
        shown={
            "source": INPUT,
            "first": ("N", "first frame number of the clip; for a shot folder, first frame to freeze"),
            "last": ("N", "last frame number, inclusive; for a shot folder, last frame to freeze"),
            "step": (
                "N",
                "solve and train on every n-th frame; all frames are delivered in any case. For a shot folder, "
                "freeze every n-th frame from the first",
            ),
        },
    ),
    "take": Verb("`freeze SHOT`", ShotWords, {"freeze": FreezeParams}, (BACKEND,), now="freeze"),
    "mattes": Verb(
        "make mattes of things in a take, each lassoed at one frame: separate sequences and a Cryptomatte",
        ShotWords,
        {"mattes": MatteParams},
    ),
    "combine": Verb(
        "combine takes: each thing with a matte comes from its own take, or keeps moving",
        ShotWords,
        {"combine": CombineParams},
    ),
    "surface": Verb(
        "write the frozen scene of a take as a mesh that catches shadows and hides what is behind it",
        ShotWords,
        {"surface": SurfaceParams},
    ),
    "light": Verb(
        "write the light of a take's frozen scene at a point, as a panorama for Blender's world",
        ShotWords,
        {"light": LightParams},
    ),
    "bake": Verb(
        "render a take through the compositor: DIR/composited and DIR/shot.blend", BakeWords, sides=(BLENDER,)
    ),
    "stmaps": Verb("write ST maps of the lens, in both directions, into the shot's solve folder", MapWords),
    "export": Verb("export cameras, points and splats of a shot for other programs", ExportWords),
    "status": Verb("list the jobs of a shot", ShotWords),
    "farm": Verb(
        "write a job for a render farm, as Open Job Description, and estimate its cost", FarmWords, STEP_PARAMS
    ),
    "farm-task": Verb("run one task of such a job (started by the farm)", TaskWords, sides=(BACKEND,), json=False),
    "doctor": Verb("print what this environment can do, as JSON", DoctorWords, json=False),
    "run-job": Verb("run the job in a folder (started by Blender)", JobWords, sides=(BACKEND,)),
    "live": Verb(
        "render frozen views on request from standard input (for Blender)", LiveWords, sides=(BACKEND,), json=False
    ),
}
"""Every verb, in the order of --help."""
COMMANDS: dict[str, Mapping[str, type]] = {name: verb.jobs for name, verb in VERBS.items() if verb.jobs}
"""Verb -> kind of job that it starts -> the dataclass of its parameters."""
