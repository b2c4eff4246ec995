"""The add-on's preferences: set-up, check, repair and removal of the backend's environment."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import Icon, Outcome, layout_of
from ..process import backend, children, environment, job_timer
from ..properties import EnumProperty, StringProperty
from ..translations import tr
from .sentences import wrap

# Horizontal space in pixels that is not available to text: the page's margins and boxes.
_INSET = 150
# Width of the dialog in pixels.
_DIALOG = 640
_setup: environment.SetUp | None = None
_findings: list[str] = []


def _search_again(preferences: bpy.types.bpy_struct, context: bpy.types.Context) -> None:
    """Property update: the page shows the backend of the new path at once."""
    backend.clear_state()


class SPLANNEQUIN_preferences(bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > Splannequin."""

    bl_idname = backend.PACKAGE

    backend_python = StringProperty(
        name="Backend Python",
        description="Python interpreter of an existing backend environment; empty: detected automatically",
        subtype="FILE_PATH",
        update=_search_again,
    )
    backend_folder = StringProperty(
        name="Folder",
        description="Folder in which Set Up Backend creates the environment; empty: a short path in your home folder",
        subtype="DIR_PATH",
        update=_search_again,
    )
    backend_wheels = StringProperty(
        name="Wheels",
        description="Folder of wheels from which Set Up Backend installs offline; empty: download from the internet",
        subtype="DIR_PATH",
    )
    device = EnumProperty(
        name="Device",
        description="Device on which the backend trains and freezes",
        items=[
            ("auto", "Automatic", "The NVIDIA card if a usable one is present, otherwise the processor"),
            ("cpu", "Processor", "Always the processor"),
            ("cuda", "NVIDIA Card", "Only the NVIDIA card. Without one, jobs stop with an error"),
        ],
    )

    def draw(self, context: bpy.types.Context) -> None:
        """Draws the backend in use, its set-up and the device."""
        layout = layout_of(self)
        python, trouble = backend.state()
        if trouble is None:
            _say(layout, f"In use: {python}", "CHECKMARK")
        elif not busy():  # during a set-up, the missing backend is expected
            _warn(layout, trouble.message, trouble.hint)
        for line in _findings:
            _say(layout, line, "DOT")
        self._draw_setup(trouble is None)
        layout.prop(self, "device")
        layout.prop(self, "backend_python")

    def _draw_setup(self, has_backend: bool) -> None:
        box = layout_of(self).box()
        row = box.row()
        row.enabled = not busy()
        row.prop(self, "backend_folder")
        if not self.backend_folder:
            _say(box, f"Without a folder, the backend is installed in {environment.default_folder()}.", "INFO")
        row = box.row()
        row.enabled = not busy()
        row.prop(self, "backend_wheels")
        row = box.row(align=True)
        ours = backend.venv_python(backend.folder() / ".venv").is_file()
        if busy():
            row.operator("splannequin.cancel_setup", icon="CANCEL")
        else:
            row.operator("splannequin.set_up", text="Repair" if ours else "Set Up Backend", icon="IMPORT")
            row.operator("splannequin.check_backend", icon="VIEWZOOM")
            if ours:
                row.operator("splannequin.remove_backend", icon="TRASH")
        if _setup is not None:
            for line in _setup.output if _setup.running else []:
                _say(box, line)
            if _setup.failure:
                _warn(box, _setup.failure, "Repair continues where the set-up stopped.")
        elif not has_backend:
            _say(box, f"Creates a separate Python environment, {environment.SIZE}.", "INFO")
            _say(box, f"It installs {environment.LICENCES}.", "BLANK1")
        if _is_offline():
            _say(box, _OFFLINE, "ERROR")


def _say(layout: bpy.types.UILayout, text: str, icon: Icon = "NONE") -> None:
    """Draws a sentence, wrapped to the width of the page."""
    wrap(layout, bpy.context, text, icon, margin=_INSET)


def _warn(layout: bpy.types.UILayout, message: str, hint: str) -> None:
    """Draws an error and its remedy in red."""
    column = layout.column(align=True)
    column.alert = True
    _say(column, message, "ERROR")
    _say(column, hint, "BLANK1")


_OFFLINE = (
    "Blender's online access is turned off. Allow it in Preferences > System > Network, or choose a "
    "folder of wheels in the add-on's preferences."
)


def _wheels() -> Path | None:
    """The folder of wheels to install from; None to download."""
    addon = bpy.context.preferences.addons.get(backend.PACKAGE)
    chosen = str(getattr(addon.preferences, "backend_wheels", "")) if addon and addon.preferences else ""
    return Path(bpy.path.abspath(chosen)) if chosen else None


def _is_offline() -> bool:
    """True if a set-up needs the internet but Blender has no online access."""
    return not bpy.app.online_access and _wheels() is None


def busy() -> bool:
    """True while a set-up runs."""
    return _setup is not None and _setup.running


def running_setup() -> environment.SetUp | None:
    """The running set-up, or None."""
    return _setup if busy() else None


