"""Blender's properties with types for a type checker: in a class, `clip = StringProperty(...)` is a str attribute.

Blender requires properties as annotations, but a type checker cannot use an annotation that is a call. Classes
therefore assign properties with this module's functions. `annotate` converts them to annotations before registration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, ParamSpec, Protocol, TypeVar

import bpy
from bpy import props

P = ParamSpec("P")
T = TypeVar("T")
Item = TypeVar("Item", covariant=True)


class Items(Protocol[Item]):
    """Interface of a collection of property groups."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Item]: ...

    def __getitem__(self, index: int) -> Item: ...

    def add(self) -> Item:
        """Appends a new item and returns it."""
        ...

    def remove(self, index: int) -> None:
        """Removes the item at an index."""
        ...

    def clear(self) -> None:
        """Removes all items."""
        ...


class _Declared:
    """A property assigned in a class but not yet annotated."""

    def __init__(self, declare: Callable[..., object], options: dict[str, object]) -> None:
        self.declare = declare
        self.options = options


# Class -> its assigned properties, which `annotate` removed from it.
_declared: dict[type, dict[str, _Declared]] = {}


def _of(declare: Callable[P, object], kind: type[T]) -> Callable[P, T]:
    """A function of bpy.props, typed as returning the property's value type."""

    def assigned(*_: P.args, **options: P.kwargs) -> T:
        return _Declared(declare, options)  # pyright: ignore[reportReturnType]

    return assigned


BoolProperty = _of(props.BoolProperty, bool)
EnumProperty = _of(props.EnumProperty, str)
FloatProperty = _of(props.FloatProperty, float)
FloatVectorProperty = _of(props.FloatVectorProperty, list[float])
IntProperty = _of(props.IntProperty, int)
StringProperty = _of(props.StringProperty, str)

if TYPE_CHECKING:

    def PointerProperty(  # noqa: N802
        *,
        type: type[T],
        name: str = "",
        description: str = "",
        options: set[str] | None = None,
        poll: Callable[[bpy.types.bpy_struct, T], bool] | None = None,
    ) -> T | None:
        """A pointer to a data-block, or None."""
        raise NotImplementedError

    def CollectionProperty(  # noqa: N802
        *, type: type[Item], name: str = "", description: str = "", options: set[str] | None = None
    ) -> Items[Item]:
        """A list of property groups."""
        raise NotImplementedError
else:
    PointerProperty, CollectionProperty = _of(props.PointerProperty, object), _of(props.CollectionProperty, object)


def annotate(cls: type) -> None:
    """Converts properties assigned in a class and its bases to annotations, for Blender to read."""
    for one in cls.__mro__:
        for name, value in list(vars(one).items()):
            if isinstance(value, _Declared):
                _declared.setdefault(one, {})[name] = value
                delattr(one, name)
        for name, value in _declared.get(one, {}).items():
            one.__annotations__[name] = value.declare(**value.options)


def release(cls: type) -> None:
    """Replaces the annotations by strings once Blender has read them."""
    for one in cls.__mro__:
        for name, value in _declared.get(one, {}).items():
            # With Blender's objects in them, the module bpy 4.2 crashes when Python ends.
            one.__annotations__[name] = value.declare.__name__
