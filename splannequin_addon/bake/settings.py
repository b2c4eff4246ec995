"""Settings of the bake. They belong to the scene, independent of the selected shot."""

from __future__ import annotations

from ..properties import BoolProperty, EnumProperty


class BakeSettings:
    """Colours, and the group's position in the compositor."""

    keep_colours = BoolProperty(
        name="Keep Plate Colours",
        description="Set the view transform to Standard and dither to 0, so that pictures leave with the colours they "
        "came in with. Blender's default view changes them",
        default=True,
        options=set(),
    )
    insert_at = EnumProperty(
        name="Insert",
        description="Where the freeze goes in a compositor that you have built",
        items=[
            ("AUTO", "Automatic", "As the plate where a node shows it, else before the output"),
            ("PLATE", "As Plate", "Behind the node that shows the plate, so that your grade goes on from there"),
            ("OUTPUT", "Before Output", "Behind everything else"),
        ],
        default="AUTO",
        options=set(),
    )
