"""Masks of a solve: no features are matched inside them, and later steps use them undistorted as the frames are.

Files: SHOT/solve/ignore/NNNNNN.png and SHOT/solve/people/NNNNNN.png, grey, of the working frames' size, white = masked.
`ignore` covers what is not part of the scene: it is not matched, not trained on, and no source of fill pixels.
`people` covers the only things that may move: it is not matched, and everything outside counts as still.
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
# A feature depends on its surroundings.
MARGIN = 3.0
"""Width of the unmatched margin around a mask, in pixels of a picture 640 wide."""
_RIM = 8.0
"""Width of the rim around an ignored region that counts as still, in pixels of a picture 640 wide."""
_INPAINT_PX = 3.0
# Largest factor on the number of features of a masked picture: COLMAP counts masked features before it drops them.
_MOST_FEATURES = 3.0

# Masked share of the picture above which more pairs of frames are matched than the usual overlap. The unmasked rest
# shows too little for those few pairs to hold the clip together. With 70 % of a ray-cast room masked, the usual pairs
# gave cameras 6 degrees off at 0.5 px, rated Good; all pairs gave 0.14 degrees.
_WIDE_SHARE = 0.25


def write_matching(
    masks: dict[str, Mask], names: dict[int, str], folder: Path, undistort: Undistorter | None = None
) -> None:
    """Writes a COLMAP mask NAME.png for each picture, black where COLMAP may find no features.

    `names` maps frame numbers to names of pictures. `undistort` is the map with which the pictures were undistorted
    before matching; None if they were not.
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
    """Factor on the number of features that leaves the requested number outside the masks, at most `_MOST_FEATURES`."""
    return min(_MOST_FEATURES, 1.0 / max(1.0 - _covered(masks), 1e-3))


def needs_wide(masks: dict[str, Mask]) -> bool:
    """True if so much is masked that more pairs of frames must be matched than the usual overlap."""
    return _covered(masks) >= _WIDE_SHARE


def _covered(masks: dict[str, Mask]) -> float:
    """Sum of the masks' shares of the picture: the covered share if the masks do not overlap."""
    return sum(mask.share for mask in masks.values())


def write_undistorted(masks: dict[str, Mask], frame: int, undistort: Undistorter, solve: Path) -> None:
    """Writes a frame's masks, undistorted with the frames' map, below `solve`, the staged solve/ folder of the shot."""
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
    """Facts about the masks that solve.json records: source, key and share of each kind."""
    return {
        kind: {"source": sources[kind], "key": mask.key, "share": round(mask.share, 4)} for kind, mask in masks.items()
    }


def recorded_masks(shot: Shot) -> dict[str, dict[str, Any]]:
    """`facts_of` the masks that the shot was solved with; {} without masks or if solve.json is unreadable."""
    try:
        facts = read_json(shot.solve_record).get("masks")
    except (OSError, ValueError):
        return {}
    if not is_json_object(facts):
        return {}
    return {kind: facts[kind] for kind in MASK_KINDS if is_json_object(facts.get(kind))}


def masks_key(shot: Shot, *kinds: str) -> list[Any]:
    """Key that changes with the solve's masks of the given kinds (all kinds if none are given); empty without masks."""
    return [[kind, facts.get("key")] for kind, facts in recorded_masks(shot).items() if not kinds or kind in kinds]


def load_mask(shot: Shot, kind: str, frame: int) -> NDArray[np.bool_] | None:
    """Masked pixels of an undistorted frame, bool [H, W]; None if the shot has no such mask.

    Raises JobError (SOLVE) if the shot has the mask but its file is missing or damaged.
    """
    if kind not in recorded_masks(shot):
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
    """A picture [H, W, 3] with its ignored pixels, bool [H, W], and a margin inpainted from the surroundings.

    Otherwise optical flow would spread the stillness of a logo into its surroundings.
    """
    return np.asarray(cv2.inpaint(pixels, _wider(ignored, MARGIN), _INPAINT_PX, cv2.INPAINT_TELEA), np.uint8)


def limited(labels: NDArray[np.uint8], ignored: NDArray[np.bool_] | None, people: NDArray[np.bool_] | None) -> None:
    """Sets a motion matte [H, W] to still, 0, in place wherever the masks allow no motion."""
    if ignored is not None:
        # In the rim, scene points that become hidden would seem to move.
        labels[_wider(ignored, _RIM) > 0] = 0
    if people is not None:
        labels[~people] = 0


def _wider(covered: NDArray[np.bool_], by: float) -> NDArray[np.uint8]:
    """`covered` dilated by `by` pixels of a picture 640 wide: [H, W], 1 or 0."""
    reach = round(by * covered.shape[1] / 640)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(covered.astype(np.uint8), kernel), np.uint8)


def _damaged(path: Path) -> JobError:
    return JobError(f"The mask {path} is damaged or missing.", "Solve the camera again.", ExitCode.SOLVE)
