"""CG is rendered with the take's camera, or refused. Scenes do not share data that one of them changes."""

import json
from pathlib import Path

import bpy
import pytest

from tests.addon.test_cameras import run_out


@pytest.fixture
def solved(addon, scene, shot):
    """Scene with the clip's take in the compositor and the solved camera."""
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.set_up_scene = True
    addon("solve.arrival").load_camera(scene, shot)
    addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.device = 1, False, "CPU"
    return scene


@pytest.fixture
def artists_take(addon, contract, solved, shot, new_take):
    """artists_take(): adds a take "mine" seen by a separate artist's camera; returns that camera."""

    def make() -> bpy.types.Object:
        camera = bpy.data.objects.new("Mine", bpy.data.cameras.new("Mine"))
        solved.collection.objects.link(camera)
        camera.matrix_world = solved.camera.matrix_world
        camera.location.x += 0.5
        turns = addon("freeze.own_camera").sample_path(solved, "Mine", shot, 0)
        path = run_out(turns)
        take = new_take(shot, "mine")
        file = contract.ShotFolder(shot).camera_path("mine")
        contract.write_json(file, path.to_json())
        facts = json.loads((take / "take.json").read_text()) | {"camera_path": str(file)}
        (take / "take.json").write_text(json.dumps(facts))
        return camera

    return make


def bake(addon, scene, folder: Path) -> list[int]:
    return addon("bake.rendering").render(scene, folder, check=addon("bake.cg_camera").check)


def test_clip_camera_is_accepted_for_cg(addon, solved, shot, tmp_path):
    before = solved.camera
    assert addon("bake.insertion").combine_cg(solved, shot)
    assert solved.camera == before
    assert bake(addon, solved, tmp_path / "out") == [5, 6, 7]


MOVED = {
    "moved": lambda c, s: setattr(c, "delta_location", (0.1, 0.0, 0.0)),
    "turned": lambda c, s: setattr(c, "delta_rotation_quaternion", (0.99, 0.1, 0.0, 0.0)),
    "another sensor": lambda c, s: setattr(c.data, "sensor_width", 24.0),
    "shifted": lambda c, s: shifted(c),
    "another pixel aspect": lambda c, s: setattr(s.render, "pixel_aspect_y", 1.5),
    "orthographic": lambda c, s: setattr(c.data, "type", "ORTHO"),
    "a marker's camera": lambda c, s: marked(s),
    "its root moved away": lambda c, s: unparented(c),
}


def shifted(camera) -> None:
    camera.data.animation_data_clear()
    camera.data.shift_x += 0.1


def marked(scene) -> None:
    second_camera = bpy.data.objects.new("Other", bpy.data.cameras.new("Other"))
    scene.collection.objects.link(second_camera)
    scene.timeline_markers.new("cut", frame=7).camera = second_camera


def unparented(camera) -> None:
    camera.parent.location.x += 0.2
    camera.parent = None


@pytest.mark.parametrize("how", MOVED)
def test_a_camera_that_differs_is_refused_before_anything_is_rendered(addon, contract, solved, shot, tmp_path, how):
    addon("bake.insertion").combine_cg(solved, shot)
    MOVED[how](solved.camera, solved)
    number = solved.frame_current
    with pytest.raises(contract.JobError):
        bake(addon, solved, tmp_path / "out")
    assert not (tmp_path / "out").exists() and solved.frame_current == number


def test_moving_the_shots_root_moves_both(addon, solved, shot, tmp_path):
    addon("bake.insertion").combine_cg(solved, shot)
    root = solved.camera.parent
    root.location, root.rotation_euler, root.scale = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (2.0, 2.0, 2.0)
    assert bake(addon, solved, tmp_path / "out") == [5, 6, 7]


@pytest.mark.parametrize("percent", [50, 200])
def test_the_size_in_percent_does_not_matter(addon, solved, shot, tmp_path, percent):
    addon("bake.insertion").combine_cg(solved, shot)
    solved.render.resolution_percentage = percent
    assert bake(addon, solved, tmp_path / "out") == [5, 6, 7]


def test_a_take_of_the_artists_camera_is_combined_through_it(addon, contract, solved, shot, artists_take, tmp_path):
    camera, clips = artists_take(), solved.camera
    addon("bake.insertion").insert_freeze(solved, shot, "mine")
    said = addon("bake.insertion").combine_cg(solved, shot)
    assert solved.camera == camera and any(line.startswith("Mine is now the scene's camera") for line in said)
    assert bake(addon, solved, tmp_path / "out") == [5, 6, 7]
    solved.camera = clips
    with pytest.raises(contract.JobError, match="camera of take mine") as failure:
        bake(addon, solved, tmp_path / "out")
    assert "Make Mine the scene's camera" in failure.value.hint


