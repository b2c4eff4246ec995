"""Scenes with a truth for freezes: rendered truth in a folder, or a real clip where nothing moves.

Layout of a folder of truth, written by benchmarks/synthetic or another source:

    truth.json                     version, name, cameras, shot, fps, t_stars, poses, regions
    truth/<t*>_<pose>.png          the scene frozen at frame t*, seen from the pose of frame `pose`
    regions/<t*>_<pose>_<name>.png white inside the region, one per name in `regions`

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
"""Regions by truth: visible in the clip's frame at t*, or not; on a mover of the clip, or not."""
PANES = ("glass", "mirror")
"""Panes of a hard scene: pixels of a window's pane and of a mirror in which nothing moves, by truth."""
HELD = "held"
"""Optional region: pixels where the plate of the pose shows another state than t*, although they are still within half
a second of that plate."""
HELD_ROLES = ("raised", "turned", "resting", "leaving", "set_down")
"""An arm raised once; a head that turns unseen; a hand that leaves a table; a person who leaves; a box put down."""
OBJECT_REGIONS = (*PANES, "wall", "swinging", "arm", "hair", *HELD_ROLES, HELD)
"""Names of all things of hard scenes, including the still wall near panes, a swinging object, a gesturing arm, hair."""
RIGID = "rigid"
"""The region of a real clip in which the plate is the truth."""


class TruthScene(Protocol):
    """Interface of a scene with truth."""

    name: str
    kind: str
    """synthetic or real."""
    cameras: str
    """exact or solved."""
    shot: Shot
    """The solved shot to train on."""
    key: str
    """Hash of the content of shot and truth."""
    fps: float
    """Poses per second when the poses of an instant are shown as a sequence; 0 if they do not form one."""
    t_stars: list[int]
    """Frame numbers of the instants."""
    judged: str
    """Region whose PSNR ranks frames."""

    def poses(self, t_star: int, held_out: Sequence[int]) -> list[int]:
        """Frame numbers of the poses that test a freeze at t*, given the held-out frames."""
        ...

    def truth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """[height, width, 3] truth, display-referred in [0, 1]."""
        ...

    def regions(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """{name: bool [height, width]}; in hard scenes also some of `OBJECT_REGIONS`."""
        ...

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """{thing: [height, width, 3] truth without it, valid inside the thing}; {} if unknown."""
        ...

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """`moving`, `static` and the available `OBJECT_REGIONS`, bool [height, width], of the clip's own frame.

        {} if unknown.
        """
        ...


class TruthFolder:
    """A folder of truth, laid out as described in this module."""

    kind = "synthetic"
    judged = "whole"

    def __init__(self, folder: str | Path) -> None:
        """FileNotFoundError or ValueError for an invalid folder."""
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
        """All poses with truth."""
        return list(self._poses)

    def truth(self, t_star: int, pose: int, width: int, height: int) -> Tensor:
        """The rendered truth, see `TruthScene`."""
        return read_image(self.folder / "truth" / f"{t_star:06d}_{pose:06d}.png", width, height)

    def regions(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """The regions by truth; a pixel belongs to a region that covers more than half of it."""
        named = {name: self.folder / "regions" / f"{t_star:06d}_{pose:06d}_{name}.png" for name in self._regions}
        return {name: read_image(path, width, height).mean(2) > 0.5 for name, path in named.items()}

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """{}: the folder has no such pictures."""
        return {}

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """{}: the folder has no such regions."""
        return {}


class RealScene:
    """A real clip whose plates are the truth at pixels that are still and far from movers."""

    kind = "real"
    cameras = "solved"
    fps = 0.0
    judged = RIGID

    def __init__(self, shot: Shot, instants: int = 8) -> None:
        """Args:
            shot: a solved shot; its motion mattes are computed if missing.
            instants: number of t*, evenly spaced over the solved frames.

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
        """The rigid pixels of the plate; more than 95 % of a pixel must be rigid."""
        return {RIGID: motion_shares(self.shot, pose, width, height)["rigid"] > 0.95}

    def behind(self, t_star: int, pose: int, width: int, height: int) -> dict[str, Tensor]:
        """{}: unknown for a real clip."""
        return {}

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, Tensor]:
        """`static` and `moving` pixels: more than 95 % of the pixel is still, or moves. Unknown pixels are neither."""
        shares = motion_shares(self.shot, frame, width, height)
        return {"moving": shares["moving"] > 0.95, "static": shares["still"] > 0.95}
