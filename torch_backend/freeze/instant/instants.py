"""Stores developed instants in the run's folder: one safetensors file each, with a key of its inputs."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...contract import DEVELOPED_FOLDER, JobError, Reporter, frame_file, frame_number, sweep_half_written
from ...gaussians.model import PARAM_NAMES
from ...motion.mattes import motion_key
from ...scene import Scene
from ...shot import Shot, content_key, path_error
from ...train import LoadedRun
from ...train.checkpoint import load_checkpoint, read_meta, save_checkpoint
from ..frozen import FrozenGaussians, freeze_at, span_of
from ..views.source_views import motion_mattes
from .develop import DevelopConfig
from .repairs import Moment, repaired, repairs

FOLDER = DEVELOPED_FOLDER
"""Folder of developed instants in a run's folder."""
VERSION = 28
"""Version of developed instants. Raise it when older ones must not be used any more."""
MOST = 6
"""Largest number of instants in a take that are developed. A take with more instants develops none of them, so that the
look does not change in the middle of a speed ramp."""


class Instants:
    """The scenes of a take: the run at each of its instants, developed if requested and possible."""

    def __init__(
        self, shot: Shot, run: LoadedRun, scene: Scene, query: str, t_stars: Iterable[float], on: bool = True
    ) -> None:
        """`query`: as in `FreezeParams`. `t_stars`: frame numbers of all instants of the take. `on` False: no instant
        is developed. The shot's motion mattes must exist (`find_motion`), because the keys depend on them."""
        self.shot, self.run, self.scene, self.query = shot, run, scene, query
        distinct, trained = sorted(set(t_stars)), set(run.train_frames)
        to_develop = distinct if on and len(distinct) <= MOST else []
        self.config = config_for(run)
        self.keys = {t: developed_key(shot, run, int(t), self.config, query) for t in to_develop if t in trained}
        """t* -> key of the developed instants. Only frames whose plates the run was trained on are developed."""
        self._in_memory: dict[float, FrozenGaussians] = {}
        self._at: tuple[float, FrozenGaussians] | None = None

    @property
    def frames(self) -> list[int]:
        """Numbers of the frames that are developed, ascending."""
        return sorted(int(t) for t in self.keys)

    def is_stored(self, t_star: float) -> bool:
        """True if the developed instant is stored in the run's folder."""
        return t_star not in self._in_memory and self._stored(t_star) is not None

    def prepare(self, t_stars: Iterable[float], report: Reporter) -> None:
        """Develops the instants of `t_stars` in `keys` that are not stored yet. `Cancelled` leaves no partial file."""
        missing = [t for t in dict.fromkeys(t_stars) if t in self.keys and self._stored(t) is None]
        for n, t_star in enumerate(missing):
            self._at = None  # frees memory for the next instant
            self._develop(t_star, report, n, len(missing))

    def at(self, t_star: float, report: Reporter) -> FrozenGaussians:
        """The scene at an instant. It is developed now if it is in `keys` and not stored yet."""
        if self._at is not None and self._at[0] == t_star:
            return self._at[1]
        self._at = None  # frees memory for the next instant
        if t_star in self.keys:
            instant = self._stored(t_star) or self._develop(t_star, report)
        else:
            instant = self._field(t_star)
        self._at = t_star, instant
        return instant

    def _field(self, t_star: float) -> FrozenGaussians:
        return freeze_at(self.run.model, self.scene.time_of_frame(t_star), span_of(self.scene, self.run), self.query)

    def _stored(self, t_star: float) -> FrozenGaussians | None:
        instant = self._in_memory.get(t_star)
        if instant is not None:
            return instant
        return load_developed(self.shot, self.run, int(t_star), self._field(t_star), self.config, self.query)

    def _develop(self, t_star: float, report: Reporter, n: int = 0, count: int = 1) -> FrozenGaussians:
        warned: set[int] = set()

        def check(done: int, steps: int) -> None:
            report.check_cancelled()
            if done not in warned:  # training of movers alone calls this with the same `done` at every step
                warned.add(done)
                text = f"t* {int(t_star)}, step {done} of {steps}"
                report.progress("developing", n * steps + done, count * steps, text)

        frozen = self._field(t_star)
        instant = _make(self.shot, self.run, self.scene, int(t_star), frozen, self.config, check)
        # Another job may have stored the same instant meanwhile. Jobs may be using that file, so it is not replaced.
        stored = self._stored(t_star)
        instant = instant if stored is None else stored
        self._at = t_star, instant
        report.progress("developing", n + 1, count, f"t* {int(t_star)}")
        if self.run.stale:
            self._in_memory[t_star] = instant
            return instant
        if stored is not None:
            return instant
        try:
            _save(self.shot, self.run, int(t_star), frozen, instant, self.keys[t_star])
        except (OSError, JobError) as error:
            self._in_memory[t_star] = instant
            problem = error if isinstance(error, JobError) else path_error(error)
            reason = f"{error}." if problem is None else problem.message
            report.warning(
                f"The developed instant was not saved: {reason}", "The next freeze at this t* develops it again."
            )
        return instant


def config_for(run: LoadedRun) -> DevelopConfig:
    """Configuration to develop instants of a run, at the run's training width or `DevelopConfig.width`, if larger."""
    usual = DevelopConfig()
    larger = max(1.0, run.width / usual.width)
    return dataclasses.replace(usual, width=max(usual.width, run.width), steps=round(usual.steps * larger))


def developed_key(
    shot: Shot, run: LoadedRun, t_star: int, config: DevelopConfig | None = None, query: str = "nearest"
) -> str:
    """Key of a developed instant's inputs and configuration; `query` as in `FreezeParams`."""
    return _key(shot, run, t_star, config, query, run.stamp)


