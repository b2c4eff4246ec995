"""The live station: a loaded run that draws frozen views as fast as they are requested.

The process reads requests from its standard input and answers on its standard output. It opens no port, and it ends
when the process that started it ends. Messages have the format of `contract.write_message`:

| header | from | means |
|---|---|---|
| `ready` | backend | the run is loaded: its frames, suggested instants, size; `note`: a warning or empty |
| a `LiveView` | Blender | a request; a newer one for the same view replaces one that waits or is being made of plates |
| `frame` | backend | a view: float32 premultiplied display-referred RGBA, then float32 depth of splats in solve units |
| `error` | backend | message and hint; an error without `seq` ends the session |
"""

from __future__ import annotations

import functools
import math
import os
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from . import contract
from .contract import (
    NO_DEPTH,
    JobError,
    LiveView,
    detach_standard_input,
    from_dict,
    path_error,
    read_message,
    write_message,
)
from .footage.plates import Plates
from .freeze.composite.compositor import CompositeConfig, CompositeFrame, Compositor
from .freeze.frozen import (
    FrozenGaussians,
    FrozenImage,
    OutputFrame,
    freeze_at,
    render_frozen,
    span_of,
)
from .freeze.instant.instants import developed_path, load_developed
from .freeze.take.plan import suggested_instants
from .freeze.views.source_views import VisibilityConfig, motion_mattes
from .scene import Scene, load_scene
from .shot import Shot
from .train import LoadedRun, load_run
from .train.device import decide_device, unused_warning

_INSTANTS_KEPT = 8
"""Number of frozen scenes kept in memory, so that a return to an instant needs no evaluation of the field."""
_COARSER = 1.25
"""Largest factor by which plates may be coarser than the view that is made of them."""
_DETAIL = CompositeConfig(sources=4, source_views=VisibilityConfig(width=320))
"""Fewer and smaller plates than for a take, in which neighbouring frames share the work done for a plate."""
_TINT, _TINTED = (1.0, 0.15, 0.55), 0.75
"""Display-referred tint of guessed pixels, and its opacity where no frame supports the pixel at all."""


class Superseded(Exception):
    """Raised if a newer request arrives while a view is being made of plates, which is slow."""


class _LivePlates:
    """Plates as `Compositor` reads them. Each read raises Superseded if the view should be abandoned."""

    def __init__(self, shot: Shot, size: tuple[int, int]) -> None:
        self._plates, self._moving = Plates(shot, size), motion_mattes(shot)
        self.width, self.height, self.frames = self._plates.width, self._plates.height, self._plates.frames
        self.deep = self._plates.deep
        self.stop: Callable[[], bool] = lambda: False

    def display(self, frame: int) -> Tensor:
        self._go_on()
        return self._plates.display(frame)

    def linear(self, frame: int, rows: slice = slice(None)) -> Tensor:
        self._go_on()
        return self._plates.linear(frame, rows)

    def moving(self, frame: int) -> Tensor | None:
        """As `source_views.MovingOf`."""
        self._go_on()
        return self._moving(frame)

    def _go_on(self) -> None:
        if self.stop():
            raise Superseded


class _Details:
    """Makes views of plates. All views of about the same scale share what is computed from a plate."""

    def __init__(self, shot: Shot, run: LoadedRun, scene: Scene) -> None:
        self._shot, self._run, self._scene = shot, run, scene
        self._cached: tuple[tuple[int, int], _LivePlates, Compositor] | None = None
        self._full_size: tuple[int, int] | None = None

    def frame(
        self, output: OutputFrame, frozen: FrozenGaussians, image: FrozenImage, stop: Callable[[], bool]
    ) -> CompositeFrame:
        """A view of plates, at its own scale. JobError if a plate cannot be read; Superseded once `stop` is true."""
        height, width = image.alpha.shape
        size = self._size(output)
        if self._cached is None or self._cached[0] != size:
            self._cached = None  # frees memory before the next one is made
            plates = _LivePlates(self._shot, size)
            self._cached = size, plates, Compositor(self._run, self._scene, plates, _DETAIL, plates.moving)
        _, plates, compositor = self._cached
        plates.stop = stop
        return compositor.frame(output, frozen, image, width, height)

    def _size(self, output: OutputFrame) -> tuple[int, int]:
        """Width and height of plates about as fine as a view: the source's size, halved as often as possible."""
        if self._full_size is None:
            full = Plates(self._shot)
            self._full_size = full.width, full.height
        focal = float(self._scene.Ks[0, 0, 0]) * self._full_size[0] / self._scene.width
        finer = focal / max(float(output.K[0, 0]), 1e-6)
        halved = 2 ** max(0, math.floor(math.log2(finer * _COARSER)))
        return max(16, round(self._full_size[0] / halved)), max(16, round(self._full_size[1] / halved))


