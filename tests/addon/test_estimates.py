"""Estimates shown with the presets, and the panel's requests after a solve."""

import bpy
import numpy as np
import pytest


def test_a_tooltip_tells_what_the_preset_is(addon, contract):
    for name, _, words in addon("train.settings").PRESETS:
        width = contract.PRESET_WIDTHS[name]
        wide = f"{width} pixels wide" if width else "As wide as the working frames"
        assert words.startswith(f"{wide}, {contract.PRESET_STEPS[name]} steps")


@pytest.mark.parametrize("by_hand", [False, True])
def test_shot_is_unscaled_until_the_scale_is_set(addon, scene, shot, by_hand):
    scene.splannequin.shot_path = str(shot)
    bpy.ops.splannequin.load_camera()
    scaled = addon("solve.scale").scaled
    assert not scaled(scene, shot)
    bpy.ops.splannequin.align_origin(places=(0.5, 0, 0))
    assert not scaled(scene, shot)
    if by_hand:
        addon("solve.cameras").find(scene, shot, "EMPTY").scale = (2.0, 2.0, 2.0)
        bpy.context.view_layer.update()
    else:
        places = np.array([[0, 0, 0], [1, 0, 0]], dtype=float)
        bpy.ops.splannequin.align_scale(places=places.ravel().tolist(), distance=1.0)
    assert scaled(scene, shot), "also where it happened to be right"
    bpy.ops.splannequin.load_camera()
    assert scaled(scene, shot), "a second solve keeps it"
