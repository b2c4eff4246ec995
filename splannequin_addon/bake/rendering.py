"""The render of a baked shot: its frames, its output paths, and checks that written images are complete.

Every bake works this way: Blender renders into a temporary folder inside the output folder. An image is moved to its
final name after a check that it is complete and flushed to disk. A full disk, a killed process or a second bake of the
same frames therefore leaves earlier images intact.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ...torch_backend import contract
from .. import compat
from ..scene import paths, scene_setup
from ..scene.ownership import BAKES, DIGITS, rendered_of
from . import render_settings

COMPOSITED = "composited"
"""Name of the images' folder inside the output folder of a bake."""
# Name prefix of the temporary folder for one part of a bake.
_PART_PREFIX = ".part-"
# Seconds between two thread switches of Python while Blender renders. One global variable of Blender stores whether
# Python may write to data. A render that begins while a panel is drawn restores the panel's "no" when it ends. Then
# Python can write nothing until Blender is restarted. Measured in 4.3.2 with 8 renders each: at 5 ms, Python's
# default, the fault appeared after the second render. At 2 s it never appeared: a draw is then not interrupted.
_UNINTERRUPTED = 2.0
# Switch interval before the first of the running renders changed it.
_usual_interval = [sys.getswitchinterval()]
_DEFAULT_OUTPUTS = ("/tmp/", "/tmp\\", "//", "")  # noqa: S108  (Blender's defaults for new files)


def frames_of(scene: bpy.types.Scene) -> range:
    """Frames of a bake: the scene's range and step, as Blender renders them."""
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def default_output(shot: Path, take: str) -> Path:
    """Output folder of a bake if the scene has none set."""
    return shot / BAKES / take


def choose_output(scene: bpy.types.Scene, shot: Path, take: str) -> list[str]:
    """Sets the scene's output path if it has Blender's default or that of another take. Returns the changes as
    sentences."""
    now, wanted = scene.render.filepath, output_path(default_output(shot, take))
    is_free = now in _DEFAULT_OUTPUTS or _is_default_of_a_take(now)
    if not is_free or paths.absolute(now) == paths.absolute(wanted):
        return []
    scene.render.filepath = wanted
    return ["The output path is now in the shot's folder."]


def _is_default_of_a_take(path: str) -> bool:
    """True if an output path is the default of an existing take, whose images must not be overwritten by others'."""
    folder = Path(compat.unescaped(paths.absolute(path))).parent
    shot = rendered_of(folder / DIGITS) if Path(path).name == DIGITS else None
    return shot is not None and contract.TakeFolder(contract.ShotFolder(shot).take(folder.name)).facts.is_file()


def output_path(folder: Path) -> str:
    """Output path for a scene that renders into a folder, in the form stored in a .blend."""
    return compat.literal(paths.blend_path(folder / DIGITS))


