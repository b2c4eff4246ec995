"""Scenes that a freeze can be judged on: rendered truth in a folder, or a real clip where nothing moves.

A folder of truth (written by benchmarks/synthetic, or by whoever has some):

    truth.json                     version, name, cameras, shot, fps, t_stars, poses, regions
    truth/<t*>_<pose>.png          the scene frozen at frame t*, seen from the pose of frame `pose`
    regions/<t*>_<pose>_<name>.png white where the region is, one per name in `regions`

`shot` is the solved shot folder to train on, relative to truth.json; frame numbers are those of its clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from torch import Tensor

from torch_backend.contract import check_version, read_json
from torch_backend.motion.mattes import motion_key
from torch_backend.scene import evenly_spaced, load_scene, read_image
from torch_backend.shot import Shot, content_key

from .real import ensure_motion, far_from, motion_shares

TRUTH_VERSION = 1
REGIONS = ("seen", "never_seen", "moving", "static")
"""By truth: visible in the clip's frame at t*; not; on something that moves in the clip; on nothing that does."""
PANES = ("glass", "mirror")
"""Of a hard scene: pixels of a window's pane and of a mirror in which nothing moves, by truth."""
HELD = "held"
"""Optional: pixels in which the plate of the pose shows another state than t*, although nothing moves there within half
a second of that plate."""
HELD_THINGS = ("raised", "turned", "resting", "leaving", "set_down")
"""An arm that is raised once; a head that turns unseen; a hand that leaves a table; a person who leaves; a box."""
THINGS = (*PANES, "wall", "swinging", "arm", "hair", *HELD_THINGS, HELD)
"""Besides: the still wall around panes; something that swings on a thread; an arm that gestures; loose hair."""
RIGID = "rigid"
"""The region of a real clip in which the plate is the truth."""


class TruthScene(Protocol):
    """What a scene is asked for."""

    name: str
    kind: str
    """synthetic or real."""
    cameras: str
    """exact or solved."""
    shot: Shot
    """The solved shot to train on."""
    key: str
    """Identifies shot and truth by content."""
    fps: float
    """Poses per second, when the poses of an instant are shown as a sequence; 0 if they are none."""
    t_stars: list[int]
    """Frame numbers of the instants."""
    judged: str
    """Region whose PSNR ranks frames."""

    def poses(self, t_star: int, held_out: Sequence[int]) -> list[int]:
        """Frame numbers of the poses that test a freeze at t*, given the frames that were kept out of training."""
        ...

    def truth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """[height, width, 3] display-referred in [0, 1]."""
        ...

    def regions(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """name -> bool [height, width]; in hard scenes some of `THINGS` too."""
        ...

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """thing -> [height, width, 3], the truth without it, right where the thing is; {} if that is not known."""
        ...

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """`moving`, `static` and what there is of `THINGS`, bool [height, width], of the clip's own frame.

        {} if that is not known.
        """
        ...


class TruthFolder:
    """A folder of truth, see the module."""

    kind = "synthetic"
    judged = "whole"

    def __init__(self, folder: str | Path) -> None:
        """FileNotFoundError or ValueError if the folder is none."""
        self.folder = Path(folder).absolute()
        facts = read_json(self.folder / "truth.json")
        check_version(facts, str(self.folder / "truth.json"), TRUTH_VERSION)
        try:
            self.name, self.cameras = str(facts["name"]), str(facts["cameras"])
            self.shot = Shot.open(self.folder / facts["shot"])
            self.fps = float(facts["fps"])
            self.t_stars, self._poses = [int(t) for t in facts["t_stars"]], [int(p) for p in facts["poses"]]
            self._regions = [str(name) for name in facts["regions"]]
        except KeyError as error:
            raise ValueError(f"{self.folder / 'truth.json'} has no {error}") from error
        self.key = content_key(facts, read_json(self.shot.cameras))

    def poses(self, t_star: int, held_out: Sequence[int]) -> list[int]:
        """All poses that have a truth."""
        return list(self._poses)

    def truth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """The rendered truth, as `TruthScene` says."""
        return read_image(self.folder / "truth" / f"{t_star:06d}_{pose:06d}.png", width, height)

    def regions(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """The regions by truth; a pixel belongs to one if more than half of it does."""
        named = {name: self.folder / "regions" / f"{t_star:06d}_{pose:06d}_{name}.png" for name in self._regions}
        return {name: read_image(path, width, height).mean(2) > 0.5 for name, path in named.items()}

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """Nothing: the folder holds none."""
        return {}

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """Nothing: the folder holds none."""
        return {}


class RealScene:
    """A real clip: the plate is the truth on the pixels that stand still through the clip, far from what moves."""

    kind = "real"
    cameras = "solved"
    fps = 0.0
    judged = RIGID

    def __init__(self, shot: Shot, instants: int = 8) -> None:
        """Args:
            shot: a solved shot; it gets its motion matte here if it has none.
            instants: how many t*, evenly spread over the solved frames.

        JobError if the shot is not solved.
        """  # fmt: skip
        self.shot, self.name = shot, shot.info().name
        self._scene = load_scene(shot)
        ensure_motion(shot)
        solved = [self._scene.frames[i] for i in self._scene.solved]
        self.t_stars = [solved[i] for i in evenly_spaced(len(solved), instants)]
        self.key = content_key(read_json(shot.cameras), self.t_stars, motion_key(shot))

    def poses(self, t_star: int, held_out: Sequence[int]) -> list[int]:
        """Held-out frames more than a quarter of the clip away from t*."""
        return far_from(held_out, t_star, self._scene.frames[-1] - self._scene.frames[0] + 1)

    def truth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """The plate at the pose."""
        return read_image(self.shot.plate(pose), width, height)

    def regions(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """The rigid pixels of the plate; one counts if nearly all of it is."""
        return {RIGID: motion_shares(self.shot, pose, width, height)["rigid"] > 0.95}

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """Nothing: nobody has seen it."""
        return {}

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """Static: nearly all of the pixel stands still; moving: nearly all of it moves. What is unknown is neither."""
        shares = motion_shares(self.shot, frame, width, height)
        return {"moving": shares["moving"] > 0.95, "static": shares["still"] > 0.95}
