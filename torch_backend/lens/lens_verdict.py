"""Checks the plausibility of a solved lens, and words the warnings and errors about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import ExitCode, JobError
from .lens import LEAST_DEG, MOST_DEG, NARROWEST_DEG, doubtful, view_deg

FISHEYE = "OPENCV_FISHEYE"
"""COLMAP's fisheye model: the image radius is theta (1 + k1 theta^2 + ... + k4 theta^8) for the angle theta."""
FISHEYE_START = 0.45
"""Initial focal length of a fisheye, as a share of the picture's width: 127 degrees wide."""
MOST_BEND = 1.0
"""Largest plausible first radial coefficient."""
MAX_FOCAL_CHANGE = 1.3
"""Largest factor by which a solve may change the artist's focal length. Beyond it, the artist's value is kept."""
WIDE_DEG = 100.0
"""Angle of view above which a lens solved without a fisheye model may be a fisheye."""
LEFT_SHARE = 0.003
"""Tolerated distortion at the corners after undistortion, as a share of the diagonal: 2.4 px at 640x480."""
_SAMPLES = 2048
# Length of the sampled radial curve, as a multiple of the corner's distance from the middle.
_BEYOND = 2.0


def angle_deg(model: str, width: int, height: int, params: Sequence[float]) -> float:
    """Angle of view in degrees along the longer side of a camera with COLMAP's `params`.

    360 if the curve of a fisheye does not reach the side of the picture.
    """
    focal = _focal(model, params)
    if model != FISHEYE or not np.isfinite(focal) or focal <= 0:
        return view_deg(width, height, focal)
    angle, at = _fisheye_curve(params)
    reached = np.flatnonzero(at >= 0.5 * max(width, height) / focal)
    return float(np.degrees(2.0 * angle[reached[0]])) if len(reached) else 360.0


def doubt_of(model: str, width: int, height: int, params: Sequence[float], known_focal: float = 0.0) -> str:
    """Why a lens is implausible: a value of `lens.doubtful`, or "off".

    "off" means that its focal length differs from `known_focal` (pixels) by more than the factor `MAX_FOCAL_CHANGE`.
    """
    focal = _focal(model, params)
    if known_focal and not known_focal / MAX_FOCAL_CHANGE <= focal <= known_focal * MAX_FOCAL_CHANGE:
        return "off"
    bends = bends_of(model, params)
    if model == FISHEYE:
        angle = angle_deg(model, width, height, params)
        found = "narrow" if not angle >= NARROWEST_DEG else "wide" if angle > MOST_DEG else ""
    else:
        found = doubtful(width, height, _focals(model, params), *[*bends, 0.0][:2])
    if found in ("narrow", "wide") and known_focal:  # the artist knows the lens
        found = ""
    return found or ("bent" if impossible(model, width, height, params) else "")


def impossible(model: str, width: int, height: int, params: Sequence[float]) -> str:
    """Why no camera has this distortion: "folded", "strong", or "" if it is possible."""
    bends = [*bends_of(model, params), 0.0]
    if not abs(bends[0]) <= MOST_BEND:
        return "strong"
    fx, fy = _focals(model, params)
    corner = float(np.hypot(0.5 * width / fx, 0.5 * height / fy))
    if model == FISHEYE:
        at = _fisheye_curve(params)[1]
    else:
        ideal = np.linspace(0.0, _BEYOND * corner, _SAMPLES)
        at = ideal * (1.0 + bends[0] * ideal**2 + bends[1] * ideal**4)
    reached = np.flatnonzero(at >= corner)
    falls = np.flatnonzero(np.diff(at) <= 0.0)
    if model == FISHEYE and not len(reached):  # a circular fisheye picture has black corners: test the sides
        side = np.flatnonzero(at >= 0.5 * max(width / fx, height / fy))
        reached = side if len(side) else reached
    return "folded" if not len(reached) or (len(falls) > 0 and falls[0] < reached[0]) else ""


def refuse_lens(answer: dict[str, Any]) -> None:
    """Raises JobError (SOLVE) for an impossible lens. `answer` is the answer of the solve worker."""
    lens = answer["lens"]
    angle = _shown_deg(lens, "view_deg", answer["focal_px"])
    numbers = ", ".join(f"{value:.3g}" for value in answer.get("distortion", []))
    if not LEAST_DEG <= angle <= MOST_DEG and not lens.get("given_px"):
        message = f"The solve found an impossible lens: {angle:.1f} degrees wide ({answer['focal_px']:.0f} px)."
    elif lens.get("impossible") == "folded":
        message = f"The solve found an impossible lens: it folds the picture over before its corners ({numbers})."
    elif lens.get("impossible") == "strong":
        message = f"The solve found an impossible lens: its distortion is far too strong ({numbers})."
    else:
        return
    hint = "Choose a longer range in which the camera travels more, mask what moves, or set the focal length."
    if answer.get("camera_model") != FISHEYE and like_a_fisheye(answer):
        hint = (
            f"If the lens is a fisheye, choose Fisheye (--camera-model {FISHEYE}). Otherwise: "
            f"{hint[0].lower()}{hint[1:]}"
        )
    raise JobError(message, hint, ExitCode.SOLVE)


