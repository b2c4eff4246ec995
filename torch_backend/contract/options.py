"""Parameters of each step, with their options for the table of options (`option_table`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from .errors import UserError
from .files import frame_number, is_json_object
from .option_choices import CAMERA_MODELS, FRAMES, LAST_FRAME, ST_MAP_WAYS
from .option_table import MASK_FOUND, Limit, ignored_path, limits_of, mask_path, option
from .take_options import CombineParams, FreezeParams, LightParams, MatteParams, SurfaceParams
from .train_options import TrainParams


@dataclass
class ImportParams:
    """Parameters of importing footage into a shot folder."""

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
        limit=Limit("first frame", -FRAMES, FRAMES),
        label="First",
        tip="First frame number of the clip to import",
    )
    """First frame number of the clip to import; None: the clip's first."""
    last: int | None = option(
        None,
        flag="--last",
        metavar="N",
        help="last frame number, inclusive",
        words="its last",
        limit=Limit("last frame", -FRAMES, FRAMES),
        label="Last",
        tip="Last frame number to import, inclusive",
    )
    """Last frame number to import, inclusive; None: the clip's last."""
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
    """Number that the first frame of the range has in the shot; None: its number in the footage. After the import, all
    frame numbers are those of the shot."""
    step: int = option(
        0,
        flag="--step",
        metavar="N",
        help="solve and train on every n-th frame; all frames are delivered in any case",
        words="chosen",
        limit=Limit("step between solved frames", 1, 100_000, {0: "an automatic step"}),
        label="Solve Every",
        tip="Interval of the frames that are solved and trained on; all frames are delivered. 0: depends on the "
        "clip's length. Use a smaller interval if the solve loses track; 1: every frame",
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
    """Height in pixels of the working frames; 0: the source's, at most 720 lines, or 1280 x 720 pixels in portrait."""
    fps: float = option(
        0.0,
        flag="--fps",
        metavar="F",
        help="frames per second of an image sequence",
        words="its files', else 24",
        label="Frame Rate",
        tip="Frames per second of an image sequence; 0: what its files say, else 24. A video has its own",
    )
    """Frames per second of a sequence; 0: as its files state, else 24."""
    layer: str = option(
        "",
        flag="--layer",
        metavar="NAME",
        help="layer or part of an EXR sequence, by its name or the end of it; a video's stream by its number",
        words="the picture itself",
        label="Layer",
        tip="Layer or part of an EXR sequence to freeze, by its name or the end of it; empty: the picture itself",
    )
    """Layer or part of an image sequence, by its name or the end of its name; or stream of a video, by its number.
    Empty: the picture itself, the largest stream."""
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
    """Name of the footage's colour space in the OCIO configuration; empty: as the files state."""
    lut: str = option(
        "",
        flag="--lut",
        metavar="FILE.cube",
        is_path=True,
        help="the camera's look, a 1D or 3D `.cube` table that converts the footage to sRGB or Rec.709 video, for log "
        "footage that no OCIO configuration covers; instead of `--colour-space`",
        words="none",
        label="Look",
        tip="The camera's .cube table, which converts log footage to sRGB or Rec.709 video; instead of a colour space",
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
    """Width of the footage's pixels over their height; 0: as the files state, else 1."""
    matrix: str = option(
        "auto",
        flag="--matrix",
        choices=("auto", "bt709", "bt601", "bt2020"),
        help="YCbCr matrix of a video: `auto` (what the file says, else by its size), `bt709`, `bt601`, `bt2020`",
        label="Matrix",
        tip="How a video's YCbCr is converted to RGB. With the wrong matrix, greens and reds look off",
        items={
            "auto": (
                "As Tagged",
                "As the file states; if it does not, BT.709 from 1280 columns on, else BT.601",
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
        tip="Which code values of a video are black and white. With the wrong levels, it looks washed out or crushed",
        items={
            "auto": ("As Tagged", "As the file states; if it does not, video levels"),
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
    """Allow other frames in a shot on which work was done. The work is moved to SHOT/replaced/."""


@dataclass
class SolveParams:
    """Parameters of solving cameras from the working frames."""

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
        help="focal length of the lens, for the sensor of `--sensor-mm`; the solve starts from it",
        words="found by the solve",
        limit=Limit("focal length in mm", 1, 5000, {0: "one that the solve finds"}),
        label="Focal Length",
        tip="Focal length of the lens in millimetres, for the sensor below; 0: the solve finds it",
    )
    """Initial focal length of the solve in mm; 0: the solve estimates it."""
    sensor_mm: float = option(
        36.0,
        flag="--sensor-mm",
        metavar="MM",
        help="width of the part of the sensor that the picture shows, for `--focal-mm`; 36: full frame",
        limit=Limit("width of the sensor in mm", 1, 200),
        label="Sensor Width",
        tip="Width in millimetres of the part of the sensor that the picture shows; 36 is full frame",
    )
    """Width in mm of the part of the sensor that the picture shows, for `focal_mm`."""
    refine_focal: bool = option(
        True,
        flag="--hold-focal",
        switch=True,
        help="keep the focal length of `--focal-mm` fixed; else the solve refines it",
        label="Refine",
        tip="Let the solve correct the focal length. Off: it stays as set",
    )
    """Let the solve refine `focal_mm`; False: it stays fixed."""
    st_map: str = option(
        "",
        flag="--st-map",
        metavar="FILE",
        is_path=True,
        help="ST map of the lens (EXR, red s, green t): it defines the lens, and `--camera-model` is ignored",
        words="none",
        label="ST Map",
        tip="ST map of the lens: the footage is undistorted with it before the solve, and distorted again at the "
        "end. 32-bit EXR, red s, green t; empty: the solve finds the lens",
    )
    """File of an ST map of the lens; empty: the solve estimates the lens."""
    st_map_way: str = option(
        "undistort",
        flag="--st-map-way",
        choices=ST_MAP_WAYS,
        help="what `--st-map` does: `undistort` (a map of the undistorted picture: it takes the lens out of a plate), "
        "`redistort` (a map of the original: it puts the lens back into a render)",
        label="Map",
        tip="Direction of the ST map, which its file does not state",
        items={
            "undistort": (
                "Undistorts",
                "Removes the lens distortion from a plate: each pixel points into the original",
            ),
            "redistort": (
                "Redistorts",
                "Adds the lens distortion to a render: each pixel points into the undistorted picture",
            ),
        },
    )
    """Direction of the ST map, one of `ST_MAP_WAYS`."""
    st_map_layer: str = option(
        "",
        flag="--st-map-layer",
        metavar="NAME",
        help="layer of the `--st-map` file that contains the map",
        words="its red and green",
        label="Map Layer",
        tip="Layer of the ST map's file that contains the map, by its name or the end of it; empty: red and green",
    )
    """Layer of the map's file; empty: its red and green."""
    retry: bool = option(
        True,
        flag="--no-retry",
        switch=True,
        help="stop after the first solve, even if it is poor; else more features, more pairs, another lens model and "
        "a global mapper are tried, each where it can help",
        label="Try Again",
        tip="If a solve fails or is poor, try again with more features, more pairs of frames, another lens model or "
        "a global mapper. Each retry is reported; retries that cannot help are skipped",
    )
    """Try other strategies if the solve fails or is poor."""
    ignore_mask: str = option(
        MASK_FOUND,
        flag="--ignore-mask",
        metavar="MASK",
        parse=ignored_path,
        help="mask of what is not part of the scene (a logo, dirt, the crew), in white: a picture for all frames, a "
        "sequence, a video, `alpha` (where the footage is transparent), `found` (what the import detected as "
        "burnt in) or `none`",
        label="Ignore",
        tip="Mask of what is not part of the scene, in white: a logo, dirt, the hands of the crew. Masked pixels are "
        "not matched, trained on, or used to fill. One picture for all frames, a picture of a sequence, or a video",
    )
    """Mask (white) of regions to ignore: a picture, a sequence, a video, `MASK_ALPHA` or `MASK_FOUND`. Empty: none."""
    people_mask: str = option(
        "",
        flag="--people-mask",
        metavar="MASK",
        parse=mask_path,
        help="mask of the only areas where something may move, in white, as for `--ignore-mask`; `alpha`: where the "
        "footage is opaque",
        words="everywhere",
        label="People",
        tip="Mask of what may move, in white: the camera is solved from the rest, and everything outside is treated "
        "as static. One picture for all frames, a picture of a sequence, or a video",
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
        "command line also an Alembic, FBX or USD file",
        label="Cameras",
        tip="Folder of a COLMAP model or one of its files, a transforms.json, or a camera path. "
        "Pictures are matched to the clip's frames by the number in their names",
    )
    """Cameras to use instead of solving: a COLMAP model's folder, a nerfstudio transforms.json, or a CameraPath.
    Pictures are matched to frames by number. Empty: solve."""


STEP_PARAMS: dict[str, type] = {
    "import": ImportParams,
    "solve": SolveParams,
    "train": TrainParams,
    "freeze": FreezeParams,
}
"""Kind of job, in order from a clip to frozen frames -> the dataclass of its parameters."""
PARAMS: dict[str, type] = {
    **STEP_PARAMS,
    "mattes": MatteParams,
    "combine": CombineParams,
    "surface": SurfaceParams,
    "light": LightParams,
}
"""Kind of job -> the dataclass of its parameters."""
LIMITS: dict[type, dict[str, Limit]] = {cls: limits_of(cls) for cls in PARAMS.values()}
"""Limits of the numbers in each dataclass of parameters, by field."""


def check_params(params: object) -> None:
    """Raises ValueError for the first number among a job's parameters that is outside its `LIMITS`."""
    for name, limit in LIMITS.get(type(params), {}).items():
        chosen = getattr(params, name)
        values: Iterable[Any] = chosen.values() if is_json_object(chosen) else (chosen,)
        for value in values:
            if value is None or value in limit.also or limit.low <= value <= limit.high:  # NaN is refused
                continue
            also = "".join(f", or {value} for {meaning}" for value, meaning in limit.also.items())
            message = f"The {limit.what} is {value}: it should be {_plain(limit.low)} to {_plain(limit.high)}{also}."
            raise UserError(message)
    odd = [key for key in getattr(params, "t_star_per_frame", {}) if frame_number(key) is None]
    if odd:
        raise UserError(f"t* is set for frame {odd[0]!r}, which is not a frame number.")


def _plain(number: float) -> str:
    """Text of a limit: 0.25, 4, 1000000."""
    return f"{number:.0f}" if float(number).is_integer() else f"{number:g}"
