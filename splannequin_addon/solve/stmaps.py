"""ST maps of the solve's lens: the backend writes them beside Blender, a timer waits for its answer."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..process import backend, jobs, supervisor
from ..shot import chosen
from ..translations import tr

_TICK_SECONDS = 0.2
_LONGEST_SECONDS = 600.0


@dataclass
class Asked:
    """A backend that writes the maps of a shot."""

    shot: Path
    """Shot folder."""
    process: subprocess.Popen[str]
    told: tuple[str, str] | None = None
    """What it printed on the standard output and error, once `wait` has read it."""

    @property
    def ended(self) -> bool:
        """True once it has answered, or failed to."""
        return self.process.poll() is not None

    def wait(self) -> None:
        """Blocks until it has ended; after ten minutes, or on Ctrl-C, it is ended by force."""
        try:
            self.told = self.process.communicate(timeout=_LONGEST_SECONDS)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.told = self.process.communicate()
        except BaseException:
            self.process.kill()
            raise

    def answer(self) -> dict[str, Any]:
        """Where the maps are, their size, and what the lens needs. JobError if they were not written."""
        out, errors = self.told or self.process.communicate()
        if self.process.returncode:
            last = (errors.strip().splitlines() or ["the backend gave no reason"])[-1]
            sentence = last.removeprefix("Error: ")
            known = self.process.returncode in {code.value for code in contract.ExitCode}
            if not (known and last.startswith("Error: ")):
                sentence = f"The ST maps were not written: {sentence}"
            raise contract.JobError(sentence, "", self.process.returncode if known else contract.ExitCode.INTERNAL)
        return dict(json.loads(out))


def begin(shot: Path, width: int = 0) -> Asked:
    """Has the maps of a solved shot written into its solve folder, without waiting.

    Args:
        shot: shot folder.
        width: of the maps in pixels; 0: the working frames'.

    Raises:
        contract.JobError: there is no backend, or it cannot be started.
    """
    root = backend.package_root()
    words = ("--json", "stmaps", str(shot.absolute()), "--width", str(width))
    command = contract.python_child(backend.python(), "torch_backend", *words)
    try:
        child = subprocess.Popen(
            **command, env=jobs.backend_environ(root), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, encoding="utf-8", **jobs.detached(),
        )  # fmt: skip
    except OSError as error:
        raise contract.JobError(
            f"The backend did not answer: {error}.", "Set it up again.", contract.ExitCode.ENVIRONMENT
        ) from error
    return Asked(shot, child)


def sentences(facts: dict[str, Any]) -> list[str]:
    """What was written, for people."""
    undistort, redistort = Path(facts["undistort"]), Path(facts["redistort"])
    across, down = facts["overscan_percent"]
    lines = [f"{undistort.name} and {redistort.name} are in {undistort.parent}."]
    if across or down:
        lines.append(
            f"The lens sees {across:.1f} % of the width beyond each side, and {down:.1f} % of the height: "
            "freeze with overscan to have that too."
        )
    return lines


_asked: list[Asked] = []


class SPLANNEQUIN_OT_write_stmaps(bpy.types.Operator):
    """Write two ST maps into the shot's solve folder: one takes the original's lens distortion out, the other puts it
    back onto what you made over the undistorted plate"""

    bl_idname = "splannequin.write_stmaps"
    bl_label = "Write ST Maps"
    bl_options = {"REGISTER"}

    width: bpy.props.IntProperty(
        name="Width", description="Width of the maps in pixels; 0: that of the working frames", default=0, min=0
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Off without a solve, while a step runs, and while the maps are being written."""
        folder = chosen.shot_folder(context.scene)
        watch = supervisor.watch_of(folder) if folder else None
        if watch is None or watch.state is None or not watch.state.solve:
            cls.poll_message_set(tr("Solve the camera first"))
            return False
        if watch.running():
            cls.poll_message_set(tr("A step of this shot is running"))
            return False
        if any(asked.shot == folder for asked in _asked):
            cls.poll_message_set(tr("The maps are being written"))
            return False
        return True

    def execute(self, context: Any) -> set[str]:
        """Starts the backend; headless, waits for it."""
        folder = chosen.shot_folder(context.scene)
        if folder is None:
            return {"CANCELLED"}
        try:
            asked = begin(folder, self.width)
        except contract.JobError as error:
            self.report({"ERROR"}, f"{error.message} {error.hint}".strip())
            return {"CANCELLED"}
        watch = supervisor.watch_of(folder)
        watch.failures.pop("camera", None)
        if not bpy.app.background:
            watch.notes["camera"] = ["Writing the ST maps."]
            _asked.append(asked)
            if not bpy.app.timers.is_registered(_tick):
                bpy.app.timers.register(_tick, first_interval=_TICK_SECONDS, persistent=True)
            return {"FINISHED"}
        asked.wait()
        _finish(asked)
        if "camera" in watch.failures:
            self.report({"ERROR"}, watch.failures["camera"][0])
            return {"CANCELLED"}
        for line in watch.notes["camera"]:
            self.report({"INFO"}, line)
        return {"FINISHED"}


def _finish(asked: Asked) -> None:
    """Puts the answer where the camera's panel shows it."""
    watch = supervisor.watch_of(asked.shot)
    watch.notes.pop("camera", None)
    try:
        watch.notes["camera"] = sentences(asked.answer())
    except (contract.JobError, ValueError, KeyError) as error:
        watch.failures["camera"] = (getattr(error, "message", str(error)), getattr(error, "hint", ""))


def _tick() -> float | None:
    """Takes in the answers of backends that have ended; ends with the last of them."""
    for asked in [a for a in _asked if a.ended]:
        _asked.remove(asked)
        _finish(asked)
        supervisor.redraw()
    return _TICK_SECONDS if _asked else None


def unregister() -> None:
    """Stops waiting. A backend that is writing finishes by itself."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    _asked.clear()


CLASSES = (SPLANNEQUIN_OT_write_stmaps,)