def like_a_fisheye(answer: dict[str, Any]) -> bool:
    """True if the ordinary lens in a worker's answer looks like a misread fisheye.

    Signs are a very wide angle of view, or implausibly strong barrel distortion.
    """
    lens = answer["lens"]
    wide = max(lens.get("found_deg", 0.0), lens.get("view_deg", 0.0)) >= WIDE_DEG
    return wide or (lens.get("doubt") == "bent" and lens.get("found_bend", 0.0) < 0)


def lens_remarks(answer: dict[str, Any]) -> list[tuple[str, str]]:
    """(sentence, hint) for an implausible lens, or for a default lens that replaced one."""
    left = left_px(answer)
    if left > LEFT_SHARE * np.hypot(answer["lens"]["width"], answer["lens"]["height"]):
        return [
            (
                f"The ST map does not straighten the frames: they are still bent by {left:.1f} pixels at their "
                "corners.",
                "Check that the map is for this clip's lens, and its direction (--st-map-way).",
            ),
            *_remarks(answer),
        ]
    return _remarks(answer)


def left_px(answer: dict[str, Any]) -> float:
    """Remaining distortion in pixels at the corners of frames that were undistorted before the solve."""
    lens, focal = answer["lens"], float(answer["focal_px"])
    corner = float(np.hypot(0.5 * lens["width"], 0.5 * lens["height"])) / focal
    return abs(float(lens.get("left_bend", 0.0))) * corner**3 * focal


def _remarks(answer: dict[str, Any]) -> list[tuple[str, str]]:
    lens = answer["lens"]
    found, used = (_shown_deg(lens, *it) for it in (("found_deg", lens["found_px"]), ("view_deg", answer["focal_px"])))
    known_px = lens.get("given_px")
    if lens["held"] and known_px:
        return [
            (
                f"The solve suggests another focal length ({lens['found_px']:.0f} px instead of {known_px:.0f}), but "
                "it is kept fixed.",
                "Check the sensor width, and whether the clip was cropped or stabilised.",
            )
        ]
    if lens["held"]:
        finding = (
            "found one that folds the picture over" if lens["doubt"] == "bent" else f"diverged to {found:.0f} degrees"
        )
        if lens.get("start_px"):
            return [
                (
                    f"The lens cannot be estimated from this clip (the solve {finding}): the lens stated in the file "
                    f"is used, {used:.0f} degrees wide.",
                    "If the clip was cropped or stabilised, the real lens is narrower.",
                )
            ]
        return [
            (
                f"The lens cannot be estimated from this clip (the solve {finding}): a typical lens of {used:.0f} "
                "degrees is used.",
                "Depth may look stretched. A range in which the camera travels more helps to estimate the lens.",
            )
        ]
    if lens["doubt"] == "off":
        return [
            (
                f"The solved focal length is {lens['found_px']:.0f} px, but {known_px:.0f} px was set.",
                "Check the sensor width, and whether the clip was cropped or stabilised.",
            )
        ]
    if lens["doubt"] == "bent":
        return [
            (
                "The distortion of the solved lens is unusually strong.",
                "Try the other camera model, or a range in which the camera travels more.",
            )
        ]
    if lens["doubt"]:
        return [
            (
                f"The solved lens is unusual: {used:.0f} degrees wide.",
                "If your lens differs, choose a range in which the camera travels more.",
            )
        ]
    return []


def _shown_deg(lens: dict[str, Any], name: str, focal: float) -> float:
    """Angle of view `name` in degrees from the worker's answer; if missing, the angle of a pinhole camera."""
    return float(lens[name]) if name in lens else view_deg(lens["width"], lens["height"], focal)


def _focals(model: str, params: Sequence[float]) -> tuple[float, float]:
    """fx, fy in pixels from COLMAP's parameters."""
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    return (float(params[0]), float(params[0 if single else 1]))


def _focal(model: str, params: Sequence[float]) -> float:
    return 0.5 * sum(_focals(model, params))


def bends_of(model: str, params: Sequence[float]) -> list[float]:
    """Radial coefficients: k1 to k4 of a fisheye; k1 of other models, and k2 if the model has one."""
    counts = {"SIMPLE_RADIAL": (3, 1), "RADIAL": (3, 2), "OPENCV": (4, 2), FISHEYE: (4, 4)}
    first, count = counts.get(model, (0, 0))
    return [float(value) for value in params[first : first + count]] or [0.0]


def _fisheye_curve(params: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(angles from the axis in radians, 0 to pi; image radius of each, in focal lengths)."""
    angle = np.linspace(0.0, np.pi, _SAMPLES)
    square = angle * angle
    k = params[4:8]
    bent = 1.0 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))
    return angle, angle * bent
