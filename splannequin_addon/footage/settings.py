"""Settings of the import."""

from __future__ import annotations

from ...torch_backend import contract
from .. import compat
from ..properties import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty


class ImportSettings:
    """Clip, range and folder of a shot."""

    clip = StringProperty(
        **contract.panel(contract.ImportParams, "source"),
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    shot_path = StringProperty(
        name="Shot Folder",
        description="Folder for all files of this shot; empty: a new folder next to the clip",
        subtype="DIR_PATH",
        options=compat.PATH_OPTIONS,
    )
    shot_seen = StringProperty(
        name="Last Seen Shot",
        description="Shot folder that existed when this file was last used, so that a missing folder is noticed",
        subtype="DIR_PATH",
        options={*compat.PATH_OPTIONS, "HIDDEN"},
    )
    use_range = BoolProperty(
        name="Only a Range", description="Import a part of the clip instead of all of it", default=False, options=set()
    )
    first = IntProperty(
        **contract.panel(contract.ImportParams, "first", 1),
        options=set(),
    )
    last = IntProperty(
        **contract.panel(contract.ImportParams, "last", 250),
        options=set(),
    )
    use_start = BoolProperty(
        name="Custom First Frame",
        description="Start the shot's frame numbers at a custom number instead of using the clip's numbers",
        default=False,
        options=set(),
    )
    start = IntProperty(
        **contract.panel(contract.ImportParams, "start", 1001),
        min=0,
        max=contract.LAST_FRAME,
        options=set(),
    )
    solve_step = IntProperty(
        **contract.panel(contract.ImportParams, "step"),
        min=0,
        soft_max=10,
        options=set(),
    )
    fps = FloatProperty(
        **contract.panel(contract.ImportParams, "fps"),
        min=0.0,
        soft_max=120.0,
        options=set(),
    )
    colour_space = StringProperty(
        **contract.panel(contract.ImportParams, "colour_space"),
        options=set(),
    )
    lut = StringProperty(
        **contract.panel(contract.ImportParams, "lut"),
        subtype="FILE_PATH",
        options=set(),
    )
    layer = StringProperty(
        **contract.panel(contract.ImportParams, "layer"),
        options=set(),
    )
    pixel_aspect = FloatProperty(
        **contract.panel(contract.ImportParams, "pixel_aspect"),
        min=0.0,
        max=4.0,
        options=set(),
    )
    matrix = EnumProperty(
        **contract.panel(contract.ImportParams, "matrix"),
        options=set(),
    )
    levels = EnumProperty(
        **contract.panel(contract.ImportParams, "levels"),
        options=set(),
    )
