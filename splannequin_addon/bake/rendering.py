"""The render of a baked shot: which frames, where to, and as whole pictures on disk.

Every bake goes this way: Blender renders into a folder beside the output, and a picture takes its name once it was
found whole and lies on the disk. So a full disk, a kill or a second bake of the same frames leaves earlier pictures as
they were.
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
from ..scene.ownership import BAKES, DIGITS
from . import render_settings

COMPOSITED = "composited"
"""Folder of the pictures, in the output folder of a bake."""
_BESIDE = ".part-"
"""Begins the name of a folder in which a part of a bake is made."""
_UNINTERRUPTED = 2.0
"""Seconds between two thread switches of Python while Blender renders.

Blender keeps in one global whether Python may write. A render that begins while a panel is drawn restores the panel's
"no" at its end, and Python can write nothing until Blender is started again. It was seen in 4.3.2, of 8 renders after
the second at Python's usual 5 ms, and after none at 2 s: a draw that is not interrupted leaves no chance for it."""
_usual_interval = [sys.getswitchinterval()]
"""The interval before the first of the running renders changed it."""
_DEFAULT_OUTPUTS = ("/tmp/", "/tmp\\", "//", "")  # noqa: S108  (what Blender gives a new file)


def frames_of(scene: bpy.types.Scene) -> range:
    """Frames that a bake is about: the scene's range and step, as Blender renders them."""
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def default_output(shot: Path, take: str) -> Path:
    """Where a bake goes if the scene names no folder of its own."""
    return shot / BAKES / take


def choose_output(scene: bpy.types.Scene, shot: Path, take: str) -> list[str]:
    """Gives the scene an output path if it still has Blender's default; returns what was changed, in words."""
    if scene.render.filepath not in _DEFAULT_OUTPUTS:
        return []
    scene.render.filepath = output_path(default_output(shot, take))
    return ["The output path is now in the shot's folder."]


def output_path(folder: Path) -> str:
    """The output path of a scene whose pictures go to a folder, as a .blend holds it."""
    return compat.literal(paths.blend_path(folder / DIGITS))


