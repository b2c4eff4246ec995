"""Typed access where Blender's type stubs are loose.

Covers our settings on a scene, and pointers that are typed as optional but are always set where they are used. Does not
import bpy at run time.
Only this file imports types of this package for the type checker alone. At run time, an import of the settings classes
would be circular, because they depend on modules that read settings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    import bpy
    from bpy.stub_internal.rna_enums import IconItems, OperatorReturnItems

    from .settings import SPLANNEQUIN_PG_scene, SPLANNEQUIN_PG_shot

    Outcome = set[OperatorReturnItems]
    """Return value of an operator: FINISHED, CANCELLED, RUNNING_MODAL, PASS_THROUGH, INTERFACE."""
    Icon = IconItems
    """Name of one of Blender's icons."""
    OneShot = SPLANNEQUIN_PG_scene | SPLANNEQUIN_PG_shot
    """Settings of a shot. The scene itself holds those of the selected shot."""
    OperatorBase = bpy.types.Operator
    """Base class of mixins for operators, for the type checker only. Blender does not register such a mixin as an
    operator."""
else:
    Outcome, Icon = set, str
    OneShot = OperatorBase = object

T = TypeVar("T")


class _Drawn(Protocol):
    @property
    def layout(self) -> bpy.types.UILayout | None: ...


def present(pointer: T | None) -> T:
    """The pointer, asserted not to be None: the window manager of a context, the tree of a group."""
    assert pointer is not None
    return pointer


def scene_in(context: bpy.types.Context) -> bpy.types.Scene:
    """The scene of a context."""
    return present(context.scene)


def scene_holding(settings: bpy.types.bpy_struct) -> bpy.types.Scene:
    """The scene that holds these settings."""
    return settings.id_data  # pyright: ignore[reportReturnType]


def layout_of(drawn: _Drawn) -> bpy.types.UILayout:
    """The layout of a panel, menu or dialog while it is drawn."""
    return present(drawn.layout)


def settings_of(scene: bpy.types.Scene) -> SPLANNEQUIN_PG_scene:
    """The artist's settings of a scene."""
    untyped: Any = scene
    return untyped.splannequin


def named(things: bpy.types.bpy_prop_collection[T], name: str) -> T | None:
    """The item of this name in a collection, or None. According to the type stubs, `get` always returns None."""
    found: Any = things.get(name)
    return found


def holds(objects: bpy.types.bpy_prop_collection[bpy.types.Object], item: bpy.types.Object) -> bool:
    """True if a collection has this object. Another one of its name may be linked from another file."""
    found = named(objects, item.name)
    return found == item or (found is not None and any(each == item for each in objects))


def fully_named(objects: bpy.types.bpy_prop_collection[bpy.types.Object], name: str) -> bpy.types.Object | None:
    """The object with this `name_full`, which names the file of a linked one, or None."""
    found = named(objects, name)
    if found is not None and found.name_full == name:
        return found
    return next((each for each in objects if each.name_full == name), None)


def value_of(socket: bpy.types.NodeSocket) -> Any:
    """The value of a socket without a link. Not every type of socket has a value."""
    kind: Any = socket
    return kind.default_value


def set_value(socket: bpy.types.NodeSocket, value: float | tuple[float, ...]) -> None:
    """Sets the value of a socket without a link."""
    kind: Any = socket
    kind.default_value = value


def pixels_of(image: bpy.types.Image) -> Any:
    """All channels of all pixels of an image, bottom row first, to be read or set at once. The stubs type them as a
    float."""
    return image.pixels


def size_of(footage: bpy.types.Image | bpy.types.MovieClip) -> tuple[int, int]:
    """Width and height in pixels. The stubs type the size as an array without items."""
    size: Any = footage.size
    return int(size[0]), int(size[1])


def library_of(block: bpy.types.ID) -> bpy.types.Library | None:
    """The file that a data-block is linked from, or None for a local one. The stubs type the library as always set."""
    return block.library


def camera_of(thing: bpy.types.Object) -> bpy.types.Camera:
    """The camera data of a camera object."""
    return thing.data  # pyright: ignore[reportReturnType]


def mesh_of(thing: bpy.types.Object) -> bpy.types.Mesh:
    """The mesh of a mesh object."""
    return thing.data  # pyright: ignore[reportReturnType]