class Run:
    """A render of a scene's range. Call `begin`, have Blender render the animation, then call `finish`."""

    def __init__(
        self,
        scene: bpy.types.Scene,
        folder: Path | None = None,
        is_exact: bool = False,
        on_frame: Callable[[int, int], None] | None = None,
        check_cancelled: Callable[[], None] | None = None,
        check: Callable[[bpy.types.Scene, Sequence[int]], bool] | None = None,
    ) -> None:
        """
        Args:
            scene: a scene with the freeze inserted.
            folder: output folder for NNNNNN.*; None: the scene's output path.
            is_exact: a frame must be byte-identical on every computer.
            on_frame: called with (frames done, total frames).
            check_cancelled: called between frames; an exception from it ends the render.
            check: called with the scene and its frames before anything is changed. Returns True if the scene's render
                is linked to the freeze. An exception from it prevents the render.
        """
        self._check = check
        self.wanted = list(frames_of(scene))
        self.done: list[int] = []
        """Frames that Blender has rendered and whose images have their final names."""
        self.notes: list[str] = []
        """Sentences about the changes made for the render, and about its images."""
        self.error: BaseException | None = None
        """The exception that ended the render."""
        self.scene_uid = scene.session_uid
        self._folder, self._is_exact = folder, is_exact
        self.on_frame, self._check_cancelled = on_frame, check_cancelled
        self._is_movie = bool(scene.render.is_movie_format)
        self._places: dict[int, Path] = {}
        self._files: dict[int, Path] = {}
        self._unreliable: list[int] = []
        """Frames during which the file was saved, so that they may have used the artist's settings."""
        self._temporary = Path()
        self._room = 8 * scene.render.resolution_x * scene.render.resolution_y
        self._frame = scene.frame_current

    def begin(self, scene: bpy.types.Scene) -> None:
        """Sets up the scene for the render. Raises JobError if the scene cannot be rendered; the scene is then
        unchanged."""
        if not self.wanted:
            raise contract.JobError(
                f"The last frame of {scene.name}, {scene.frame_end}, comes before the first, {scene.frame_start}.",
                "Set the range of frames.",
                contract.ExitCode.BAKE,
            )
        render_settings.restore(scene)  # changes left by a bake that was killed
        has_cg = self._check(scene, self.wanted) if self._check is not None else False
        self._places = _places(scene, self.wanted, self._folder)
        first = self._places[self.wanted[0]].parent
        self._temporary = first / f"{_PART_PREFIX}{uuid.uuid4().hex[:12]}"
        self.notes = render_settings.apply(scene, render_settings.needed(scene, self._is_exact, has_cg))
        self.notes += _output_notes(scene)
        try:
            contract.make_folder(first)  # first and separately, so that an OS error names this folder
            contract.make_folder(self._temporary)
            where = self._temporary / (self._places[self.wanted[0]].name if self._is_movie else DIGITS)
            self._files = _set_output_path(scene, where, self.wanted)
        except BaseException as error:
            self._clean(scene)
            if isinstance(error, OSError):
                raise _readable_error(error) from error
            raise
        if sys.getswitchinterval() < _UNINTERRUPTED:
            _usual_interval[0] = sys.getswitchinterval()
            sys.setswitchinterval(_UNINTERRUPTED)
        render_settings.active_bakes[self.scene_uid] = False
        bpy.app.handlers.render_write.append(self._written)

    def finish(self, scene: bpy.types.Scene | None, is_cancelled: bool = False) -> None:
        """Restores the scene, and moves a movie to its final name.

        Args:
            scene: the scene; None if it no longer exists.
            is_cancelled: the user stopped the render in Blender; missing frames are then no error.

        Raises:
            contract.JobError: an image could not be written. Any other exception that ended the render is raised again.
        """
        with contextlib.suppress(ValueError):
            bpy.app.handlers.render_write.remove(self._written)
        render_settings.active_bakes.pop(self.scene_uid, None)
        if not render_settings.active_bakes:
            sys.setswitchinterval(_usual_interval[0])
        try:
            if self._check_cancelled and self.error is None:
                try:
                    self._check_cancelled()  # a handler of another add-on may have swallowed the request
                except BaseException as error:
                    self.error = error
            if self._unreliable and self.error is None:
                self.error = contract.JobError(
                    f"The file was saved while frame {self._unreliable[0]} was being rendered, so that frame was "
                    "not updated.",
                    "Bake again.",
                    contract.ExitCode.BAKE,
                )
            is_whole = self.error is None and not is_cancelled
            if self._is_movie and self.done:
                self._publish_movie(is_whole)
            lost = [n for n in self.wanted if n not in set(self.done)]
            if is_whole and lost:
                message = f"Blender wrote no image for frame {lost[0]} in {self._folder_name()}."
                raise self._write_error(message, None)
            if self.error is not None:
                raise self.error
        finally:
            self._clean(scene)

    def refused(self, error: RuntimeError) -> None:
        """Stores Blender's error about a scene that it cannot render, or an image that it cannot write."""
        message = " ".join(str(error).split()).removeprefix("Error: ")
        message = message.replace(str(self._temporary), str(self._folder_name()))
        self.error = self.error or self._write_error(f"Blender could not render the scene: {message}", None)

    def is_of(self, scene: bpy.types.Scene) -> bool:
        """True if this run renders the scene."""
        return scene.session_uid == self.scene_uid

    def _clean(self, scene: bpy.types.Scene | None) -> None:
        if scene is not None:
            render_settings.restore(scene)
            if scene.frame_current != self._frame:
                scene.frame_set(self._frame)
        shutil.rmtree(self._temporary, ignore_errors=True)

    def _written(self, scene: bpy.types.Scene, *_: object) -> None:
        """Handler: Blender has written a frame. In a window it runs in another thread, so its only bpy access ends the
        render."""
        if not self.is_of(scene):
            return
        number = scene.frame_current
        try:
            if self.error is None and number in self._files:
                if render_settings.active_bakes.get(self.scene_uid):
                    render_settings.active_bakes[self.scene_uid] = False
                    self._unreliable.append(number)
                    return
                if not self._is_movie:
                    self._publish(self._files[number], self._places[number], f"frame {number}")
                self.done.append(number)
                if self.on_frame:
                    self.on_frame(len(self.done), len(self.wanted))
                if self._check_cancelled:
                    self._check_cancelled()
        except BaseException as error:  # Blender would print it and continue to render
            self.error = self.error or (_readable_error(error) if isinstance(error, OSError) else error)
        if self.error is not None:
            # The render loop continues from this frame number: after the last frame it ends and closes its files.
            scene.frame_current = scene.frame_end

    def _publish(self, path: Path, place: Path, what: str) -> None:
        """Moves a complete file to its final name. Raises JobError if it is incomplete, or OSError."""
        if not contract.is_whole_picture(path):
            raise self._write_error(f"Blender wrote {what} only partially to {place.parent}.", path)
        # Otherwise a power cut after the rename could leave an empty file under the final name.
        with open(path, "rb+") as file:
            os.fsync(file.fileno())
        contract.make_folder(place.parent)
        contract.replace_file(path, place)

    def _publish_movie(self, is_whole: bool) -> None:
        """Moves a movie to its final name. An incomplete movie does not replace an existing file."""
        folder = self._places[self.wanted[0]].parent
        for path in sorted(self._temporary.iterdir()):
            place = folder / path.name
            if is_whole or not place.exists():
                try:
                    self._publish(path, place, path.name)
                except (contract.JobError, OSError) as error:
                    self.error = self.error or (_readable_error(error) if isinstance(error, OSError) else error)

    def _write_error(self, message: str, path: Path | None) -> contract.JobError:
        """The error for an image that Blender wrote partly or not at all: a full disk, or `message`.

        Args:
            message: message if the disk is not full.
            path: the incomplete image file, or None.
        """
        folder = self._folder_name()
        # A truncated file remains on the disk and uses the last free space.
        if is_full(self._temporary, self._room if path is None or not path.exists() else 1 << 18):
            return contract.disk_error(folder)
        return contract.JobError(
            message, f"Make sure that {folder} is writable. Blender's console may show details.", contract.ExitCode.BAKE
        )

    def _folder_name(self) -> Path:
        return self._places[self.wanted[0]].parent


