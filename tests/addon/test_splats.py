"""Splats of a take in Blender and in exported files: aligned with the solved camera for every placement of the shot."""

import json
import os
import subprocess
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector

NAMES = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
COUNT = 40


def write_ply(path: Path, rows: np.ndarray) -> None:
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property float {name}" for name in NAMES] + ["end_header", ""]
    path.write_bytes("\n".join(head).encode() + np.asarray(rows, "<f4").tobytes())


def splats(matrix: np.ndarray) -> np.ndarray:
    """PLY rows with means at `points`, transformed by a similarity."""
    chance = np.random.default_rng(4)
    rows = chance.normal(0.0, 0.5, (COUNT, len(NAMES)))
    rows[:, :3] = points() @ matrix[:3, :3].T + matrix[:3, 3]
    return rows


def points() -> np.ndarray:
    """Points [P, 3] in solve units around the origin; the shot's cameras look at it from a distance of 3."""
    return np.random.default_rng(3).uniform(-0.5, 0.5, (COUNT, 3))


@pytest.fixture
def stood(scene, shot, addon):
    """Root of the shot in the scene, with a rotated floor, a scale and an offset."""
    scene.splannequin.shot_path = str(shot)
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    root = addon("shot.scene_objects").part(scene, shot, "root")
    addon("solve.scale").move(scene, shot, np.array(Matrix.Rotation(0.7, 4, (0.3, 1.0, 0.2)) @ Matrix.Scale(2.5, 4)))
    root.location += Vector((3.0, -2.0, 1.0))
    bpy.context.view_layer.update()
    return root


def placed_take(shot: Path, addon, scene, matrix=None) -> dict:
    """Take `freeze` with splats in the current placement, or in the placement `matrix`."""
    placement = addon("shot.placement").placement_in(scene, shot).to_json()
    if matrix is not None:
        placement["scene_from_solve"] = np.asarray(matrix, float).ravel().tolist()
    write_ply(shot / "takes/freeze/frozen.ply", splats(np.reshape(placement["scene_from_solve"], (4, 4))))
    path = shot / "takes/freeze/take.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "placement": placement}))
    addon("process.job_timer").watch_of(shot).state = addon("shot.inventory").read(shot)
    return placement


def pixels_in_solve(shot: Path, frame: int, contract) -> np.ndarray:
    """Projection of `points` by the solve's camera, [P, 2], float64."""
    path = contract.CameraPath.load(shot / "solve/cameras.json")
    splats = next(f for f in path.frames if f.frame == frame)
    viewmat, (fx, fy, cx, cy) = np.reshape(splats.viewmat, (4, 4)), splats.K
    seen = points() @ viewmat[:3, :3].T + viewmat[:3, 3]
    return np.stack([fx * seen[:, 0] / seen[:, 2] + cx, fy * seen[:, 1] / seen[:, 2] + cy], 1)


def pixels_in_blender(scene, camera, places, size) -> np.ndarray:
    """Blender's projection of `places` by a scene camera, [P, 2], y down."""
    scene.render.resolution_x, scene.render.resolution_y = size
    seen = np.array([world_to_camera_view(scene, camera, Vector(p))[:2] for p in places])
    return seen * [size[0], -size[1]] + [0, size[1]]


def test_the_root_is_the_placement(scene, shot, stood, addon, contract):
    scene.unit_settings.scale_length = 0.01
    addon("shot.placement").write(scene, shot)
    placement = contract.Placement.load(shot / "placement.json")
    np.testing.assert_allclose(np.reshape(placement.scene_from_solve, (4, 4)), np.array(stood.matrix_world), atol=1e-5)
    assert placement.metres_per_unit == pytest.approx(0.01)
    assert placement.solve == contract.file_digest(shot / "solve/cameras.json")
    stood.scale.x *= 1.5
    bpy.context.view_layer.update()
    stretched = addon("shot.placement").placement_in(scene, shot)
    assert stretched.scale == pytest.approx(sum(stood.scale) / 3.0, rel=1e-5), "the mean, never a shear"


def test_without_the_shot_in_the_scene_nothing_is_written(scene, shot, addon):
    scene.splannequin.shot_path = str(shot)
    addon("shot.placement").write(scene, shot)
    assert not (shot / "placement.json").exists()


def test_splats_lie_on_the_camera(scene, shot, stood, addon, contract):
    placed_take(shot, addon, scene)
    assert bpy.ops.splannequin.add_splats() == {"FINISHED"}
    item = addon("freeze.splats").find(scene, shot, "freeze")
    assert item.parent == stood and item.name in addon("shot.scene_objects").of(scene, shot).collection.objects
    np.testing.assert_allclose(np.array(item.matrix_world), np.eye(4), atol=1e-5), "their own units are the scene's"
    for frame in (5, 7):
        scene.frame_set(frame)
        places = [item.matrix_world @ v.co for v in item.data.vertices]
        found = pixels_in_blender(scene, scene.camera, places, (16, 12))
        np.testing.assert_allclose(found, pixels_in_solve(shot, frame, contract), atol=1e-3)