def _key(
    shot: Shot, run: LoadedRun, t_star: int, config: DevelopConfig | None, query: str, stamp: str | list[Any]
) -> str:  # fmt: skip
    settings = dataclasses.asdict(config or config_for(run))
    return content_key(VERSION, stamp, query, int(t_star), motion_key(shot), settings)


def developed_path(run: LoadedRun, t_star: int) -> Path:
    """Path of a developed instant in the run's folder."""
    return run.folder / FOLDER / frame_file(t_star, ".safetensors")


def load_developed(
    shot: Shot, run: LoadedRun, t_star: int, frozen: FrozenGaussians, config: DevelopConfig | None = None,
    query: str = "nearest",
) -> FrozenGaussians | None:  # fmt: skip
    """The stored developed instant; None if there is none, its key differs, or its file is damaged.

    `frozen` is the run's scene at t*, evaluated with `query`.
    """
    path = developed_path(run, t_star)
    try:
        # Keys of earlier versions contain the modification time of the run's checkpoint.
        keys = [_key(shot, run, t_star, config, query, stamp) for stamp in (run.stamp, run.former_stamp)]
        if not path.is_file() or read_meta(path).get("key") not in keys:
            return None
        tensors, _ = load_checkpoint(path)
    except (JobError, OSError):
        return None
    if not _is_valid(tensors, frozen):
        return None
    device = frozen.support.device
    closed = tensors["closed"].to(device)
    base = {name: tensors[f"base.{name}"].to(device) for name in PARAM_NAMES}
    support, motion = frozen.support.index_fill(0, closed, 1.0), frozen.motion.index_fill(0, closed, 0.0)
    added = torch.ones(len(base["means"]) - len(support), device=device)
    support, motion = torch.cat([support, added]), torch.cat([motion, added])
    before = FrozenGaussians(base, frozen.sh_degree, support, motion)
    state = {name: tensors[f"state.{name}"].to(device) for name in PARAM_NAMES}
    return FrozenGaussians(state, frozen.sh_degree, support, motion, before, tensors["origin"].to(device))


def _is_valid(tensors: dict[str, Tensor], frozen: FrozenGaussians) -> bool:
    """True if names, types, shapes and values of a file's tensors are valid for the run: the file is untrusted."""
    names = [f"{part}.{name}" for part in ("base", "state") for name in PARAM_NAMES]
    closed, origin, known = tensors.get("closed"), tensors.get("origin"), len(frozen.support)
    if closed is None or closed.dtype != torch.long or closed.dim() != 1 or not all(n in tensors for n in names):
        return False
    if origin is None or origin.dtype != torch.uint8 or origin.dim() != 1 or len(origin) < known:
        return False
    for name in names:
        like, value = frozen.state[name.partition(".")[2]], tensors[name]
        shape = len(origin), *like.shape[1:]
        if value.dtype != like.dtype or value.shape != shape or not bool(value.isfinite().all()):
            return False
    return not len(closed) or (int(closed.min()) >= 0 and int(closed.max()) < known)


def developed(
    shot: Shot, run: LoadedRun, scene: Scene, t_star: int, frozen: FrozenGaussians,
    config: DevelopConfig | None = None, keep: bool = True,
) -> FrozenGaussians:  # fmt: skip
    """The developed scene at frame `t_star`, read from the run's folder or else developed now and stored.

    Args:
        frozen: the run's scene at t*, evaluated with the query "nearest".
        keep: store the instant in the run's folder. OSError or JobError if that fails.
    """
    config = config or config_for(run)
    instant = load_developed(shot, run, t_star, frozen, config)
    if instant is not None:
        return instant
    instant = _make(shot, run, scene, t_star, frozen, config)
    if keep and not run.stale:
        _save(shot, run, t_star, frozen, instant, developed_key(shot, run, t_star, config))
    return instant


def _make(
    shot: Shot, run: LoadedRun, scene: Scene, t_star: int, frozen: FrozenGaussians, config: DevelopConfig,
    check: Callable[[int, int], None] | None = None,
) -> FrozenGaussians:  # fmt: skip
    return repaired(frozen, Moment(run, scene, t_star, motion_mattes(shot), check), repairs(config))


def _save(
    shot: Shot, run: LoadedRun, t_star: int, field: FrozenGaussians, instant: FrozenGaussians, key: str
) -> None:  # fmt: skip
    """Writes a developed instant, and deletes instants of other trainings of the run.

    `field` is the run's scene at t* before repairs. OSError, or JobError if a link leads out of the shot.
    """
    assert instant.descent is not None and instant.origin is not None
    path = developed_path(run, t_star)
    folder = shot.own(path.parent)
    closed = torch.nonzero(instant.descent.motion[: len(field.motion)] < field.motion).flatten()
    tensors = {"closed": closed, "origin": instant.origin}
    # An unchanged instant shares tensors with its `descent`, but tensors in a safetensors file must not share memory.
    tensors |= {f"state.{name}": instant.state[name].clone() for name in PARAM_NAMES}
    tensors |= {f"base.{name}": instant.descent.state[name] for name in PARAM_NAMES}
    sweep_half_written(folder)
    meta: dict[str, Any] = {"key": key, "t_star": t_star, "run": run.stamp}
    save_checkpoint(path, tensors, meta)
    stamps = run.stamp, run.former_stamp
    for file in folder.glob("*.safetensors"):
        with contextlib.suppress(OSError):  # a file that stays only takes space: its key does not match
            if frame_number(file.stem) is not None and file != path and read_meta(file).get("run") not in stamps:
                file.unlink()
