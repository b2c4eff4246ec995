"""Whether a lens that a solve found can be one: what is doubted, what is refused, and in which words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import ExitCode, JobError
from .lens import LEAST_DEG, MOST_DEG, NARROWEST_DEG, doubtful, view_deg

FISHEYE = "OPENCV_FISHEYE"
"""COLMAP's model of a lens whose picture grows with the angle: theta (1 + k1 theta^2 + ... + k4 theta^8)."""
FISHEYE_START = 0.45
"""Focal length of a fisheye before any picture was seen, as a share of the picture's width: 127 degrees wide."""
MOST_BEND = 1.0
"""Largest plausible first radial coefficient."""
RUN_OFF = 1.3
"""Times by which a solve may change a focal length that it was given, before the given one is trusted instead."""
WIDE_DEG = 100.0
"""Angle of view from which on a lens solved without a fisheye model may be a fisheye."""
LEFT_SHARE = 0.003
"""How far pictures without its lens may still be bent at the corners, as a share of the diagonal: 2.4 px at 640x480."""
_SAMPLES = 2048
_BEYOND = 2.0
"""How far out of the picture a radial curve is examined, in corners."""


def angle_deg(model: str, width: int, height: int, params: Sequence[float]) -> float:
    """Angle of view in degrees along the longer side of a camera with COLMAP's `params`; 360 if it sees all around."""
    focal = _focal(model, params)
    if model != FISHEYE or not np.isfinite(focal) or focal <= 0:
        return view_deg(width, height, focal)
    angle, at = _fisheye_curve(params)
    reached = np.flatnonzero(at >= 0.5 * max(width, height) / focal)
    return float(np.degrees(2.0 * angle[reached[0]])) if len(reached) else 360.0


def doubt_of(model: str, width: int, height: int, params: Sequence[float], given: float = 0.0) -> str:
    """Why a lens is doubted: as `lens.doubtful`; "off" if its focal length ran off from the one `given`, in pixels."""
    focal = _focal(model, params)
    if given and not given / RUN_OFF <= focal <= given * RUN_OFF:
        return "off"
    bends = bends_of(model, params)
    if model == FISHEYE:
        angle = angle_deg(model, width, height, params)
        found = "narrow" if not angle >= NARROWEST_DEG else "wide" if angle > MOST_DEG else ""
    else:
        found = doubtful(width, height, _focals(model, params), *[*bends, 0.0][:2])
    if found in ("narrow", "wide") and given:  # the artist knows the lens
        found = ""
    return found or ("bent" if impossible(model, width, height, params) else "")


def impossible(model: str, width: int, height: int, params: Sequence[float]) -> str:
    """What of a lens's bend no camera has: "folded", "strong", or "" if it can be."""
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
    if model == FISHEYE and not len(reached):  # the corners of a round picture are black
        side = np.flatnonzero(at >= 0.5 * max(width / fx, height / fy))
        reached = side if len(side) else reached
    return "folded" if not len(reached) or (len(falls) > 0 and falls[0] < reached[0]) else ""


def refuse_lens(answer: dict[str, Any]) -> None:
    """JobError (SOLVE) for a lens that no camera has; `answer` is the worker's."""
    lens = answer["lens"]
    angle = _shown_deg(lens, "view_deg", answer["focal_px"])
    numbers = ", ".join(f"{value:.3g}" for value in answer.get("distortion", []))
    if not LEAST_DEG <= angle <= MOST_DEG and not lens.get("given_px"):
        message = f"The solve found a lens that no camera has: {angle:.1f} degrees wide ({answer['focal_px']:.0f} px)."
    elif lens.get("impossible") == "folded":
        message = (
            f"The solve found a lens that no camera has: it folds the picture over before its corners ({numbers})."
        )
    elif lens.get("impossible") == "strong":
        message = f"The solve found a lens that no camera has: it bends the picture out of all measure ({numbers})."
    else:
        return
    hint = (
        "Choose a longer range, in which the camera travels more; mask what moves by itself, or give the focal length."
    )
    if answer.get("camera_model") != FISHEYE and like_a_fisheye(answer):
        hint = f"Choose Fisheye as the lens (--camera-model {FISHEYE}) if it is one. Else: {hint[0].lower()}{hint[1:]}"
    raise JobError(message, hint, ExitCode.SOLVE)