def test_splats_follow_a_shot_that_is_moved_later(scene, shot, stood, addon, contract):
    """Set Scale and a rotated floor: the take is not frozen again, and its splats stay aligned with the camera."""
    placed_take(shot, addon, scene)
    bpy.ops.splannequin.add_splats()
    addon("solve.scale").move(scene, shot, np.array(Matrix.Rotation(-0.4, 4, "X") @ Matrix.Scale(7.0, 4)))
    scene.frame_set(6)
    item = addon("freeze.splats").find(scene, shot, "freeze")
    places = [item.matrix_world @ v.co for v in item.data.vertices]
    found = pixels_in_blender(scene, scene.camera, places, (16, 12))
    np.testing.assert_allclose(found, pixels_in_solve(shot, 6, contract), atol=1e-3)


def test_what_a_splat_carries(scene, shot, stood, addon):
    """Compared with the file in float64: linear colour, opacity, standard deviations, unit quaternions."""
    placement = placed_take(shot, addon, scene)
    bpy.ops.splannequin.add_splats()
    item = addon("freeze.splats").find(scene, shot, "freeze")
    rows = splats(np.reshape(placement["scene_from_solve"], (4, 4))).astype(np.float32).astype(np.float64)

    def values(name: str, field: str, width: int) -> np.ndarray:
        data = item.data.attributes[name].data
        flat = np.empty(len(data) * width, np.float32)
        data.foreach_get(field, flat)
        return flat.reshape(-1, width)

    display = np.clip(0.5 + 0.28209479177387814 * rows[:, 6:9], 0, 1)
    light = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    opacity = 1 / (1 + np.exp(-rows[:, 9:10]))
    np.testing.assert_allclose(values("Col", "color", 4), np.hstack([light, opacity]), atol=1e-6)
    np.testing.assert_allclose(values("opacity", "value", 1), opacity, atol=1e-6)
    np.testing.assert_allclose(values("scale", "vector", 3), np.exp(rows[:, 10:13]), rtol=1e-6)
    np.testing.assert_allclose(values("radius", "value", 1)[:, 0], np.exp(rows[:, 10:13].mean(axis=1)), rtol=1e-6)
    length = np.linalg.norm(rows[:, 13:17], axis=1, keepdims=True)
    np.testing.assert_allclose(values("rotation", "value", 4), rows[:, 13:17] / length, atol=1e-6)


def test_the_modifier_shows_points_and_no_bake_shows_them(scene, shot, stood, addon):
    placed_take(shot, addon, scene)
    bpy.ops.splannequin.add_splats()
    item = addon("freeze.splats").find(scene, shot, "freeze")
    assert item.hide_render
    shown = item.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry() if hasattr(
        item, "evaluated_geometry") else None  # fmt: skip
    if shown is not None:
        assert len(shown.pointcloud.points) == COUNT
    group = item.modifiers[0].node_group
    assert all(node.bl_idname != "NodeUndefined" for node in group.nodes) and all(link.is_valid for link in group.links)


def test_one_object_a_take(scene, shot, stood, addon, new_take):
    splats_of = addon("freeze.splats")
    placed_take(shot, addon, scene)
    for _ in range(2):
        bpy.ops.splannequin.add_splats()
    assert [o.type for o in stood.children if "splats" in o.name] == ["MESH"], "the old one was replaced"
    assert len([m for m in bpy.data.meshes if "splats" in m.name]) == 1
    taken = new_take(shot, "late")
    write_ply(taken / "frozen.ply", splats(np.eye(4)))
    scene.splannequin.take_name = "late"
    addon("process.job_timer").watch_of(shot).state = addon("shot.inventory").read(shot)
    bpy.ops.splannequin.add_splats()
    assert {splats_of.find(scene, shot, name) for name in ("freeze", "late")} == {
        o for o in stood.children if "splats" in o.name
    }
    late = splats_of.find(scene, shot, "late")
    np.testing.assert_allclose(np.array(late.matrix_world), np.array(stood.matrix_world), atol=1e-5), "earlier version"
    assert len([g for g in bpy.data.node_groups if g.name.startswith("Splannequin Splats")]) == 1


def begin(scene, shot, addon):
    """Start to add the splats by the timer, up to the first unfinished mesh. Returns the timer and the mesh."""
    timer, before = addon("process.job_timer"), {mesh.session_uid for mesh in bpy.data.meshes}
    timer.work(shot, "freeze", addon("freeze.splats").added_in_turns(scene.session_uid, shot, "freeze"))
    for _ in range(20):
        timer.tick()
        mesh = next((m for m in bpy.data.meshes if m.session_uid not in before), None)
        if mesh is not None:
            return timer, mesh
    raise AssertionError("no mesh was created")


