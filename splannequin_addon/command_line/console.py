"""Output of a command on the Blender side."""

from __future__ import annotations

import dataclasses
import json
import time

from ...torch_backend import contract


class Console:
    """Prints job events: as lines for people, or as JSON lines."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self._last = ("", 0.0)
        self._seq = 0

    def __call__(self, event: contract.Event) -> None:
        if self.as_json:
            print(json.dumps(dataclasses.asdict(event)), flush=True)
        elif event.type == "progress":
            self._progress(event)
        elif event.type == "warning":
            print(f"  note: {event.data['message']} {event.data['hint']}".rstrip(), flush=True)

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Reports the progress of work done in Blender."""
        data = {"stage": stage, "done": done, "total": total, "message": message, "eta_seconds": None}
        self(contract.Event("progress", self._seq, time.time(), data))
        self._seq += 1

    def say(self, sentence: str) -> None:
        """Prints a sentence for people; nothing in JSON mode."""
        if not self.as_json:
            print(sentence, flush=True)

    def _progress(self, event: contract.Event) -> None:
        data = event.data
        share = data["done"] / data["total"] if data["total"] else 0.0
        stage, since = self._last
        if data["stage"] == stage and share < 1.0 and event.time - since < 5.0:
            return
        self._last = (data["stage"], event.time)
        eta = f", {data['eta_seconds']:.0f} s left" if data.get("eta_seconds") and share < 1.0 else ""
        print(f"  {data['stage']:<22} {100 * share:3.0f}%  {data['message']}{eta}".rstrip(), flush=True)