class SPLANNEQUIN_OT_set_up(bpy.types.Operator):
    """Download and install the backend's packages into a separate environment"""

    bl_idname = "splannequin.set_up"
    bl_label = "Set Up Backend"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled while a set-up runs."""
        return not busy()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for confirmation."""
        return context.window_manager.invoke_props_dialog(self, width=_DIALOG, confirm_text="Install")

    def draw(self, context: bpy.types.Context) -> None:
        """Draws the downloads, their sources and checks, and the way to the setting for online access."""
        column = layout_of(self).column(align=True)
        wheels = _wheels()
        size, places = environment.SIZE, environment.sources()
        source = f"Needs {size}, downloaded from {places}." if wheels is None else f"Needs {size}, taken from {wheels}."
        for text in (
            f"Creates a Python environment in {backend.folder()}",
            source,
            f"Installs {environment.LICENCES}.",
            "The SHA-256 of each file is compared with this add-on's list before it is installed.",
            "A PyTorch build that is not in the list is compared with the hash stated by its package index.",
            "Nothing is changed in Blender's own Python.",
        ):
            wrap(column, context, text, width=_DIALOG)
        if _is_offline():
            column = layout_of(self).column(align=True)
            wrap(column, context, _OFFLINE, "ERROR", width=_DIALOG)
            # Only the artist may turn it on: https://docs.blender.org/manual/en/latest/advanced/extensions/addons.html
            if not bpy.app.online_access_override:
                column.operator("screen.userpref_show", text="Open System Preferences").section = "SYSTEM"

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts the set-up. Without a window, waits for its end."""
        global _setup
        if _is_offline():
            self.report({"ERROR"}, tr(_OFFLINE))
            return {"CANCELLED"}
        try:
            _setup = environment.start(backend.folder(), sys.executable, backend.package_root(), _wheels())
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}"))
            return {"CANCELLED"}
        _findings.clear()
        if not bpy.app.background:
            job_timer.call_until_false(_follow_setup)
            return {"FINISHED"}
        environment.wait(_setup)
        backend.clear_state()
        if _setup.failure:
            self.report({"ERROR"}, tr(_setup.failure))
            return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_OT_cancel_setup(bpy.types.Operator):
    """Stop the set-up. It continues from there when it is started again"""

    bl_idname = "splannequin.cancel_setup"
    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Ends the set-up's process. Finished downloads and packages are kept."""
        if _setup is not None:
            environment.cancel(_setup)
        return {"FINISHED"}


class SPLANNEQUIN_OT_check_backend(bpy.types.Operator):
    """Start the backend once and show what it can do on this computer"""

    bl_idname = "splannequin.check_backend"
    bl_label = "Check Backend"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts the backend's doctor. Without a window, waits for it."""
        _findings[:] = ["Checking the backend."]
        try:
            question = backend.begin_doctor()
        except contract.JobError as error:
            _findings.clear()
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}"))
            return {"CANCELLED"}
        if bpy.app.background:
            question.wait(120.0)
            _show_findings(question)
            for line in _findings:
                self.report({"INFO"}, tr(line))
            return {"FINISHED"}
        _checks.append(question)
        job_timer.when_answered(question, lambda: _show_findings(question))
        return {"FINISHED"}


class SPLANNEQUIN_OT_remove_backend(bpy.types.Operator):
    """Delete the environment that Set Up Backend created. Shots and their runs are kept"""

    bl_idname = "splannequin.remove_backend"
    bl_label = "Remove Backend"
    bl_options = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for confirmation, with the folder that would be deleted."""
        return context.window_manager.invoke_confirm(
            self, event, title=tr("Remove Backend"), message=tr(f"Deletes {backend.folder() / '.venv'}."),
            confirm_text=tr("Remove"), translate=False,
        )  # fmt: skip

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Deletes the environment, unless it is in use."""
        if busy():
            self.report({"ERROR"}, tr("The environment was not removed, because it is being set up"))
            return {"CANCELLED"}
        for watch in job_timer.watches():
            if any(not job.ended for job in watch.jobs.values()):
                name = watch.shot.name
                self.report(
                    {"ERROR"},
                    tr(
                        f"The environment was not removed, because a step of {name} is running. Wait for it or "
                        "cancel it."
                    ),
                )
                return {"CANCELLED"}
        try:
            was_removed = environment.remove(backend.folder(), wait=bpy.app.background)
        except environment.AtWork as error:
            self.report({"ERROR"}, tr(_at_work(error.pid)))
            return {"CANCELLED"}
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, tr(f"The environment was not removed: {error}"))
            return {"CANCELLED"}
        _findings.clear()
        backend.clear_state()
        sentence = "The backend's environment was removed" if was_removed else "There was nothing to remove"
        self.report({"INFO"}, tr(sentence))
        return {"FINISHED"}


def _at_work(pid: int) -> str:
    return (
        "The environment was not removed, because another Blender, a live view or a command line uses it "
        f"(process {pid}). Wait for it or end it."
    )


# Doctor questions without an answer.
_checks: list[children.Question] = []


def _show_findings(question: children.Question) -> None:
    """Shows the result of a doctor question."""
    if question in _checks:
        _checks.remove(question)
    try:
        _findings[:] = environment.findings(backend.diagnosis(question))
    except (contract.JobError, ValueError, KeyError) as error:
        _findings[:] = [f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()]
    _redraw()


def _follow_setup() -> bool:
    """Timer callback while a set-up runs. Checks the backend after a successful set-up."""
    if _setup is None:
        return False
    if environment.poll(_setup):
        _redraw()
    if not _setup.running and not _setup.failure:
        ops: Any = bpy.ops  # our operators are not in the stubs
        ops.splannequin.check_backend()
    return _setup.running


def _redraw() -> None:
    """Shows the backend's new state in the sidebars and the preferences."""
    backend.clear_state()
    job_timer.redraw()
    job_timer.redraw(("WINDOW",), "PREFERENCES")


_CLASSES = (
    SPLANNEQUIN_preferences,
    SPLANNEQUIN_OT_set_up,
    SPLANNEQUIN_OT_cancel_setup,
    SPLANNEQUIN_OT_check_backend,
    SPLANNEQUIN_OT_remove_backend,
)


def register() -> None:
    """Registers the preferences and their operators."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Undoes `register`. A running set-up continues."""
    _checks.clear()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