def test_another_file_keeps_its_mesh_of_the_same_name(scene, shot, stood, addon, tmp_path):
    """Another file is opened while splats are added: its own data is not removed."""
    placed_take(shot, addon, scene)
    timer, mesh = begin(scene, shot, addon)
    name = mesh.name
    mesh.use_fake_user = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "B.blend"), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "B.blend"))
    assert name in bpy.data.meshes and all(watch.work is None for watch in timer.watches())


def test_undo_before_the_splats_are_complete_is_a_sentence(scene, shot, stood, addon):
    placed_take(shot, addon, scene)
    for message in ("before", "also before"):
        bpy.ops.ed.undo_push(message=message)
    timer, _ = begin(scene, shot, addon)
    bpy.ops.ed.undo()
    timer.tick()
    watch = timer.watch_of(shot)
    assert watch.failures["freeze"] == ("The mesh was undone before it was complete.", "Add it again.")
    assert watch.work is None and not [m for m in bpy.data.meshes if m.name.endswith("splats")]


def test_splats_go_with_the_shot(scene, shot, stood, addon):
    placed_take(shot, addon, scene)
    bpy.ops.splannequin.add_splats()
    message = addon("process.begin").remove_all(scene, shot)
    assert "Splats were removed." in message
    assert not [b for kind in (bpy.data.objects, bpy.data.meshes) for b in kind if "splats" in b.name]


def test_deleted_splats_are_let_go_of(scene, shot, stood, addon):
    placed_take(shot, addon, scene)
    bpy.ops.splannequin.add_splats()
    for collection in list(addon("freeze.splats").find(scene, shot, "freeze").users_collection):
        collection.objects.unlink(addon("freeze.splats").find(scene, shot, "freeze"))
    assert addon("freeze.splats").find(scene, shot, "freeze") is None
    addon("shot.scene_objects").tidy(scene)
    assert len(addon("shot.scene_objects").of(scene, shot).splats) == 0


def test_what_cannot_be_added_is_said(scene, shot, stood, addon, contract):
    add = addon("freeze.splats").add
    with pytest.raises(RuntimeError, match=r"Take freeze has no splats"):
        addon("process.job_timer").watch_of(shot).state = addon("shot.inventory").read(shot)
        bpy.ops.splannequin.add_splats()
    placed_take(shot, addon, scene)
    file = shot / "takes/freeze/frozen.ply"
    whole = file.read_bytes()
    file.write_bytes(whole[:-8])
    with pytest.raises(ValueError, match="is incomplete"):
        add(scene, shot, "freeze")
    file.write_bytes(whole.replace(b"rot_3", b"rotat"))
    with pytest.raises(ValueError, match="have no rot_3"):
        add(scene, shot, "freeze")
    assert not [m for m in bpy.data.meshes if "splats" in m.name], "nothing half-made stays"


def test_splat_buttons_pass_the_shot_placement(scene, shot, stood, addon, tmp_path):
    """Camera for Nuke, exported by the button: positions of Blender's camera, converted to y up."""
    out = tmp_path / "out"
    assert bpy.ops.splannequin.export_cameras(directory=str(out), format="chan") == {"FINISHED"}
    rows = np.loadtxt(out / "camera.chan")
    for row in rows:
        scene.frame_set(int(row[0]))
        x, y, z = scene.camera.matrix_world.translation
        np.testing.assert_allclose(row[1:4], [x, z, -y], atol=1e-4)
        assert np.radians(row[7]) == pytest.approx(2 * np.arctan(12 / 2 / 20.0), abs=1e-6)


def test_blender_importer_aligns_a_ply_with_the_camera(scene, shot, stood, addon, contract):
    """frozen.ply is in the scene's axes and units, so no rotation is needed."""
    placed_take(shot, addon, scene)
    known = set(bpy.data.objects)
    bpy.ops.wm.ply_import(filepath=str(shot / "takes/freeze/frozen.ply"))
    (item,) = set(bpy.data.objects) - known
    scene.frame_set(7)
    bpy.context.view_layer.update()
    found = pixels_in_blender(scene, scene.camera, [item.matrix_world @ v.co for v in item.data.vertices], (16, 12))
    np.testing.assert_allclose(found, pixels_in_solve(shot, 7, contract), atol=1e-3)


USD = """
import json, sys
from pathlib import Path
from torch_backend.contract import CameraPath, Placement
from torch_backend.freeze.usd import write_usd
from torch_backend.cameras.placement import Similarity
shot, placement, out = sys.argv[1:]
told, path = Placement.load(placement), CameraPath.load(Path(shot) / "solve/cameras.json")
write_usd(Path(out), None, path, Similarity.of(told), told.metres_per_unit, 12.5)
"""


