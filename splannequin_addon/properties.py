"""Blender's properties as the type checker reads them: `clip = StringProperty(...)` in a class is a str of its objects.

Blender wants them as annotations, and an annotation that is a call says nothing to a checker. So classes assign them,
with the functions of this file, and `annotate` makes annotations of them before the classes are registered.
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
    """What a collection of property groups can do."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Item]: ...

    def __getitem__(self, index: int) -> Item: ...

    def add(self) -> Item:
        """A new one, at the end."""
        ...

    def remove(self, index: int) -> None:
        """Takes one out."""
        ...

    def clear(self) -> None:
        """Takes all out."""
        ...


class _Declared:
    """A property of a class that Blender does not know yet."""

    def __init__(self, declare: Callable[..., object], options: dict[str, object]) -> None:
        self.declare = declare
        self.options = options


_declared: dict[type, dict[str, _Declared]] = {}
"""What each class assigned, which `annotate` took out of it."""


def _of(declare: Callable[P, object], kind: type[T]) -> Callable[P, T]:
    """A function of bpy.props, with the type of what its property holds."""

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
        """A pointer to a data-block, or to none."""
        raise NotImplementedError

    def CollectionProperty(  # noqa: N802
        *, type: type[Item], name: str = "", description: str = "", options: set[str] | None = None
    ) -> Items[Item]:
        """A list of property groups."""
        raise NotImplementedError
else:
    PointerProperty, CollectionProperty = _of(props.PointerProperty, object), _of(props.CollectionProperty, object)


def annotate(cls: type) -> None:
    """Makes annotations of the properties that a class and what it is made of assign, for Blender to read."""
    for one in cls.__mro__:
        for name, value in list(vars(one).items()):
            if isinstance(value, _Declared):
                _declared.setdefault(one, {})[name] = value
                delattr(one, name)
        for name, value in _declared.get(one, {}).items():
            one.__annotations__[name] = value.declare(**value.options)


def release(cls: type) -> None:
    """Leaves names in the annotations once Blender has read them: over what else stood there, bpy 4.2 as a module
    crashes when Python ends."""
    for one in cls.__mro__:
        for name, value in _declared.get(one, {}).items():
            one.__annotations__[name] = value.declare.__name__
