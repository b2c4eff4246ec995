"""The masks of a solve: where nothing is matched, and what of them stays, undistorted as the frames are.

SHOT/solve/ignore/NNNNNN.png and SHOT/solve/people/NNNNNN.png, grey, of the working frames' size, white is covered.
`ignore` is no part of the scene: not matched, not learnt, no plate to fill from. `people` is what alone may move: not
matched, and still outside.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..contract import LONGEST_PICTURE, MASK_KINDS, PICTURE, ExitCode, JobError, frame_file, open_regular, read_json
from ..contract.files import is_json_object
from ..footage.masks import Mask
from ..lens.undistort import Undistorter
from ..shot import Shot, make_folder, write_atomic

IGNORE, PEOPLE = MASK_KINDS
MARGIN = 3.0
"""Pixels of a picture 640 wide by which nothing is matched around a mask: a feature looks at what is around it."""
_RIM = 8.0
"""Pixels of a picture 640 wide around what is ignored in which nothing is said to move."""
_INPAINT_PX = 3.0
_MOST_FEATURES = 3.0
"""Factor on the number of features of a mostly masked picture: masked features count until they are dropped."""

_WIDE_SHARE = 0.25
"""Masked share of the picture from which on more frames are matched with each other than their neighbours: what is left
shows too little for the few pairs of a clip's usual overlap to hold it together. At 70 % of a ray-cast room a solve by
those was off by 6 degrees at 0.5 px, and called good; with all pairs 0.14 degrees."""


def write_matching(
    masks: dict[str, Mask], names: dict[int, str], folder: Path, undistort: Undistorter | None = None
) -> None:
    """Writes COLMAP's masks: NAME.png of each picture, black where it finds no features; `names` by frame.

    `undistort`: what took the lens out of the pictures that are matched; None: they are as they were filmed.
    """
    make_folder(folder)
    for frame, name in names.items():
        covered = np.logical_or.reduce([mask.of(frame) for mask in masks.values()])
        if undistort is not None:
            white = np.where(covered, np.uint8(255), np.uint8(0))
            covered = undistort(np.repeat(white[..., None], 3, axis=2))[..., 0] > 127
        free = _wider(covered, MARGIN) == 0
        write_grey(folder / f"{name}.png", np.where(free, np.uint8(255), np.uint8(0)))


def more_features(masks: dict[str, Mask]) -> float:
    """How many times as many features to ask for, so that as many are left outside of the masks."""
    return min(_MOST_FEATURES, 1.0 / max(1.0 - _covered(masks), 1e-3))


def wants_wide(masks: dict[str, Mask]) -> bool:
    """True if so much is masked that frames have to be matched with more than their neighbours."""
    return _covered(masks) >= _WIDE_SHARE


def _covered(masks: dict[str, Mask]) -> float:
    """Share of the picture that they cover, where they do not overlap."""
    return sum(mask.share for mask in masks.values())


def write_undistorted(masks: dict[str, Mask], frame: int, undistort: Undistorter, solve: Path) -> None:
    """Writes a frame's masks below a folder that stands for the shot's solve/, by the frames' own map."""
    width, height = next(iter(masks.values())).size
    planes = np.zeros((height, width, 3), np.uint8)
    for plane, kind in enumerate(MASK_KINDS):
        if kind in masks:
            planes[..., plane] = np.where(masks[kind].of(frame), 255, 0)
    planes = undistort(planes)
    for plane, kind in enumerate(MASK_KINDS):
        if kind in masks:
            make_folder(solve / kind)
            write_grey(solve / kind / frame_file(frame, PICTURE), planes[..., plane])


def write_grey(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Writes [H, W] uint8 as a grey PNG, whole or not at all."""
    packed, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 4])
    if not packed:
        raise OSError(f"the matte {path} cannot be packed as PNG")
    write_atomic(path, data.tobytes())


def facts_of(masks: dict[str, Mask], sources: dict[str, str]) -> dict[str, Any]:
    """What solve.json keeps of them."""
    return {
        kind: {"source": sources[kind], "key": mask.key, "share": round(mask.share, 4)} for kind, mask in masks.items()
    }


def given_masks(shot: Shot) -> dict[str, dict[str, Any]]:
    """Kind -> `facts_of` of the masks that the shot was solved with; {} if with none, or if that cannot be read."""
    try:
        facts = read_json(shot.solve_record).get("masks")
    except (OSError, ValueError):
        return {}
    if not is_json_object(facts):
        return {}
    return {kind: facts[kind] for kind in MASK_KINDS if is_json_object(facts.get(kind))}


def masks_key(shot: Shot, *kinds: str) -> list[Any]:
    """Changes with the masks of the solve, of these kinds, or of all; empty if there are none."""
    return [[kind, facts.get("key")] for kind, facts in given_masks(shot).items() if not kinds or kind in kinds]


def load_mask(shot: Shot, kind: str, frame: int) -> NDArray[np.bool_] | None:
    """Masked pixels of an undistorted frame, bool [H, W] of the working frames; None if the shot has no such mask.

    JobError (SOLVE) if the file of a mask that it has is missing or damaged.
    """
    if kind not in given_masks(shot):
        return None
    path = shot.mask(kind, frame)
    try:
        with open_regular(path, LONGEST_PICTURE) as handle:
            pixels = cv2.imdecode(np.frombuffer(handle.read(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error) as error:
        raise _damaged(path) from error
    if pixels is None:
        raise _damaged(path)
    return np.asarray(pixels) > 127


def painted_over(pixels: NDArray[np.uint8], ignored: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture [H, W, 3] with what is ignored, bool [H, W], and its rim taken over by what is around: flow would carry
    a logo's own rest into its surroundings."""
    return np.asarray(cv2.inpaint(pixels, _wider(ignored, MARGIN), _INPAINT_PX, cv2.INPAINT_TELEA), np.uint8)


def limited(labels: NDArray[np.uint8], ignored: NDArray[np.bool_] | None, people: NDArray[np.bool_] | None) -> None:
    """Makes still, 0, of a motion matte [H, W] what no mask lets move, in place; around what is ignored, too: what is
    hidden there at other times looks as if it moved."""
    if ignored is not None:
        labels[_wider(ignored, _RIM) > 0] = 0
    if people is not None:
        labels[~people] = 0


def _wider(covered: NDArray[np.bool_], by: float) -> NDArray[np.uint8]:
    """[H, W] 1 where something is covered within `by` pixels of a picture 640 wide, else 0."""
    reach = round(by * covered.shape[1] / 640)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(covered.astype(np.uint8), around), np.uint8)


def _damaged(path: Path) -> JobError:
    return JobError(f"The mask {path} is damaged or missing.", "Solve the camera again.", ExitCode.SOLVE)
