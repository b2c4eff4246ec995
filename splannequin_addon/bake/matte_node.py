"""Adds a Cryptomatte node to the scene's compositor that selects a take's matte by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import Outcome, library_of, scene_in, settings_of, size_of
from ..properties import StringProperty
from ..scene import numbered, paths, sequences
from ..shot import inventory
from ..ui import step_operator


def insert(scene: bpy.types.Scene, shot: Path, take: str, name: str) -> list[str]:
    """Adds an unlinked Cryptomatte node of a matte to the scene's compositor. Returns the changes as sentences.

    Raises JobError if the take lacks the matte, or if the scene has no editable compositor.
    """
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(take))
    frames = numbered.frame_numbers(folder.cryptomattes)
    if name not in inventory.mattes(folder) or not frames:
        raise contract.JobError(f"The take has no matte {name}.", "Create it first.", contract.ExitCode.BAKE)
    tree = compat.compositor_tree(scene)
    if tree is None or library_of(tree) is not None:
        raise contract.JobError(
            "This scene has no local compositor.", "Bake or create one first.", contract.ExitCode.BAKE
        )
    tree = compat.single_user_compositor_tree(scene)
    image = sequences.load_numbers(folder.cryptomatte(frames[0]), f"Mattes {take}")
    if image.source != "SEQUENCE":
        size_of(image)  # loads the image: Blender 4.2 selects no matte from a sequence whose first image is not loaded
        image.source = "SEQUENCE"
    if any(_shows(node, folder.cryptomatte(frames[0]), name) for node in tree.nodes):
        return [f"The compositor already has a node for the matte {name}."]
    node: Any = tree.nodes.new("CompositorNodeCryptomatteV2")
    node.label, node.source = f"Matte {name}", "IMAGE"
    sequences.show_sequence(node, image, frames[0], frames[-1])
    node.matte_id = _quoted(name)
    existing = [item for item in tree.nodes if item != node]
    left = min((item.location.x for item in existing), default=0.0)
    low = min((item.location.y - item.height for item in existing), default=0.0)
    node.location = left, low - 200.0
    return [f"The node Matte {name} was added. Link its output Matte."]


def _quoted(name: str) -> str:
    """A matte's name in the syntax of the node's comma-separated list: quoted if it contains a comma."""
    return f'"{name}"' if "," in name else name


def _shows(node: bpy.types.Node, path: Path, name: str) -> bool:
    """True for a Cryptomatte node that selects this matte from this sequence."""
    picker: Any = node
    if node.bl_idname != "CompositorNodeCryptomatteV2" or picker.image is None or picker.source != "IMAGE":
        return False
    return paths.same(paths.absolute(picker.image.filepath), str(path)) and bool(picker.matte_id == _quoted(name))


class SPLANNEQUIN_OT_insert_matte(bpy.types.Operator):
    """Add a Cryptomatte node for this matte to your compositor, without links"""

    bl_idname = "splannequin.insert_matte"
    bl_label = "Add Matte Node"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    name = StringProperty(name="Matte", description="Name of the matte", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Adds the node; reports an error."""
        take = settings_of(scene_in(context)).take_name
        return step_operator.edit(self, context, "bake", lambda scene, shot: insert(scene, shot, take, self.name))


CLASSES = (SPLANNEQUIN_OT_insert_matte,)
