"""Every row of the table of render settings: set to disturb the bake, rendered, and restored."""

import contextlib
import json
from pathlib import Path

import bpy
import numpy as np
import pytest


def strip(scene, start: int) -> None:
    """Add a grey strip to the sequencer."""
    editor = scene.sequence_editor_create()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences
    how = {"length": 20} if hasattr(editor, "strips") and bpy.app.version >= (5, 0, 0) else {"frame_end": start + 20}
    strips.new_effect("grey", "COLOR", 1, start, **how).color = (0.5, 0.5, 0.5)


def override(scene) -> None:
    out = scene.render.image_settings
    out.color_management = "OVERRIDE"
    out.view_settings.view_transform, out.view_settings.exposure = "AgX", 2.0


AGAINST = {
    "strip": lambda s: strip(s, 1),
    "strip outside the range": lambda s: strip(s, 100),
    "region": lambda s: region(s, False),
    "crop": lambda s: region(s, True),
    "stereo": lambda s: setattr(s.render, "use_multiview", True),
    "burned in": lambda s: setattr(s.render, "use_stamp", True),
    "time remapping": lambda s: setattr(s.render, "frame_map_new", 200),
    "no overwriting": lambda s: setattr(s.render, "use_overwrite", False),
    "placeholders": lambda s: setattr(s.render, "use_placeholder", True),
    "one view layer": lambda s: setattr(s.render, "use_single_layer", True),
    "dither": lambda s: setattr(s.render, "dither_intensity", 2.0),
    "compositing off": lambda s: setattr(s.render, "use_compositing", False),
    "display": lambda s: setattr(s.display_settings, "display_device", "Display P3"),
    "view": lambda s: setattr(s.view_settings, "view_transform", "AgX"),
    "exposure": lambda s: setattr(s.view_settings, "exposure", 1.0),
    "gamma": lambda s: setattr(s.view_settings, "gamma", 2.0),
    "curves": lambda s: curves(s),
    "white balance": lambda s: white_balance(s),
    "keyed exposure": lambda s: keyed(s),
    "override": override,
}
"""Settings by which an artist's scene may disturb a bake, by name."""


def region(scene, crop: bool) -> None:
    render = scene.render
    render.use_border, render.use_crop_to_border = True, crop
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.25, 0.75


def keyed(scene) -> None:
    for frame, value in ((1, 0.0), (5, 2.0)):
        scene.view_settings.exposure = value
        scene.view_settings.keyframe_insert("exposure", frame=frame)
    scene.frame_set(1)


def curves(scene) -> None:
    scene.view_settings.use_curve_mapping = True
    scene.view_settings.curve_mapping.curves[3].points[1].location = (0.5, 1.0)
    scene.view_settings.curve_mapping.update()


def white_balance(scene) -> None:
    if not hasattr(scene.view_settings, "use_white_balance"):
        pytest.skip("since 4.3")
    scene.view_settings.use_white_balance, scene.view_settings.white_balance_temperature = True, 3000.0