def like_a_fisheye(answer: dict[str, Any]) -> bool:
    """True if a worker's answer found an ordinary lens as a fisheye would be taken for one: very wide, or bent inwards
    until it folds over."""
    lens = answer["lens"]
    wide = max(lens.get("found_deg", 0.0), lens.get("view_deg", 0.0)) >= WIDE_DEG
    return wide or (lens.get("doubt") == "bent" and lens.get("found_bend", 0.0) < 0)


def lens_remarks(answer: dict[str, Any]) -> list[tuple[str, str]]:
    """(sentence, hint) for a lens that is doubtful, or was put in the place of one that is."""
    left = left_px(answer)
    if left > LEFT_SHARE * np.hypot(answer["lens"]["width"], answer["lens"]["height"]):
        return [
            (
                f"Through the ST map the frames are still bent, by {left:.1f} pixels at their corners.",
                "Is the map of this clip's lens, and the right way round (--st-map-way)?",
            ),
            *_remarks(answer),
        ]
    return _remarks(answer)


def left_px(answer: dict[str, Any]) -> float:
    """How far the corners of frames whose lens was out before the solve are from where the solve would have them."""
    lens, focal = answer["lens"], float(answer["focal_px"])
    corner = float(np.hypot(0.5 * lens["width"], 0.5 * lens["height"])) / focal
    return abs(float(lens.get("left_bend", 0.0))) * corner**3 * focal


def _remarks(answer: dict[str, Any]) -> list[tuple[str, str]]:
    lens = answer["lens"]
    found, used = (_shown_deg(lens, *it) for it in (("found_deg", lens["found_px"]), ("view_deg", answer["focal_px"])))
    given_px = lens.get("given_px")
    if lens["held"] and given_px:
        return [
            (
                f"The solve would have another focal length than was given ({lens['found_px']:.0f} px instead of "
                f"{given_px:.0f}): it was held as given.",
                "Is it for the sensor's width, and was the clip not cropped or stabilised?",
            )
        ]
    if lens["held"]:
        off = "found one that folds the picture over" if lens["doubt"] == "bent" else f"ran off to {found:.0f} degrees"
        if lens.get("start_px"):
            return [
                (
                    f"The clip does not tell its lens (the solve {off}): the one that the file names was taken, "
                    f"{used:.0f} degrees wide.",
                    "Was the clip cropped or stabilised? Then it is narrower.",
                )
            ]
        return [
            (
                f"The clip does not tell its lens (the solve {off}): a usual one of {used:.0f} degrees was taken.",
                "Depth may look stretched; a range in which the camera travels more tells the lens.",
            )
        ]
    if lens["doubt"] == "off":
        return [
            (
                f"The focal length came out as {lens['found_px']:.0f} px, and {given_px:.0f} were given.",
                "Is it for the sensor's width, and was the clip not cropped or stabilised?",
            )
        ]
    if lens["doubt"] == "bent":
        return [
            (
                "The lens that the solve found bends the picture more than lenses do.",
                "Try the other camera model; a range in which the camera travels more tells the lens.",
            )
        ]
    if lens["doubt"]:
        return [
            (
                f"The lens that the solve found is unusual: {used:.0f} degrees wide.",
                "If yours is not, choose a range in which the camera travels more.",
            )
        ]
    return []


def _shown_deg(lens: dict[str, Any], name: str, focal: float) -> float:
    """An angle that the worker told, else that of a pinhole."""
    return float(lens[name]) if name in lens else view_deg(lens["width"], lens["height"], focal)


def _focals(model: str, params: Sequence[float]) -> tuple[float, float]:
    """fx, fy of COLMAP's parameters, pixels."""
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    return (float(params[0]), float(params[0 if single else 1]))


def _focal(model: str, params: Sequence[float]) -> float:
    return 0.5 * sum(_focals(model, params))


def bends_of(model: str, params: Sequence[float]) -> list[float]:
    """Radial coefficients: those of a fisheye all four, of others k1 and, if the model has it, k2."""
    counts = {"SIMPLE_RADIAL": (3, 1), "RADIAL": (3, 2), "OPENCV": (4, 2), FISHEYE: (4, 4)}
    first, count = counts.get(model, (0, 0))
    return [float(value) for value in params[first : first + count]] or [0.0]


def _fisheye_curve(params: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(angles from the axis, how far from the middle each is seen, in focal lengths), to straight behind."""
    angle = np.linspace(0.0, np.pi, _SAMPLES)
    square = angle * angle
    k = params[4:8]
    bent = 1.0 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))
    return angle, angle * bent
