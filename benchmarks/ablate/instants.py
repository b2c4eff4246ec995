"""Makes the instants of one t* with rules off. Steps that several variants share run once."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from benchmarks.ablate.switches import MAKER, STAGES, of_stage, replaced, rules_disabled
from benchmarks.detail_clip import DetailClip
from torch_backend.freeze.frozen import FrozenGaussians
from torch_backend.freeze.instant import instants as developed_instants
from torch_backend.gaussians.model import PARAM_NAMES
from torch_backend.train.checkpoint import load_checkpoint, save_checkpoint


@dataclass
class Instant:
    """A scene frozen at t*, made with some rules off."""

    frozen: FrozenGaussians
    """The scene."""
    key: str
    """Hash of the content: variants with equal keys have the same scene."""
    seconds: dict[str, float]
    """CPU seconds of each step that made it."""


class Instants:
    """Makes the instants of one t* of a clip. Caches the result of each step under a hash of its inputs."""

    def __init__(self, clip: DetailClip, t_star: int, folder: Path | None = None) -> None:
        """`folder`: where developed scenes are kept for later processes; None keeps them in memory only."""
        self.clip, self.t_star, self.folder = clip, t_star, folder
        self._kept: dict[str, tuple[Any, float]] = {}

    def make(self, disabled: frozenset[str]) -> Instant:
        """The instant with rules `disabled`."""
        seconds: dict[str, float] = {}
        run, scene = self.clip.run, self.clip.scene
        field = self.clip.field(self.t_star)
        with self._sharing(disabled, seconds), rules_disabled(disabled):
            config = developed_instants.config_for(run)
            frozen = developed_instants._make(self.clip.shot, run, scene, self.t_star, field, config)  # pyright: ignore[reportPrivateUsage]
        return Instant(frozen, digest(frozen), seconds)

    @contextlib.contextmanager
    def _sharing(self, disabled: frozenset[str], seconds: dict[str, float]) -> Iterator[None]:
        """Context in which a step called again with the same input returns its cached result."""
        with contextlib.ExitStack() as stack:
            for stage in STAGES:
                # A step that is off as a whole is replaced on top of this wrapper, and costs nothing.
                stack.enter_context(replaced(MAKER, stage, self._shared(stage, disabled, seconds)))
            yield

    def _shared(
        self, stage: str, disabled: frozenset[str], seconds: dict[str, float]
    ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        rules = sorted(of_stage(disabled, stage))

        def wrap(step: Callable[..., Any]) -> Callable[..., Any]:
            def shared(*args: Any, **more: Any) -> Any:
                key = f"{stage}-{digest([rules, args, more])}"
                if key not in self._kept:
                    self._kept[key] = self._computed(stage, key, lambda: step(*args, **more))
                result, took = self._kept[key]
                seconds[stage] = seconds.get(stage, 0.0) + took
                return result

            return shared

        return wrap

    def _computed(self, stage: str, key: str, make: Callable[[], Any]) -> tuple[Any, float]:
        """(result of a step, its CPU seconds), read from the folder if it is there."""
        path = None if self.folder is None or stage != "develop" else self.folder / f"{key}.safetensors"
        if path is not None and path.is_file():
            return _load(path)
        since = time.process_time()
        computed = make(), time.process_time() - since
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            _save(path, *computed)
        return computed


def _save(path: Path, frozen: FrozenGaussians, seconds: float) -> None:
    """Saves a developed scene, the scene it descends from, and the CPU seconds it took."""
    assert frozen.descent is not None
    scenes = {"now": frozen, "before": frozen.descent}
    tensors = {f"{name}.{key}": value.clone() for name, scene in scenes.items() for key, value in scene.state.items()}
    for name, scene in scenes.items():
        tensors |= {f"{name}:support": scene.support.clone(), f"{name}:motion": scene.motion.clone()}
    save_checkpoint(path, tensors, {"sh_degree": frozen.sh_degree, "seconds": seconds})


def _load(path: Path) -> tuple[FrozenGaussians, float]:
    """Inverse of `_save`."""
    tensors, meta = load_checkpoint(path)

    def scene(name: str, descent: FrozenGaussians | None) -> FrozenGaussians:
        state = {key: tensors[f"{name}.{key}"] for key in PARAM_NAMES}
        return FrozenGaussians(
            state, int(meta["sh_degree"]), tensors[f"{name}:support"], tensors[f"{name}:motion"], descent
        )

    return scene("now", scene("before", None)), float(meta["seconds"])


def digest(value: Any) -> str:
    """Hash of the content of tensors, arrays, numbers, strings, and of collections and dataclasses of them.

    Functions and objects that belong to the clip are ignored: they are the same for all variants of a t*.
    """
    found = hashlib.sha256()
    _feed(found, value)
    return found.hexdigest()[:16]


def _feed(found: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        found.update(f"{value.dtype}{value.shape}".encode())
        found.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, dict):
        _feed(found, [*sorted(value.items())])
    elif isinstance(value, list | tuple):
        found.update(f"[{len(value)}".encode())
        for each in value:
            _feed(found, each)
    elif isinstance(value, FrozenGaussians) or type(value).__name__ == "DevelopConfig":
        assert is_dataclass(value)
        _feed(found, [getattr(value, f.name) for f in fields(value)])
    elif value is None or isinstance(value, str | int | float | bool):
        found.update(repr(value).encode())