def render(
    scene: bpy.types.Scene,
    folder: Path,
    png: bool = True,
    on_frame: Callable[[int, int], None] | None = None,
    check_cancelled: Callable[[], None] | None = None,
    is_part: bool = False,
    say: Callable[[str], None] | None = None,
    check: Callable[[bpy.types.Scene, Sequence[int]], bool] | None = None,
) -> list[int]:
    """Renders the scene's range through the compositor to folder/NNNNNN.*, blocking. Returns the frame numbers.

    Args:
        scene: a scene with the freeze inserted.
        folder: output folder.
        png: set the scene's output format to 8-bit RGB PNG; otherwise keep it.
        on_frame: called with (frames done, total frames).
        check_cancelled: called between frames; an exception from it ends the bake. Frames written so far stay; a movie
            file is closed with them.
        is_part: this is one of several parts of a bake, rendered on several computers.
        say: called with each sentence about settings that the render changes temporarily.
        check: see `Run`.

    Raises:
        contract.JobError: Blender refused, a setting prevents the render, or an image could not be written.
    """
    if png:
        compat.set_png(scene.render.image_settings)
    elif is_part and scene.render.is_movie_format:
        raise contract.JobError(
            "The .blend file outputs a movie, which cannot be rendered in parts.",
            "Choose an image format for the output.",
            contract.ExitCode.BAKE,
        )
    run = Run(scene, folder, png or is_part, on_frame, check_cancelled, check)
    run.begin(scene)
    for line in run.notes if say else ():
        say(line)  # pyright: ignore[reportOptionalCall]
    try:
        bpy.ops.render.render(animation=True, scene=scene.name)
    except RuntimeError as error:
        run.refused(error)
    except BaseException as error:
        run.error = run.error or error
    run.finish(scene)
    return run.wanted