class Run:
    """A render of a scene's range. `begin`, have Blender render the animation, `finish`."""

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
            folder: where pictures go, as NNNNNN.*; None: to the scene's output path.
            is_exact: the same frame has to be the same bytes, whoever renders it.
            on_frame: called with (frames done, frames in all).
            check_cancelled: called between frames; what it raises ends the render.
            check: called before anything is changed, with the scene and its frames; True if the scene's own render is
                led into the freeze. What it raises stands against the render.
        """
        self._check = check
        self.wanted = list(frames_of(scene))
        self.done: list[int] = []
        """Frames that Blender has rendered; their pictures are in their places."""
        self.said: list[str] = []
        """What was changed for the render, and what its pictures are, a sentence each."""
        self.error: BaseException | None = None
        """What ended it."""
        self.scene_uid = scene.session_uid
        self._folder, self._is_exact = folder, is_exact
        self.on_frame, self._check_cancelled = on_frame, check_cancelled
        self._is_movie = bool(scene.render.is_movie_format)
        self._places: dict[int, Path] = {}
        self._made: dict[int, Path] = {}
        self._spoilt: list[int] = []
        """Frames during which the file was saved: the scene had the artist's settings for a moment."""
        self._beside = Path()
        self._room = 8 * scene.render.resolution_x * scene.render.resolution_y
        self._frame = scene.frame_current

    def begin(self, scene: bpy.types.Scene) -> None:
        """Sets the scene up for the render. JobError if it cannot be rendered so; it is as it was then."""
        if not self.wanted:
            raise contract.JobError(
                f"The last frame of {scene.name}, {scene.frame_end}, comes before the first, {scene.frame_start}.",
                "Set the range of frames.",
                contract.ExitCode.BAKE,
            )
        render_settings.restore(scene)  # what a bake left that was killed
        has_cg = self._check(scene, self.wanted) if self._check is not None else False
        self._places = _places(scene, self.wanted, self._folder)
        first = self._places[self.wanted[0]].parent
        self._beside = first / f"{_BESIDE}{uuid.uuid4().hex[:12]}"
        self.said = render_settings.apply(scene, render_settings.needed(scene, self._is_exact, has_cg))
        self.said += _told(scene)
        try:
            contract.make_folder(first)  # apart, for what the system says of it
            contract.make_folder(self._beside)
            where = self._beside / (self._places[self.wanted[0]].name if self._is_movie else DIGITS)
            self._made = _aimed(scene, where, self.wanted)
        except BaseException as error:
            self._clean(scene)
            if isinstance(error, OSError):
                raise _in_words(error) from error
            raise
        if sys.getswitchinterval() < _UNINTERRUPTED:
            _usual_interval[0] = sys.getswitchinterval()
            sys.setswitchinterval(_UNINTERRUPTED)
        render_settings.going_on[self.scene_uid] = False
        bpy.app.handlers.render_write.append(self._written)

    def finish(self, scene: bpy.types.Scene | None, is_cancelled: bool = False) -> None:
        """Puts the scene back, and a movie into its place.

        Args:
            scene: the scene; None if it is gone.
            is_cancelled: somebody stopped the render in Blender: what lacks is no failure.

        Raises:
            contract.JobError: a picture could not be written; whatever ended it otherwise.
        """
        with contextlib.suppress(ValueError):
            bpy.app.handlers.render_write.remove(self._written)
        render_settings.going_on.pop(self.scene_uid, None)
        if not render_settings.going_on:
            sys.setswitchinterval(_usual_interval[0])
        try:
            if self._check_cancelled and self.error is None:
                try:
                    self._check_cancelled()  # asked for while Blender was at work, in a handler of someone else's
                except BaseException as error:
                    self.error = error
            if self._spoilt and self.error is None:
                self.error = contract.JobError(
                    f"The file was saved while frame {self._spoilt[0]} was rendered: that frame is not new.",
                    "Bake again.",
                    contract.ExitCode.BAKE,
                )
            is_whole = self.error is None and not is_cancelled
            if self._is_movie and self.done:
                self._publish_movie(is_whole)
            lost = [n for n in self.wanted if n not in set(self.done)]
            if is_whole and lost:
                message = f"Blender wrote no picture for frame {lost[0]} in {self._folder_name()}."
                raise self._or_full(message, None)
            if self.error is not None:
                raise self.error
        finally:
            self._clean(scene)

    def refused(self, error: RuntimeError) -> None:
        """Notes what Blender says of a scene that it does not render, or of a picture that it could not write."""
        message = " ".join(str(error).split()).removeprefix("Error: ")
        message = message.replace(str(self._beside), str(self._folder_name()))
        self.error = self.error or self._or_full(f"Blender could not render the scene: {message}", None)

    def is_of(self, scene: bpy.types.Scene) -> bool:
        """True if it renders this scene."""
        return scene.session_uid == self.scene_uid

    def _clean(self, scene: bpy.types.Scene | None) -> None:
        if scene is not None:
            render_settings.restore(scene)
            if scene.frame_current != self._frame:
                scene.frame_set(self._frame)
        shutil.rmtree(self._beside, ignore_errors=True)

    def _written(self, scene: bpy.types.Scene, *_: object) -> None:
        """Handler: Blender has written a frame. In a window this is another thread: of bpy it only ends the render."""
        if not self.is_of(scene):
            return
        number = scene.frame_current
        try:
            if self.error is None and number in self._made:
                if render_settings.going_on.get(self.scene_uid):
                    render_settings.going_on[self.scene_uid] = False
                    self._spoilt.append(number)
                    return
                if not self._is_movie:
                    self._publish(self._made[number], self._places[number], f"frame {number}")
                self.done.append(number)
                if self.on_frame:
                    self.on_frame(len(self.done), len(self.wanted))
                if self._check_cancelled:
                    self._check_cancelled()
        except BaseException as error:  # Blender prints what a handler raises, and renders on
            self.error = self.error or (_in_words(error) if isinstance(error, OSError) else error)
        if self.error is not None:
            # The render's loop counts on from here: at the last frame it ends, and closes what it writes to.
            scene.frame_current = scene.frame_end

    def _publish(self, made: Path, place: Path, what: str) -> None:
        """Gives a whole file its name. JobError if it is not whole; OSError."""
        if not contract.is_whole_picture(made):
            raise self._or_full(f"Blender wrote {what} only in part to {place.parent}.", made)
        with open(made, "rb+") as file:
            os.fsync(file.fileno())
        contract.make_folder(place.parent)
        contract.replace_file(made, place)

    def _publish_movie(self, is_whole: bool) -> None:
        """Gives a movie its name. One that was stopped takes none that is there already."""
        folder = self._places[self.wanted[0]].parent
        for made in sorted(self._beside.iterdir()):
            place = folder / made.name
            if is_whole or not place.exists():
                try:
                    self._publish(made, place, made.name)
                except (contract.JobError, OSError) as error:
                    self.error = self.error or (_in_words(error) if isinstance(error, OSError) else error)

    def _or_full(self, message: str, made: Path | None) -> contract.JobError:
        """What to say of a picture that Blender did not write, or not whole: that the disk is full, if it is.

        Args:
            message: what to say otherwise.
            made: what there is of the picture.
        """
        folder = self._folder_name()
        # A truncated file still lies on the disk and occupies the last free space.
        if is_full(self._beside, self._room if made is None or not made.exists() else 1 << 18):
            return contract.disk_error(folder)
        return contract.JobError(
            message, f"Can {folder} be written to? Blender's console may say more.", contract.ExitCode.BAKE
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
    """Renders the scene's range through the compositor to folder/NNNNNN.*, blocking; returns the frames written.

    Args:
        scene: a scene with the freeze inserted.
        folder: where the pictures go.
        png: make 8-bit RGB PNG the scene's output format; else it stays what it is.
        on_frame: called with (frames done, frames in all).
        check_cancelled: called between frames; what it raises ends the bake. Frames written so far stay, a movie file
            is closed and holds them.
        is_part: several computers make one bake.
        say: called with what was changed for the render, and is set back.
        check: see `Run`.

    Raises:
        contract.JobError: Blender refused, a setting stands against it, or a picture could not be written.
    """
    if png:
        compat.set_png(scene.render.image_settings)
    elif is_part and scene.render.is_movie_format:
        raise contract.JobError(
            "The .blend writes a movie, which cannot be made in parts.",
            "Choose pictures as its output format.",
            contract.ExitCode.BAKE,
        )
    run = Run(scene, folder, png or is_part, on_frame, check_cancelled, check)
    run.begin(scene)
    for line in run.said if say else ():
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
    """True if the disk of a folder has no room, or its owner no quota, for a file of `size` bytes: it is tried."""
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
    """The scene's range, if all of its pictures are in `folder`; what killed parts left there is removed.

    JobError names the first that lacks or is not whole.
    """
    if png:
        compat.set_png(scene.render.image_settings)
    wanted = list(frames_of(scene))
    lost = [n for n, path in _places(scene, wanted, folder).items() if not contract.is_whole_picture(path)]
    if lost:
        raise contract.JobError(
            f"{folder} lacks {len(lost)} of {len(wanted)} frames, the first is {lost[0]}.",
            "Bake the part that it belongs to again.",
            contract.ExitCode.BAKE,
        )
    for left in folder.glob(f"{_BESIDE}*"):
        shutil.rmtree(left, ignore_errors=True)
    return wanted


def _places(scene: bpy.types.Scene, frames: list[int], folder: Path | None) -> dict[int, Path]:
    """Frame -> file that its picture goes to, as Blender names it."""
    if folder is None:
        return _named(scene, frames)
    before = scene.render.filepath, scene.render.use_file_extension
    try:
        scene.render.use_file_extension = True
        # Of a movie's name Blender makes the folder.
        scene.render.filepath = compat.literal(os.path.join(tempfile.gettempdir(), DIGITS))
        return {n: folder / path.name for n, path in _named(scene, frames).items()}
    finally:
        scene.render.filepath, scene.render.use_file_extension = before


def _named(scene: bpy.types.Scene, frames: list[int]) -> dict[int, Path]:
    """Frame -> file that Blender writes it to. JobError if Blender cannot make sense of the scene's output path."""
    try:
        return {n: Path(os.path.abspath(bpy.path.abspath(scene.render.frame_path(frame=n)))) for n in frames}
    except RuntimeError as error:
        raise contract.JobError(
            f"Blender cannot use the output path of {scene.name}: {' '.join(str(error).split())}",
            "Choose another one; for a brace in a name write two.",
            contract.ExitCode.BAKE,
        ) from error


def _aimed(scene: bpy.types.Scene, pattern: Path, frames: list[int]) -> dict[int, Path]:
    """Has the scene write to a path, taken by the letter; returns frame -> file. JobError if Blender cannot."""
    text = os.path.abspath(pattern)
    if os.name == "posix":
        text = "/" + text.lstrip("/")  # two slashes would mean: beside the .blend
    try:
        render_settings.set_noted(scene, "render", "filepath", compat.literal(text))
        made = _named(scene, frames)
    except (ValueError, contract.JobError) as error:  # ValueError: a name that is no UTF-8
        raise _unusable(pattern.parent.parent) from error
    if any(path.parent != Path(text).parent for path in made.values()):  # it was cut off, or something was filled in
        raise _unusable(pattern.parent.parent)
    return made


def _unusable(folder: Path) -> contract.JobError:
    return contract.JobError(
        f"Blender cannot write pictures to {contract.printable(str(folder), 300)}: the name is too long, or has "
        "letters that Blender does not know.",
        "Choose another output folder.",
        contract.ExitCode.USAGE,
    )


def _in_words(error: OSError) -> BaseException:
    return contract.path_error(error) or error


def _told(scene: bpy.types.Scene) -> list[str]:
    """Sentences about output settings of the artist that are easily overlooked."""
    render, found = scene.render, list[str]()
    if render.resolution_percentage != 100:
        width, height = scene_setup.render_size(scene)
        found.append(f"The scene renders at {render.resolution_percentage} %: pictures have {width} x {height} pixels.")
    if render.image_settings.color_mode == "BW":
        found.append("The scene's output is black and white.")
    return found
