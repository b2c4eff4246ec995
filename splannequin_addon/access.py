"""What Blender's types leave open, settled in one place for the checker: our settings on a scene, and pointers that may
be empty by their type and are not where we ask for them. No bpy at run time, and nothing of the stubs.

This is the one file that imports types of ours for the checker alone: those of the settings stand above everything that
reads them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    import bpy
    from bpy.stub_internal.rna_enums import IconItems, OperatorReturnItems

    from .settings import SPLANNEQUIN_PG_scene, SPLANNEQUIN_PG_shot

    Outcome = set[OperatorReturnItems]
    """What an operator returns: FINISHED, CANCELLED, RUNNING_MODAL, PASS_THROUGH, INTERFACE."""
    Icon = IconItems
    """Name of one of Blender's icons."""
    OneShot = SPLANNEQUIN_PG_scene | SPLANNEQUIN_PG_shot
    """The settings of a shot: the chosen one's are the scene's."""
    OperatorBase = bpy.types.Operator
    """What a class is that operators have in common, to the checker. Blender takes it for no operator."""
else:
    Outcome, Icon = set, str
    OneShot = OperatorBase = object

T = TypeVar("T")


class _Drawn(Protocol):
    @property
    def layout(self) -> bpy.types.UILayout | None: ...


def present(pointer: T | None) -> T:
    """A pointer that is never empty where it is used: the window manager of a context, the tree of a group."""
    assert pointer is not None
    return pointer


def scene_in(context: bpy.types.Context) -> bpy.types.Scene:
    """The scene that a context is about."""
    return present(context.scene)


def scene_holding(settings: bpy.types.bpy_struct) -> bpy.types.Scene:
    """The scene whose settings these are."""
    return settings.id_data  # pyright: ignore[reportReturnType]


def layout_of(drawn: _Drawn) -> bpy.types.UILayout:
    """The layout of a panel, menu or dialog while it is drawn."""
    return present(drawn.layout)


def settings_of(scene: bpy.types.Scene) -> SPLANNEQUIN_PG_scene:
    """What the artist set in a scene."""
    held: Any = scene
    return held.splannequin


def named(things: bpy.types.bpy_prop_collection[T], name: str) -> T | None:
    """What is called so in a collection, None if nothing is. Its own `get`, say its types, finds nothing ever."""
    found: Any = things.get(name)
    return found


def value_of(socket: bpy.types.NodeSocket) -> Any:
    """The value that a socket has where nothing is led into it. Not every kind of sockets has one."""
    kind: Any = socket
    return kind.default_value


def set_value(socket: bpy.types.NodeSocket, value: float | tuple[float, ...]) -> None:
    """Sets it."""
    kind: Any = socket
    kind.default_value = value


def pixels_of(image: bpy.types.Image) -> Any:
    """All channels of all pixels of an image, bottom row first, to be read or set whole. A float, says its type."""
    return image.pixels


def size_of(footage: bpy.types.Image | bpy.types.MovieClip) -> tuple[int, int]:
    """Width and height in pixels. An array without items, says its type."""
    size: Any = footage.size
    return int(size[0]), int(size[1])


def library_of(block: bpy.types.ID) -> bpy.types.Library | None:
    """The file that a data-block is linked from, None of one of this file. Its types say that there always is one."""
    return block.library


def camera_of(thing: bpy.types.Object) -> bpy.types.Camera:
    """The lens of an object that is a camera."""
    return thing.data  # pyright: ignore[reportReturnType]


def mesh_of(thing: bpy.types.Object) -> bpy.types.Mesh:
    """The mesh of an object that is one."""
    return thing.data  # pyright: ignore[reportReturnType]
