"""Settings of the bake. They belong to the scene, independent of the selected shot."""

from __future__ import annotations

from ..properties import BoolProperty, EnumProperty


class BakeSettings:
    """Colours, and the group's position in the compositor."""

    keep_colours = BoolProperty(
        name="Keep Plate Colours",
        description="Set the view transform to Standard and dither to 0, so that rendered images keep the plate's "
        "colours. Blender's default view transform changes them",
        default=True,
        options=set(),
    )
    insert_at = EnumProperty(
        name="Insert",
        description="Where to insert the freeze in your compositor",
        items=[
            ("AUTO", "Automatic", "In place of the plate if a node shows it, otherwise before the output"),
            ("PLATE", "As Plate", "After the node that shows the plate, so that your grade applies to the freeze"),
            ("OUTPUT", "Before Output", "After all other nodes"),
        ],
        default="AUTO",
        options=set(),
    )
