"""Typed access to Blender's data returns the values that Blender holds."""

import bpy
import pytest


@pytest.fixture
def access(addon):
    return addon("access")


def test_settings_belong_to_the_scene(access, scene):
    assert access.settings_of(scene) == scene.splannequin
    assert access.scene_holding(scene.splannequin) == scene


def test_what_is_empty_where_it_never_should_be_is_not_passed_on(access):
    with pytest.raises(AssertionError):
        access.present(None)


def test_the_size_and_the_pixels_of_an_image_are_read(access):
    image = bpy.data.images.new("sized", 5, 3)
    try:
        assert access.size_of(image) == (5, 3)
        assert len(access.pixels_of(image)) == 5 * 3 * 4
    finally:
        bpy.data.images.remove(image)


def test_a_socket_keeps_what_it_is_set_to(access):
    tree = bpy.data.node_groups.new("sockets", "ShaderNodeTree")
    try:
        node = tree.nodes.new("ShaderNodeMath")
        access.set_value(node.inputs[0], 0.25)
        assert access.value_of(node.inputs[0]) == 0.25
    finally:
        bpy.data.node_groups.remove(tree)