POINTS = """
import json, sys
from pxr import Usd, UsdGeom, Vt
out, places = sys.argv[1], json.loads(sys.argv[2])
stage = Usd.Stage.CreateNew(out)
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/frozen").GetPrim())
if places:
    points = UsdGeom.Points.Define(stage, "/frozen/splats")
    points.CreatePointsAttr(Vt.Vec3fArray([tuple(p) for p in places]))
    points.CreateWidthsAttr([0.1] * len(places))
stage.Save()
"""


def in_backend(addon, root: Path, code: str, *words: str) -> None:
    """Run code in the backend's Python; skip the test if the backend has no usd-core."""
    paths = [str(root), *filter(None, [os.environ.get("USD_CORE")])]
    ran = subprocess.run(
        [addon("process.backend").python(), "-P", "-c", code, *words], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )  # fmt: skip
    if "NoUsdError" in ran.stderr or "No module named 'pxr'" in ran.stderr:
        pytest.skip("the backend has no usd-core")
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("reads", [True, False])
def test_where_blenders_importer_reads_splats_it_is_used(scene, shot, stood, addon, contract, root, monkeypatch, reads):
    """Points stand in for splats, which no Blender imports yet. If the importer returns nothing, the add-on's are
    used."""
    if "import_points" not in addon("compat").usd_import_options():
        pytest.skip("this Blender reads no points from USD")
    placement = placed_take(shot, addon, scene)
    places = splats(np.reshape(placement["scene_from_solve"], (4, 4)))[:, :3].tolist() if reads else []
    in_backend(addon, root, POINTS, str(shot / "takes/freeze/frozen.usdc"), json.dumps(places))
    monkeypatch.setattr(addon("compat"), "splat_import_option", lambda: "import_points")
    known = {o.name for o in scene.objects}
    for _ in range(2):
        bpy.ops.splannequin.add_splats()
    bpy.context.view_layer.update()
    item = addon("freeze.splats").find(scene, shot, "freeze")
    assert {o.name for o in scene.objects} - known == {item.name}, "no empties of the stage, nothing of before"
    assert item.type == ("POINTCLOUD" if reads else "MESH") and item.parent == stood and item.hide_render
    found = item.data.attributes["position"].data if reads else item.data.vertices
    at = [item.matrix_world @ (p.vector if reads else p.co) for p in found]
    scene.frame_set(5)
    seen = pixels_in_blender(scene, scene.camera, at, (16, 12))
    np.testing.assert_allclose(seen, pixels_in_solve(shot, 5, contract), atol=1e-3)


def test_blender_importer_restores_the_camera_pose(scene, shot, stood, addon, contract, root, tmp_path):
    """Blender reads the backend's USD stage with the same pose, lens and offsets on every frame."""
    if not addon("compat").usd_import_options():
        pytest.skip("this Blender reads no USD")
    scene.unit_settings.scale_length = 0.01
    addon("shot.placement").write(scene, shot)
    out = tmp_path / "camera.usdc"
    in_backend(addon, root, USD, str(shot), str(shot / "placement.json"), str(out))
    ours, known = scene.camera, set(bpy.data.objects)
    switches = {"apply_unit_conversion_scale": False}
    switches = {k: v for k, v in switches.items() if k in addon("compat").usd_import_options()}
    bpy.ops.wm.usd_import(filepath=str(out), set_frame_range=False, **switches)
    (camera,) = [o for o in set(bpy.data.objects) - known if o.type == "CAMERA"]
    for frame in (5, 6, 7):
        scene.frame_set(frame)
        splats, expected = ours.evaluated_get(bpy.context.evaluated_depsgraph_get()), camera
        np.testing.assert_allclose(
            np.array(expected.matrix_world.translation), np.array(splats.matrix_world.translation), atol=1e-4
        )
        places = [stood.matrix_world @ Vector(p) for p in points()]
        found = pixels_in_blender(scene, camera, places, (16, 12))
        np.testing.assert_allclose(found, pixels_in_solve(shot, frame, contract), atol=2e-3)


def test_splats_are_added_though_the_artist_dissolved_the_shots_collection(scene, shot, stood, addon):
    placed_take(shot, addon, scene)
    entry = addon("shot.scene_objects").of(scene, shot)
    for item in list(entry.collection.objects):
        scene.collection.objects.link(item)
    bpy.data.collections.remove(entry.collection)
    addon("shot.scene_objects").tidy(scene)
    assert bpy.ops.splannequin.add_splats() == {"FINISHED"}
    item = addon("freeze.splats").find(scene, shot, "freeze")
    assert item is not None and item.parent == stood