@pytest.fixture
def baked(addon, scene, shot):
    """The freeze in a scene of 16 x 12, frames 5 and 6."""
    scene.splannequin.shot_path = str(shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 16, 12, 100
    scene.frame_start, scene.frame_end = 5, 6
    return scene


def state(scene) -> dict:
    """All scalar settings of a scene that affect its picture."""
    owners = {
        "render": scene.render, "out": scene.render.image_settings, "view": scene.view_settings,
        "display": scene.display_settings, "out view": scene.render.image_settings.view_settings,
        "out display": scene.render.image_settings.display_settings, "scene": scene,
    }  # fmt: skip
    found = {}
    for name, owner in owners.items():
        for prop in owner.bl_rna.properties:
            if prop.type in ("BOOLEAN", "INT", "FLOAT", "ENUM", "STRING") and not getattr(prop, "is_array", False):
                found[name, prop.identifier] = getattr(owner, prop.identifier)
    # otherwise these have no effect until they are copied
    if scene.render.image_settings.color_management == "FOLLOW_SCENE":
        found = {key: value for key, value in found.items() if key[0] not in ("out view", "out display")}
    # These properties change while the scene is evaluated or rendered.
    return {k: v for k, v in found.items() if k[1] not in ("is_evaluated", "tag", "frame_float", "file_extension")}


@pytest.mark.parametrize(
    ("against", "how"),
    [*((name, "headless") for name in AGAINST), *((name, "button") for name in ("strip", "crop", "stereo", "display"))],
)
def test_a_setting_of_the_artists_neither_changes_the_bake_nor_is_changed(
    addon, baked, shot, tmp_path, pictures, layers, against, how
):
    scene = baked
    scene.render.image_settings.file_format = "PNG"
    AGAINST[against](scene)
    out = tmp_path / "out"
    out.mkdir()
    (out / "000005.png").write_bytes(b"an older one")
    scene.render.filepath = str(out / "######")
    before = state(scene)
    said = []
    if how == "headless":
        addon("bake.rendering").render(scene, out, png=False, say=said.append)
    else:
        assert bpy.ops.splannequin.render("EXEC_DEFAULT") == {"FINISHED"}
        said = addon("process.job_timer").watch_of(shot).notes["bake"]
    assert state(scene) == before
    assert not [key for key in scene.keys() if key.startswith("splannequin_bake")]  # noqa: SIM118
    for frame in (5, 6):
        found = pictures.read(out / f"{frame:06d}.png")
        assert found.shape == (12, 16, 3)
        # From 5.2 on, half-covered pixels (the first column) keep their alpha, and a PNG stores straight colours.
        expected = pictures.srgb(layers(frame)["rgba"][..., :3])
        assert np.abs(found - expected)[1:, 1:].max() * 255 < 0.6
    assert sorted(path.name for path in out.iterdir()) == ["000005.png", "000006.png"]
    if against != "placeholders":
        assert len(said) >= 1 + (how == "button"), "it is said"


def test_every_row_of_the_table_is_tried(addon, baked):
    """A row that no setting above changes would be untested."""
    settings = addon("bake.render_settings")
    tried = set()
    for make in AGAINST.values():
        bpy.ops.wm.read_homefile(use_factory_startup=True)
        scene = bpy.context.scene
        scene.render.use_border = scene.render.use_crop_to_border = False
        with contextlib.suppress(pytest.skip.Exception):
            make(scene)
        settings.apply(scene, settings.needed(scene, False, False))
        tried |= {(owner, name) for owner, name, *_ in json.loads(scene.get("splannequin_bake_settings", "[]"))}
        settings.restore(scene)
    rows = settings.needed(bpy.context.scene, False, False)
    colours = {row.name for row in settings.SETTINGS if row.when == "colours"}
    lacking = (
        {row.name for row in rows if (row.owner, row.name) not in tried} - {"use_nodes", "frame_map_old"} - colours
    )
    assert not lacking - {"use_file_extension"}, lacking  # the button's test on a full disk switches it off


@pytest.mark.parametrize("name", ["a{{b}}", "{fps}", "a{", "x}y", "#####", "50%_%d", "a # b", "{blend_name}"])
def test_a_folders_name_is_taken_by_the_letter(addon, baked, tmp_path, name):
    folder = tmp_path / name
    addon("bake.rendering").render(baked, folder)
    assert sorted(path.name for path in folder.iterdir()) == ["000005.png", "000006.png"]
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".splannequin"] == [name]
    assert addon("bake.rendering").gathered(baked, folder, True) == [5, 6]
    baked.render.filepath = addon("bake.rendering").output_path(folder)
    assert Path(baked.render.frame_path(frame=5)) == folder / "000005.png", "also in the file that is saved"


def test_two_slashes_are_a_whole_path(addon, baked, tmp_path):
    addon("bake.rendering").render(baked, Path("/" + str(tmp_path / "out")))
    assert len(list((tmp_path / "out").iterdir())) == 2


