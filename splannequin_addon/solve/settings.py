"""What the artist sets for the solve."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from .. import compat
from ..properties import EnumProperty, PointerProperty, StringProperty


class SolveSettings:
    """The lens of a shot, and where its cameras come from."""

    camera_model = EnumProperty(
        **contract.panel(contract.SolveParams, "camera_model"),
        options=set(),
    )
    cameras_from = EnumProperty(
        name="Cameras From",
        description="Solve the camera here, or take cameras that another program found for the same clip",
        items=[
            ("SOLVE", "Solve", "Find the camera from the clip"),
            ("FILE", "File", "A COLMAP folder, a nerfstudio transforms.json or a camera path"),
            ("TRACKING", "Blender Tracking", "The solved camera of a movie clip of this file"),
        ],
        options=set(),
    )
    cameras_path = StringProperty(
        **contract.panel(contract.SolveParams, "cameras"),
        subtype="FILE_PATH",
        options=compat.PATH_OPTIONS,
    )
    tracking_clip = PointerProperty(
        name="Tracked Clip",
        description="Movie clip whose camera is solved; it should show the same frames as the shot's clip",
        type=bpy.types.MovieClip,
        options=set(),
    )