class LiveSession:
    """A loaded run. JobError if the shot has no such run."""

    def __init__(self, shot: Shot, run: str, device: str = "auto") -> None:
        chosen, unused = decide_device(device)
        self._note = " ".join(unused_warning(unused, "Scrubbing")).strip() if unused is not None else ""
        self._shot, self.run = shot, load_run(shot, run, chosen)
        self.scene = load_scene(shot)
        self._span = span_of(self.scene, self.run)
        self._frozen: OrderedDict[tuple[int, tuple[int, ...] | None], FrozenGaussians] = OrderedDict()
        self._details = _Details(shot, self.run, self.scene)

    def facts(self) -> dict[str, Any]:
        """Header of the `ready` message."""
        trained = self.run.train_frames
        return {
            "kind": "ready",
            "run": self.run.folder.name,
            "first": self.scene.frames[0],
            "last": self.scene.frames[-1],
            "trained": trained,
            "width": self.run.width,
            "height": self.run.height,
            "gaussians": len(self.run.model.gaussians),
            "moving": len(self.run.model.open_rows()),
            "note": self._note,
            "suggestions": [
                {"frame": frame, "seen": round(instant.seen, 3), "sharpness": round(instant.sharpness, 3)}
                for frame, instant in suggested_instants(self._shot, self.scene, self.run)
            ],
        }

    def draw(self, view: LiveView, stop: Callable[[], bool] = lambda: False) -> tuple[dict[str, Any], bytes]:
        """Header and body of the `frame` message for a view. t* snaps to the nearest trained frame.

        While a view is made of plates, `stop` is called between reads. Superseded once it returns True; JobError if a
        plate cannot be read.
        """
        since = time.perf_counter()
        at = min(self.run.train_frames, key=lambda frame: abs(frame - view.t_star))
        output = self._output(view, at)
        frozen, exposed_at = self._at(at, view.develop), self.scene.time_of_frame(output.exposed_like)
        exposure = self.run.model.exposure
        image = render_frozen(frozen, output.viewmat, output.K, view.width, view.height, exposure, exposed_at)
        if view.detail and view.show == "color":
            image = self._details.frame(output, frozen, image, stop)
        image = image.cpu()
        alpha = image.alpha[..., None]
        if view.show == "color":
            shown = image.color
        elif view.show == "guesses":
            guess = _TINTED * (1.0 - image.support)[..., None]
            shown = image.color * (1.0 - guess) + guess * alpha * torch.tensor(_TINT, device="cpu")
        else:
            shown = getattr(image, view.show)[..., None].expand(-1, -1, 3) * alpha
        depth = torch.where(image.depth < NO_DEPTH, image.depth / self.scene.scale, NO_DEPTH)
        body = torch.cat([shown.clamp(0.0, 1.0), alpha], dim=2).contiguous().numpy().tobytes() + depth.numpy().tobytes()
        header = {
            "kind": "frame",
            "view": view.view,
            "seq": view.seq,
            "width": view.width,
            "height": view.height,
            "t_star": at,
            "show": view.show,
            "developed": frozen.descent is not None,
            "seconds": round(time.perf_counter() - since, 5),
        }
        return header, body

    def _output(self, view: LiveView, at: int) -> OutputFrame:
        """Output frame of a view. If the view has the camera of a clip frame, that frame's exact matrix is used."""
        like = at if view.exposed_like is None else view.exposed_like
        fx, fy, cx, cy = view.K
        viewmat = self.scene.from_solve(np.reshape(view.viewmat, (4, 4)))
        K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], device="cpu")
        frame = round(like)
        if frame == like and frame in self.scene.frames:
            i = self.scene.frames.index(frame)
            # Blender's matrices have rounding errors.
            if torch.allclose(viewmat, self.scene.viewmats[i], atol=1e-4):
                viewmat = self.scene.viewmats[i]
        return OutputFrame(frame, viewmat, K, float(at), float(like))

    def _at(self, frame: int, develop: bool) -> FrozenGaussians:
        """The frozen scene at a trained frame. It is the developed instant if `develop` is true and one exists."""
        file = _file_of(developed_path(self.run, frame)) if develop else None
        key = frame, file
        if key not in self._frozen:
            field = self._field(frame)
            developed = None if file is None else load_developed(self._shot, self.run, frame, field)
            self._frozen[key] = field if developed is None else developed
            while len(self._frozen) > _INSTANTS_KEPT:
                self._frozen.popitem(last=False)
        self._frozen.move_to_end(key)
        return self._frozen[key]

    def _field(self, frame: int) -> FrozenGaussians:
        return freeze_at(self.run.model, self.scene.time_of_frame(frame), self._span)