@pytest.mark.parametrize("name", ["/".join(letter * 200 for letter in "vwxyz")])
def test_a_folder_that_blender_cannot_name_is_refused(addon, contract, baked, tmp_path, name):
    before = state(baked)
    with pytest.raises(contract.JobError, match="Blender cannot write images to") as failure:
        addon("bake.rendering").render(baked, tmp_path / name, png=False)
    failure.value.message.encode()  # can be printed
    assert state(baked) == before


def test_an_output_path_that_means_nothing_is_refused_in_words(baked, tmp_path):
    baked.render.filepath = str(tmp_path / "{nothing}" / "f")
    if bpy.app.version < (4, 5, 0):
        pytest.skip("braces are letters before 4.5")
    with pytest.raises(RuntimeError, match="cannot use the output path"):
        bpy.ops.splannequin.render("EXEC_DEFAULT")
    assert baked.render.filepath == str(tmp_path / "{nothing}" / "f")


def test_output_path_templates_are_filled_in(baked, tmp_path):
    baked.render.filepath = str(tmp_path / "out" / "f_##")
    if bpy.app.version >= (5, 0, 0):
        baked.render.filepath = str(tmp_path / "{scene_name}" / "f_##")
    assert bpy.ops.splannequin.render("EXEC_DEFAULT") == {"FINISHED"}
    folder = tmp_path / ("Scene" if bpy.app.version >= (5, 0, 0) else "out")
    assert sorted(path.name for path in folder.iterdir()) == ["f_05.png", "f_06.png"]


@pytest.mark.parametrize("how", ["keyframes", "driver", "strip"])
def test_a_setting_that_moves_is_refused_before_anything_is_rendered(addon, contract, baked, tmp_path, how):
    if how == "driver":
        baked.driver_add("render.dither_intensity").driver.expression = "1"
    else:
        baked.render.keyframe_insert("dither_intensity", frame=5)
    if how == "strip":
        data = baked.animation_data
        action, data.action = data.action, None
        data.nla_tracks.new().strips.new("moves", 1, action)
    before = state(baked)
    with pytest.raises(contract.JobError, match="is animated"):
        addon("bake.rendering").render(baked, tmp_path / "out", png=False)
    assert state(baked) == before and not (tmp_path / "out").exists()


def test_a_file_that_is_saved_while_it_is_baked_holds_the_artists_settings(addon, contract, baked, tmp_path):
    """A save during the bake runs a handler that restores the settings. A file saved without handlers is repaired on
    load."""
    scene, file, crashed = baked, tmp_path / "saved.blend", tmp_path / "crashed.blend"
    region(scene, True)
    scene.render.filepath = "//mine/f_##"
    settings = addon("bake.render_settings")

    scene.frame_end = 7

    def save(done: int, _: int) -> None:
        if done == 1:
            bpy.data.libraries.write(str(crashed), {scene})  # an autosave: no handler runs
            bpy.ops.wm.save_as_mainfile(filepath=str(file), copy=True)
            assert not scene.render.use_border and "splannequin_bake_settings" in scene, "the bake goes on"

    # in a window, another process could be using the file
    with pytest.raises(contract.JobError, match="saved while frame 6"):
        addon("bake.rendering").render(scene, tmp_path / "out", on_frame=save)
    assert scene.render.use_border
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["000005.png", "000007.png"], "it goes on"
    bpy.ops.wm.open_mainfile(filepath=str(file))
    render = bpy.context.scene.render
    assert render.use_border and render.use_crop_to_border and render.filepath.endswith("f_##")
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(crashed)) as (stored, wanted):
        wanted.scenes = stored.scenes
    assert not wanted.scenes[0].render.use_border, "so it was written"
    settings._on_load()
    assert wanted.scenes[0].render.use_border and "splannequin_bake_settings" not in wanted.scenes[0]


def test_a_handler_that_raises_leaves_the_artists_settings(addon, baked, tmp_path):
    region(baked, True)
    before = state(baked)

    def fail(*_) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        addon("bake.rendering").render(baked, tmp_path / "out", png=False, on_frame=fail)
    assert state(baked) == before
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["000005.png"]
