"""The live station: a warm run that draws frozen views as fast as they are asked for.

It speaks through its own standard input and output, which belong to the process that started it: nothing listens, and
when that process ends, so does this one. Messages are those of `contract.write_message`:

| header | from | means |
|---|---|---|
| `ready` | backend | the run is loaded: its frames, what they are good for as instants, size |
| a `LiveView` | Blender | draw this; a newer one for the same view replaces one that waits |
| `frame` | backend | a view: float32 premultiplied display-referred RGBA, then float32 depth in solve units |
| `error` | backend | message and hint; after one without `seq` the session ends |
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from .contract import NO_DEPTH, JobError, LiveView, from_dict, read_message, write_message
from .freeze.query import FrozenGaussians, best_instants, freeze_at, rank_instants, render_frozen
from .freeze.take import span_of
from .scene import frame_table, load_scene
from .shot import Shot
from .train import choose_device, load_run

_INSTANTS_KEPT = 8
"""Frozen scenes that are kept: going back and forth between keys costs no evaluation of the field."""
_TINT, _TINTED = (1.0, 0.15, 0.55), 0.75
"""Display-referred colour of what is a guess, and how much of it covers what nobody saw at all."""


class LiveSession:
    """A loaded run. JobError if the shot has no such run."""

    def __init__(self, shot: Shot, run: str, device: str = "auto") -> None:
        self.run = load_run(shot, run, choose_device(device))
        self.scene = load_scene(shot)
        self._span = span_of(self.scene, self.run)
        self._frozen: OrderedDict[float, FrozenGaussians] = OrderedDict()
        self._sharpness = {frame: row["sharpness"] for frame, row in frame_table(shot).items()}

    def facts(self) -> dict[str, Any]:
        """Header of the `ready` message."""
        trained = self.run.train_frames
        times = np.array([self.scene.time_of_frame(frame) for frame in trained])
        ranking = rank_instants(self.run.model, times, np.array([self._sharpness.get(f, 0.0) for f in trained]))
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
            "suggestions": [
                {"frame": trained[i.index], "seen": round(i.seen, 3), "sharpness": round(i.sharpness, 3)}
                for i in best_instants(ranking)
            ],
        }

    def draw(self, view: LiveView) -> tuple[dict[str, Any], bytes]:
        """Header and body of the `frame` message for a view. t* snaps to the nearest trained frame."""
        since = time.perf_counter()
        trained = self.run.train_frames
        at = min(trained, key=lambda frame: abs(frame - view.t_star))
        like = at if view.exposed_like is None else view.exposed_like
        fx, fy, cx, cy = view.K
        image = render_frozen(
            self._at(float(at)),
            self.scene.from_solve(np.reshape(view.viewmat, (4, 4))),
            torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], device="cpu"),
            view.width,
            view.height,
            self.run.model.exposure,
            self.scene.time_of_frame(like),
        )
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
            "seconds": round(time.perf_counter() - since, 5),
        }
        return header, body

    def _at(self, frame: float) -> FrozenGaussians:
        if frame not in self._frozen:
            time_at = self.scene.time_of_frame(frame)
            self._frozen[frame] = freeze_at(self.run.model, time_at, self._span)
            if len(self._frozen) > _INSTANTS_KEPT:
                self._frozen.popitem(last=False)
        self._frozen.move_to_end(frame)
        return self._frozen[frame]


class _Waiting:
    """Requests that wait: the newest of each view, oldest view first. Filled by a thread, emptied by the session."""

    def __init__(self) -> None:
        self._views: OrderedDict[int, LiveView] = OrderedDict()
        self._refused: list[dict[str, Any]] = []
        self._ended = False
        self._change = threading.Condition()

    def read(self, stream: BinaryIO) -> None:
        """Takes requests in until the stream ends or makes no sense."""
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
            pass  # nobody who could be told: the session ends
        with self._change:
            self._ended = True
            self._change.notify()

    def next(self) -> LiveView | dict[str, Any] | None:
        """What to answer next, waiting for it: a view, a refusal to pass on, or None when there will be nothing."""
        with self._change:
            self._change.wait_for(lambda: self._ended or self._views or self._refused)
            if self._ended:
                return None
            return self._refused.pop(0) if self._refused else self._views.popitem(last=False)[1]


def serve(session: LiveSession, requests: BinaryIO, answers: BinaryIO) -> None:
    """Answers until `requests` ends. A view that cannot be drawn is an `error` with its `seq`; the session goes on."""
    waiting = _Waiting()
    threading.Thread(target=waiting.read, args=(requests,), name="live requests", daemon=True).start()
    try:
        write_message(answers, session.facts())
        while (asked := waiting.next()) is not None:
            if isinstance(asked, dict):
                write_message(answers, asked)
                continue
            try:
                header, body = session.draw(asked)
            except (RuntimeError, ValueError) as error:
                header, body = {"kind": "error", "seq": asked.seq, "message": str(error), "hint": ""}, b""
            write_message(answers, header, body)
    except BrokenPipeError:
        pass  # Blender is gone


def run_live(shot: str | Path, run: str, device: str = "auto") -> int:
    """The process behind `python -m torch_backend live`; returns an exit code."""
    # Whatever a library prints would stand between two messages: what was the standard output is ours alone.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        session = LiveSession(Shot.open(shot), run, device)
    except (JobError, ValueError, OSError) as error:
        message, hint = getattr(error, "message", str(error)), getattr(error, "hint", "")
        write_message(answers, {"kind": "error", "message": message, "hint": hint})
        return int(getattr(error, "exit_code", 1))
    serve(session, sys.stdin.buffer, answers)
    return 0