def test_second_take_with_cg_warns_on_insert_and_is_refused_on_bake(
    addon, contract, solved, shot, artists_take, tmp_path
):
    addon("bake.insertion").combine_cg(solved, shot)
    artists_take()
    said = addon("bake.insertion").insert_freeze(solved, shot, "mine")
    assert any(line.startswith("CG would slide") for line in said)
    with pytest.raises(contract.JobError, match="CG would slide"):
        bake(addon, solved, tmp_path / "out")
    addon("bake.insertion").insert_freeze(solved, shot, "freeze")
    assert bake(addon, solved, tmp_path / "out") == [5, 6, 7]


def test_no_camera_that_fits_is_said_and_nothing_is_changed(addon, contract, solved, shot, artists_take):
    camera = artists_take()
    addon("bake.insertion").insert_freeze(solved, shot, "mine")
    bpy.data.objects.remove(camera)
    nodes = len(addon("compat").compositor_tree(solved).nodes)
    with pytest.raises(contract.JobError, match="CG would slide"):
        addon("bake.insertion").combine_cg(solved, shot)
    assert len(addon("compat").compositor_tree(solved).nodes) == nodes and not solved.render.film_transparent
    contract.ShotFolder(shot).camera_path("mine").unlink()
    with pytest.raises(contract.JobError, match="is no longer known"):
        addon("bake.insertion").combine_cg(solved, shot)


def test_a_view_layer_that_is_not_rendered_is_said(addon, contract, solved, shot, tmp_path):
    addon("bake.insertion").combine_cg(solved, shot)
    solved.view_layers.new("other")
    solved.view_layers[0].use = False
    with pytest.raises(contract.JobError, match="is not used for rendering"):
        bake(addon, solved, tmp_path / "out")


# ------------------------------------------------------------------------------------------- scenes that share nodes


def shown(addon, scene) -> str:
    return addon("bake.freeze_group").shown(scene)[0].name


@pytest.mark.parametrize("kind", ["FULL_COPY", "LINK_COPY"])
def test_bake_in_a_copied_scene_does_not_change_the_original(addon, solved, shot, new_take, kind):
    new_take(shot, "second")
    addon("bake.insertion").combine_cg(solved, shot)
    bpy.ops.scene.new(type=kind)
    copy = bpy.context.window.scene if bpy.context.window else next(s for s in bpy.data.scenes if s != solved)
    assert copy != solved
    copy.splannequin.shot_path = str(shot)
    addon("bake.insertion").insert_freeze(copy, shot, "second")
    assert (shown(addon, solved), shown(addon, copy)) == ("freeze", "second")
    for scene in (solved, copy):
        tree = addon("compat").compositor_tree(scene)
        (layers,) = [n for n in tree.nodes if n.bl_idname == "CompositorNodeRLayers"]
        assert layers.scene == scene, "each shows its own objects"
    addon("bake.freeze_group").set_depth_scale(copy, 3.0)
    assert [addon("bake.freeze_group").shown(s)[1] for s in (solved, copy)] == pytest.approx([1.0, 3.0])
    assert addon("bake.insertion").remove(copy)
    assert shown(addon, solved) == "freeze" and addon("bake.freeze_group").shown(copy) is None


def test_a_group_copied_by_hand_stays_as_it_is(addon, solved, shot, new_take):
    """The copy goes into another scene's tree together with its nodes (Ctrl-C, Ctrl-V)."""
    new_take(shot, "second")
    compat = addon("compat")
    node = addon("bake.freeze_group").group_node(compat.compositor_tree(solved))
    second_scene = bpy.data.scenes.new("other")
    tree = compat.new_compositor_tree(second_scene, "theirs")
    tree.nodes.new("CompositorNodeGroup").node_tree = node.node_tree
    addon("bake.insertion").insert_freeze(solved, shot, "second")
    assert (shown(addon, solved), shown(addon, second_scene)) == ("second", "freeze")


def test_a_tree_that_scenes_share_is_copied_only_when_it_is_changed(addon, contract, solved, shot, new_take):
    compat = addon("compat")
    if not compat.HAS_COMPOSITING_GROUP:
        pytest.skip("until 5.0 a compositor is the scene's own")
    new_take(shot, "second")
    second_scene, tree = bpy.data.scenes.new("other"), solved.compositing_node_group
    second_scene.compositing_node_group = tree
    with pytest.raises(contract.JobError):
        addon("bake.insertion").insert_freeze(second_scene, shot, "no such take")
    assert second_scene.compositing_node_group == solved.compositing_node_group == tree
    addon("bake.insertion").insert_freeze(second_scene, shot, "second")
    assert (shown(addon, solved), shown(addon, second_scene)) == ("freeze", "second")
    assert solved.compositing_node_group == tree