def _file_of(path: Path) -> tuple[int, ...] | None:
    """Inode, size in bytes and modification time (ns) of a file; None if it is missing. A change of any of them means
    that the file has to be read again."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


class _Waiting:
    """Queue of requests: the newest one of each view, oldest view first, views made of plates after all others.

    A thread fills the queue, and the session empties it.
    """

    def __init__(self) -> None:
        self._views: OrderedDict[int, LiveView] = OrderedDict()
        self._refused: list[dict[str, Any]] = []
        self._ended = False
        self._change = threading.Condition()

    def read(self, stream: BinaryIO) -> None:
        """Reads requests until the stream ends or is malformed."""
        try:
            while (message := read_message(stream)) is not None:
                header = dict(message[0])
                header.pop("kind", None)
                try:
                    request = from_dict(LiveView, header)
                except ValueError as error:
                    refusal = {"kind": "error", "seq": header.get("seq", -1), "message": str(error), "hint": ""}
                    with self._change:
                        self._refused.append(refusal)
                        self._change.notify()
                    continue
                with self._change:
                    self._views[request.view] = request
                    self._change.notify()
        except (OSError, ValueError):
            pass  # the client is gone, so the session ends without an error
        with self._change:
            self._ended = True
            self._change.notify()

    def next(self) -> LiveView | dict[str, Any] | None:
        """Waits for the next item: a view to draw, a refusal to send, or None at the end of the session."""
        with self._change:
            self._change.wait_for(lambda: self._ended or self._views or self._refused)
            if self._ended:
                return None
            if self._refused:
                return self._refused.pop(0)
            first = next((n for n, view in self._views.items() if not view.detail), next(iter(self._views)))
            return self._views.pop(first)

    def better_than(self, view: LiveView) -> bool:
        """True if a view made of plates should be abandoned: a faster or newer request waits, or the session ended."""
        with self._change:
            waits = any(not queued.detail or queued.view == view.view for queued in self._views.values())
            return self._ended or bool(self._refused) or waits

    def requeue(self, view: LiveView) -> None:
        """Queues a request again, unless a newer one for the same view waits."""
        with self._change:
            self._views.setdefault(view.view, view)


def serve(session: LiveSession, requests: BinaryIO, answers: BinaryIO) -> None:
    """Answers requests until their stream ends. If a view cannot be drawn, the answer is an `error` with its `seq`, and
    the session goes on."""
    waiting = _Waiting()
    threading.Thread(target=waiting.read, args=(requests,), name="live requests", daemon=True).start()
    try:
        write_message(answers, session.facts())
        while (request := waiting.next()) is not None:
            if isinstance(request, dict):
                write_message(answers, request)
                continue
            try:
                header, body = session.draw(request, functools.partial(waiting.better_than, request))
            except Superseded:
                waiting.requeue(request)
                continue
            except Exception as error:
                known = error if isinstance(error, JobError) else contract.broke("The live view", error)
                words = {"message": known.message, "hint": known.hint}
                header, body = {"kind": "error", "seq": request.seq, **words}, b""
            write_message(answers, header, body)
    except BrokenPipeError:
        pass  # Blender is gone


def run_live(shot: str | Path, run: str, device: str = "auto") -> int:
    """The process behind `python -m torch_backend live`; returns an exit code."""
    # Text that a library prints would corrupt the messages, so it goes to the standard error from now on.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    requests = os.fdopen(detach_standard_input(), "rb")
    try:
        session = LiveSession(Shot.open(shot), run, device)
    except Exception as error:
        known = path_error(error) if isinstance(error, OSError) and not isinstance(error, JobError) else None
        known = known or (error if isinstance(error, JobError) else contract.broke("The live session", error))
        write_message(answers, {"kind": "error", "message": known.message, "hint": known.hint})
        return known.exit_code
    serve(session, requests, answers)
    return 0
