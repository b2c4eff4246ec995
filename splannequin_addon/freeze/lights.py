"""The light of a take as the scene's world: a panorama of the frozen scene that rotates with the shot's root.

The artist's world stays in the file unchanged, and returns when the light is removed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from .. import compat
from ..access import present, settings_of
from ..scene import paths, sequences
from ..scene.ownership import TAG
from ..shot import scene_objects


def add(scene: bpy.types.Scene, shot: Path, take: str, key: str) -> list[str]:
    """Makes a panorama of a take the scene's world and replaces the shot's previous light. Returns the changes.

    Raises JobError if the panorama is missing or the shot has no objects in the scene. Raises ValueError if the colour
    configuration lacks linear Rec.709, and RuntimeError if Blender cannot read the file.
    """
    scene_objects.check_root(scene, shot)
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(take))
    facts = contract.light_of_take(folder, key)
    if facts is None:
        raise contract.JobError(f"Take {take} does not have this light.", "Create it again.", contract.ExitCode.USAGE)
    root = present(scene_objects.part(scene, shot, "root"))
    image = _image(folder.light(key))
    world = _world(f"{scene_objects.name_of(shot)} {take} light", image, root, facts)
    remove(scene, shot)
    _keep_world(scene)
    scene_objects.new(scene, shot).light = world
    scene.world = world
    return [
        f"The light of take {take} is now the scene's world. It is an estimate: {100.0 * facts.filled:.0f} % "
        "of it is not visible in any plate and is filled in."
    ]


def find(scene: bpy.types.Scene, shot: Path) -> bpy.types.World | None:
    """The light of a shot, or None if the scene has none."""
    entry = scene_objects.of(scene, shot)
    return entry.light if entry is not None else None


def remove(scene: bpy.types.Scene, shot: Path) -> bool:
    """Removes the light of a shot from the file and restores the scene's previous world. True if there was a light."""
    entry = scene_objects.of(scene, shot)
    world = entry.light if entry is not None else None
    if entry is None or world is None:
        return False
    entry.light = None
    if scene.world == world:
        scene.world = None
        _restore_world(scene)
    if not any(one.light for one in settings_of(scene).made):
        settings_of(scene).world_before = None
    image = _image_in(world)
    if world.users <= int(world.use_fake_user):  # otherwise a copy of the scene uses it
        bpy.data.worlds.remove(world)
        if image is not None and image.get(TAG) and image.users <= int(image.use_fake_user):
            bpy.data.images.remove(image)
    return True


def _keep_world(scene: bpy.types.Scene) -> None:
    """Stores the scene's world before a light replaces it."""
    if scene.world not in [entry.light for entry in settings_of(scene).made if entry.light is not None]:
        settings_of(scene).world_before = scene.world


def _restore_world(scene: bpy.types.Scene) -> None:
    """Sets the world of a scene whose light was removed: another shot's light, or the world from before all lights."""
    lights = [entry.light for entry in settings_of(scene).made if entry.light is not None]
    scene.world = lights[0] if lights else settings_of(scene).world_before


# ------------------------------------------------------------------------------------------------- what it is made of


def _image(path: Path) -> bpy.types.Image:
    """A panorama as an image data-block, reused by path."""
    known = sequences.find(os.path.abspath(path))
    if known is not None:  # without a reload: a panorama's name identifies its content
        return known
    compat.colour_space("linear")  # fails before anything is created if the configuration lacks the space
    image = bpy.data.images.load(contract.regular_file(path))
    image.name = f"{path.parent.parent.name} light"
    image[TAG] = True
    compat.set_image_colour(image, "linear")
    image.filepath = paths.blend_path(path)
    return image


def _image_in(world: bpy.types.World) -> bpy.types.Image | None:
    """The panorama image of a light."""
    nodes: Any = world.node_tree.nodes if world.node_tree is not None else ()
    return next((node.image for node in nodes if node.type == "TEX_ENVIRONMENT"), None)


def _world(
    name: str, image: bpy.types.Image, root: bpy.types.Object, facts: contract.LightFacts
) -> bpy.types.World:  # fmt: skip
    """A world that emits a panorama's light.

    The panorama's directions are those of the scene at the time it was made. Two Mapping nodes convert the scene's
    current directions. The first, driven by the shot's root, converts them to the solve's axes, the second to the
    panorama's axes.
    """
    world = bpy.data.worlds.new(name)
    world[TAG] = True
    if world.node_tree is None:  # until 5.0
        world.use_nodes = True
    tree = present(world.node_tree)
    tree.nodes.clear()
    kinds = ("TexCoord", "Mapping", "Mapping", "TexEnvironment", "Background", "OutputWorld")
    nodes: list[Any] = [tree.nodes.new(f"ShaderNode{kind}") for kind in kinds]
    for column, node in enumerate(nodes):
        node.location = (260.0 * (column - len(nodes)), 300.0)
    source, to_solve, to_picture, picture, background, output = nodes
    to_solve.label, to_picture.label = "From the Shot's Root", "To the Panorama"
    to_solve.vector_type, to_picture.vector_type = "TEXTURE", "VECTOR"
    _follow(to_solve.inputs["Rotation"], root)
    to_picture.inputs["Rotation"].default_value = _turn(facts).to_euler("XYZ")
    picture.image, picture.projection = image, "EQUIRECTANGULAR"
    tree.links.new(source.outputs["Generated"], to_solve.inputs["Vector"])
    tree.links.new(to_solve.outputs[0], to_picture.inputs["Vector"])
    tree.links.new(to_picture.outputs[0], picture.inputs["Vector"])
    tree.links.new(picture.outputs["Color"], background.inputs["Color"])
    tree.links.new(background.outputs[0], output.inputs["Surface"])
    return world


def _turn(facts: contract.LightFacts) -> Matrix:
    """[3, 3] rotation from the solve's axes to the panorama's axes."""
    placement = contract.Placement.from_json(facts.placement)
    return Matrix((np.array(placement.scene_from_solve).reshape(4, 4)[:3, :3] / placement.scale).tolist())


def _follow(rotation: bpy.types.NodeSocket, root: bpy.types.Object) -> None:
    """Makes a socket of three angles follow an object's world rotation."""
    for axis in range(3):
        curve: Any = rotation.driver_add("default_value", axis)
        driver = curve.driver
        driver.type = "SUM"  # no Python, which Blender blocks in files that it does not trust
        variable = driver.variables.new()
        variable.type = "TRANSFORMS"
        target = variable.targets[0]
        target.id, target.transform_type, target.transform_space = root, f"ROT_{'XYZ'[axis]}", "WORLD_SPACE"
        target.rotation_mode = "XYZ"