def is_full(folder: Path, size: int) -> bool:
    """True if the disk of a folder, or the user's quota, has no room for `size` bytes. Writes a test file."""
    probe = folder / f".room-{uuid.uuid4().hex[:12]}"
    try:
        with open(probe, "wb") as file:
            file.write(bytes(size))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return contract.is_disk_full(error)
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)
    return False


def gathered(scene: bpy.types.Scene, folder: Path, png: bool) -> list[int]:
    """The scene's frames if `folder` has a complete image of each. Removes temporary folders of killed parts.

    Raises JobError, which names the first missing or incomplete frame.
    """
    if png:
        compat.set_png(scene.render.image_settings)
    wanted = list(frames_of(scene))
    lost = [n for n, path in _places(scene, wanted, folder).items() if not contract.is_whole_picture(path)]
    if lost:
        raise contract.JobError(
            f"{folder} lacks {len(lost)} of {len(wanted)} frames, the first is {lost[0]}.",
            "Bake the part with the missing frames again.",
            contract.ExitCode.BAKE,
        )
    for left in folder.glob(f"{_PART_PREFIX}*"):
        shutil.rmtree(left, ignore_errors=True)
    return wanted


def _places(scene: bpy.types.Scene, frames: list[int], folder: Path | None) -> dict[int, Path]:
    """Frame -> its output file, as Blender names it."""
    if folder is None:
        return _named(scene, frames)
    before = scene.render.filepath, scene.render.use_file_extension
    try:
        scene.render.use_file_extension = True
        # Uses the temporary directory, because Blender creates the folder of a movie's path.
        scene.render.filepath = compat.literal(os.path.join(tempfile.gettempdir(), DIGITS))
        return {n: folder / path.name for n, path in _named(scene, frames).items()}
    finally:
        scene.render.filepath, scene.render.use_file_extension = before


def _named(scene: bpy.types.Scene, frames: list[int]) -> dict[int, Path]:
    """Frame -> the file that Blender writes. Raises JobError if Blender cannot resolve the scene's output path."""
    try:
        return {n: Path(os.path.abspath(bpy.path.abspath(scene.render.frame_path(frame=n)))) for n in frames}
    except RuntimeError as error:
        raise contract.JobError(
            f"Blender cannot use the output path of {scene.name}: {' '.join(str(error).split())}",
            "Choose another path. To use a brace in a name, write it twice.",
            contract.ExitCode.BAKE,
        ) from error


def _set_output_path(scene: bpy.types.Scene, pattern: Path, frames: list[int]) -> dict[int, Path]:
    """Sets the scene's output path to a literal path. Returns frame -> file. Raises JobError if Blender cannot use
    it."""
    text = os.path.abspath(pattern)
    if os.name == "posix":
        text = "/" + text.lstrip("/")  # two slashes would mean relative to the .blend
    try:
        render_settings.set_noted(scene, "render", "filepath", compat.literal(text))
        files = _named(scene, frames)
    except (ValueError, contract.JobError) as error:  # ValueError: the name is not valid UTF-8
        raise _unusable(pattern.parent.parent) from error
    if any(path.parent != Path(text).parent for path in files.values()):  # truncated, or a variable expanded
        raise _unusable(pattern.parent.parent)
    return files


def _unusable(folder: Path) -> contract.JobError:
    return contract.JobError(
        f"Blender cannot write images to {contract.printable(str(folder), 300)}: the path is too long or has "
        "unsupported characters.",
        "Choose another output folder.",
        contract.ExitCode.USAGE,
    )


def _readable_error(error: OSError) -> BaseException:
    return contract.path_error(error) or error


def _output_notes(scene: bpy.types.Scene) -> list[str]:
    """Sentences about output settings of the artist that are easy to overlook."""
    render, found = scene.render, list[str]()
    if render.resolution_percentage != 100:
        width, height = scene_setup.render_size(scene)
        found.append(f"The scene renders at {render.resolution_percentage} %: images have {width} x {height} pixels.")
    if render.image_settings.color_mode == "BW":
        found.append("The scene's output is black and white.")
    return found
