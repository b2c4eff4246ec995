"""A bake into a scene without a compositor tree: the plate is the footage itself, not a copy."""

import json
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.addon.data import make_detail, pixels
from tests.addon.data import make_levels as levels
from tests.addon.data import make_shoulder as shoulder

DATA = Path(__file__).resolve().parent / "data"
SIZE = make_detail.WIDTH, make_detail.HEIGHT
SRGB = tuple(float(((v + 0.055) / 1.055) ** 2.4) for v in (0.78125, 0.390625, 0.1953125))
LINEAR = (0.78125, 0.390625, 0.1953125)


@pytest.fixture
def footage(scene, shot, tmp_path):
    """footage(...): sets up the take `detail` of an EXR sequence next to the shot, with these facts in take.json."""
    folder = tmp_path / "the plate"
    shutil.copytree(make_detail.FOLDER / "plate", folder)
    take = make_detail.add_take(shot)
    scene.render.resolution_x, scene.render.resolution_y = SIZE

    def write_take(**changes):
        named = {"file": str(folder / "000005.exr"), "beside": "../the plate/000005.exr"}
        make_detail.write_facts(take, **{**named, **changes})
        return shot

    return write_take


def node_of(addon, scene):
    return addon("bake.freeze_group").group_node(addon("compat").compositor_tree(scene))


def render(*args):
    return pixels.render(*args)[..., :3]


def st_map(path: Path, places: np.ndarray) -> None:
    """Write an ST map for a picture of the same size; `places` [H, W, 2] are pixels from the top left."""
    height, width = places.shape[:2]
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., 0] = (places[..., 0] + 0.5) / width
    pixels[..., 1] = 1.0 - (places[..., 1] + 0.5) / height
    image = bpy.data.images.new("map", width, height, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.ascontiguousarray(pixels[::-1]).ravel())
    path.parent.mkdir(exist_ok=True)
    image.filepath_raw, image.file_format = str(path), "OPEN_EXR"
    image.save()
    bpy.data.images.remove(image)


def test_mix_0_is_the_footage_bit_for_bit_and_no_copy_is_shown(addon, scene, footage, tmp_path):
    said = addon("bake.insertion").insert_freeze(scene, footage(), "detail")
    assert "The footage 000005.exr is used as the plate, 56 x 42." in said
    shown = [Path(bpy.path.abspath(image.filepath)) for image in bpy.data.images if image.name.startswith("Plate")]
    assert [path.suffix for path in shown] == [".exr"] and "the plate" in str(shown[0])
    node_of(addon, scene).inputs["Mix"].default_value = 0.0
    for frame in (5, 6):
        assert np.array_equal(render(scene, tmp_path, frame), make_detail.plate(frame))


@pytest.mark.parametrize("shift", [4, -90])
def test_footage_that_the_shot_numbers_otherwise_is_shown_at_the_shots_frames(addon, scene, footage, tmp_path, shift):
    """An Image node shows the file; its number differs from the scene frame."""
    shot = footage(shift=shift)
    folder = tmp_path / "the plate"
    for frame in (5, 6):
        (folder / f"{frame:06d}.exr").rename(folder / f"moved.{frame - shift:06d}.exr")
    take = shot / "takes" / "detail" / "take.json"
    facts = json.loads(take.read_text())
    facts["footage"]["file"] = str(folder / f"moved.{5 - shift:06d}.exr")
    take.write_text(json.dumps(facts))
    said = addon("bake.insertion").insert_freeze(scene, shot, "detail")
    assert any("is used as the plate, 56 x 42." in line for line in said)
    node_of(addon, scene).inputs["Mix"].default_value = 0.0
    for frame in (5, 6):
        assert np.array_equal(render(scene, tmp_path, frame), make_detail.plate(frame))


def test_acescg_footage_is_brought_to_the_scenes_light(addon, scene, footage, tmp_path):
    """Under Blender's default configuration, scene light is linear Rec.709."""
    matrix = np.array([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]])
    said = addon("bake.insertion").insert_freeze(scene, footage(probe=(matrix @ LINEAR).tolist()), "detail")
    assert "The footage 000005.exr is used as the plate, 56 x 42." in said
    node_of(addon, scene).inputs["Mix"].default_value = 0.0
    found, expected = render(scene, tmp_path, 6), make_detail.plate(6) @ matrix.T
    assert float((np.abs(found - expected).max(-1) / np.abs(expected).max(-1)).max()) < 1e-3


def test_the_freeze_as_a_warp_works_on_the_footage_itself(addon, scene, footage, tmp_path):
    """Values from -0.2 to 50, which a PNG cannot store."""
    addon("bake.insertion").insert_freeze(scene, footage(), "detail", warp=True)
    found, delivered = render(scene, tmp_path, 6), make_detail.frozen(6)
    assert delivered.max() > 40
    assert float((np.abs(found - delivered) / np.maximum(np.abs(delivered), 0.01)).max()) < 1e-3


def test_take_map_undistorts_the_plate(addon, scene, footage, tmp_path):
    shot = footage(map="stmap/undistort.exr")
    st_map(shot / "takes" / "detail" / "stmap" / "undistort.exr", make_detail.places(6))
    said = addon("bake.insertion").insert_freeze(scene, shot, "detail")
    assert "The footage 000005.exr is used as the plate, 56 x 42, undistorted by the take's ST map." in said
    node_of(addon, scene).inputs["Mix"].default_value = 0.0
    found, expected = render(scene, tmp_path, 6), make_detail.moved(make_detail.plate(6), 6)
    assert float((np.abs(found - expected) / np.maximum(np.abs(expected), 0.05)).max()) < 2e-3


def test_new_bake_replaces_the_old_without_leftovers(addon, scene, footage):
    shot = footage(map="stmap/undistort.exr")
    kinds = ("images", "node_groups", "textures")
    before = {kind: set(getattr(bpy.data, kind).keys()) for kind in kinds}
    st_map(shot / "takes" / "detail" / "stmap" / "undistort.exr", make_detail.places(6))
    bake = addon("bake.insertion")
    bake.insert_freeze(scene, shot, "detail")
    once = {kind: set(getattr(bpy.data, kind).keys()) for kind in kinds}
    bake.insert_freeze(scene, shot, "detail")
    assert {kind: set(getattr(bpy.data, kind).keys()) for kind in kinds} == once
    footage()
    bake.insert_freeze(scene, shot, "detail")
    assert not [g.name for g in bpy.data.node_groups if "Undistort" in g.name]
    assert not [i.name for i in bpy.data.images if "Undistort" in i.name]
    footage(map="stmap/undistort.exr")
    bake.insert_freeze(scene, shot, "detail")
    assert bake.remove(scene)
    assert {kind: set(getattr(bpy.data, kind).keys()) for kind in kinds} == before


def test_prefetch_reads_the_footage(addon, scene, footage):
    bake, shot = addon("bake.insertion"), footage()
    assert len(list(bake.prefetch(scene, shot, "detail"))) == 2
    bake.insert(scene, shot, "detail")
    assert not addon("scene.sequences")._prefetched, "it is taken as it was read"
    assert [i.name for i in bpy.data.images if i.name.startswith("Plate")] == ["Plate 000005"]


def test_lens_map_is_prefetched_and_reread_after_a_change(addon, scene, footage, tmp_path):
    """Reading a map blocks Blender's window, so each map has its own turn. The first bake here is never inserted."""
    bake, shot = addon("bake.insertion"), footage(map="stmap/undistort.exr")
    for frame in (5, 6):
        st_map(shot / "takes" / "detail" / "stmap" / "undistort.exr", make_detail.places(frame))
        assert len(list(bake.prefetch(scene, shot, "detail"))) == 3
    read = next(image for image in bpy.data.images if image.name.startswith("Plate"))
    assert read.alpha_mode == "NONE", "to be set while it is inserted it would be read once more"
    bake.insert(scene, shot, "detail")
    assert not addon("scene.sequences")._prefetched, "they are taken as they were read"
    node_of(addon, scene).inputs["Mix"].default_value = 0.0
    found, expected = render(scene, tmp_path, 6), make_detail.moved(make_detail.plate(6), 6)
    assert float((np.abs(found - expected) / np.maximum(np.abs(expected), 0.05)).max()) < 2e-3


def test_a_video_shows_frame_n_at_frame_n(addon, scene, footage, tmp_path):
    """Frame n shows the n-th picture, with the brightness of its luma."""
    size = levels.WIDTH, levels.HEIGHT
    footage_facts = {"file": str(DATA / "levels.mp4"), "size": list(size), "first": 1, "last": levels.FRAMES}
    shot = footage(**footage_facts, probe=list(SRGB), space="video, Rec.709")
    scene.render.resolution_x, scene.render.resolution_y = size
    said = addon("bake.insertion").insert_freeze(scene, shot, "detail")
    assert "The footage levels.mp4 is used as the plate, 64 x 48." in said
    node_of(addon, scene).inputs["Mix"].default_value = 0.0
    for frame in (5, 6):
        light = render(scene, tmp_path, frame, size)[20, 30]
        shown = 255.0 * np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        assert np.abs(shown - (levels.level(frame) - 16) / 219 * 255).max() < 1.2


@pytest.mark.parametrize("code, rows", [(3, (-1, 0, 0, 0, -1, 0)), (6, (0, 1, 0, -1, 0, 0)), (8, (0, -1, 0, 1, 0, 0))])
def test_rotated_video_is_used_where_blender_rotates_it(addon, scene, footage, tmp_path, code, rows):
    data = bytearray((DATA / "levels.mp4").read_bytes())
    at = data.find(b"tkhd") + 44
    data[at : at + 24] = np.array([65536 * value for value in rows], ">i4").tobytes()
    (tmp_path / "turned.mp4").write_bytes(bytes(data))
    size = [levels.WIDTH, levels.HEIGHT] if code == 3 else [levels.HEIGHT, levels.WIDTH]
    footage_facts = {
        "file": str(tmp_path / "turned.mp4"),
        "size": size,
        "first": 1,
        "last": levels.FRAMES,
        "orientation": code,
    }
    said = addon("bake.insertion").insert_freeze(scene, footage(**footage_facts, probe=list(SRGB)), "detail")
    turns = addon("compat").TURNS_VIDEOS
    image = bpy.data.images.load(str(tmp_path / "turned.mp4"))
    if code != 3:
        assert (list(image.size) == size) == turns, "what this Blender does is what is known of it"
    itself = any(line.startswith("The footage turned.mp4 is used as the plate") for line in said)
    assert itself == turns and turns != any("its header rotates the image" in line for line in said)


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"unlike": "its pixels are not square"}, "000005.exr: its pixels are not square"),
        ({"file": "/nowhere/a.0001.exr", "beside": ""}, "a.0001.exr no longer exists"),
        ({"size": [64, 48]}, "Blender reads 000005.exr at 56 x 42"),
        (
            {"probe": [7.0, 0.3, 0.2], "space": "a log"},
            "Blender's colour configuration has no colour space that matches a log",
        ),
        ({"map": "stmap/undistort.exr"}, "the take's ST map no longer exists"),
    ],
)
def test_working_frames_replace_unusable_footage_with_a_reason(addon, scene, footage, changes, why):
    said = addon("bake.insertion").insert_freeze(scene, footage(**changes), "detail")
    assert f"The compositor shows working frames as the plate, not the footage: {why}." in said
    shown = [image for image in bpy.data.images if image.name.startswith("Plate")]
    assert len(shown) == 1 and shown[0].filepath.endswith(".png")


def test_footage_that_blender_does_not_read_is_called_that(addon, scene, footage, tmp_path):
    (tmp_path / "f_0005.jxl").write_bytes(b"\xff\x0a of a format that is not known to it")
    said = addon("bake.insertion").insert_freeze(scene, footage(file=str(tmp_path / "f_0005.jxl")), "detail")
    assert any(line.endswith("not the footage: Blender cannot read f_0005.jxl.") for line in said)


@pytest.mark.parametrize(
    "name", ["frame-0001.png", "photo (1).png", "f_0001_left.png", "f_0001_v2.png", "a2_b[1]+.png"]
)
def test_blender_looks_for_the_files_that_the_import_says_it_does(contract, tmp_path, name):
    shutil.copy(DATA / "detail" / "plate" / "000005.exr", tmp_path / name)
    image = bpy.data.images.load(str(tmp_path / name))
    image.source = "SEQUENCE"
    background = bpy.data.cameras.new("camera").background_images.new()
    background.image, user = image, background.image_user
    user.frame_duration = 200000
    for frame in (3, 12, 12345):
        user.frame_current = frame
        found = Path(image.filepath_from_user(image_user=user)).name
        assert found == contract.file_as_blender_counts(name, frame)


def test_footage_moved_together_with_the_shot_is_found(addon, scene, footage):
    shot = footage(file="/nowhere/000005.exr")
    assert "The footage 000005.exr is used as the plate, 56 x 42." in addon("bake.insertion").insert_freeze(
        scene, shot, "detail"
    )


def test_a_take_of_before_shows_the_working_frames_as_it_did(addon, scene, shot):
    said = addon("bake.insertion").insert_freeze(scene, shot, "freeze")
    assert not [line for line in said if "plate" in line.lower() and "footage" in line]
    assert [i.filepath[-4:] for i in bpy.data.images if i.name.startswith("Plate")] == [".png"]


def test_colour_spaces_are_known_by_any_light_they_give(addon, contract):
    compat = addon("compat")
    assert compat.colour_space(contract.PROBE) == compat.colour_space("linear")
    assert compat.colour_space(SRGB) == compat.colour_space("srgb")
    ap1 = (1.07292, 0.34180, 0.15606)  # light in ACEScg, by the published matrix
    assert "ACEScg" in compat.colour_space(ap1)
    assert not compat.knows_colour((3.0, 0.1, 7.0))


@pytest.mark.parametrize("warp", [False, True])
def test_frames_and_warps_of_acescg_footage_are_read_in_their_light(addon, scene, footage, tmp_path, warp):
    """This also holds after the same files held Rec.709 frames."""
    shot, bake = footage(), addon("bake.insertion")
    bake.insert_freeze(scene, shot, "detail", warp=warp)
    take = shot / "takes" / "detail"
    shutil.copytree(DATA / "detail_ap1", take, dirs_exist_ok=True)
    for stale in (take / "000005.exr", take / "warp" / "000005.exr"):
        stale.unlink()
    bake.insert_freeze(scene, shot, "detail", warp=warp)
    for _ in range(2):
        found, expected = render(scene, tmp_path, 6), make_detail.frozen(6)
        assert float((np.abs(found - expected).max(-1) / np.maximum(np.abs(expected).max(-1), 0.01)).max()) < 1e-3
        bake.insert_freeze(scene, shot, "detail", warp=warp)


def test_working_frames_restore_highlights_from_their_shoulder(addon, contract, scene, footage, tmp_path):
    """Light up to 60 is recovered by the compositor. If the record has no shoulder, the frames are read as sRGB."""
    shot = footage(unlike="its pixels are not square")
    light = shoulder.light(*SIZE)
    assert (contract.SHOULDER_FROM, contract.SHOULDER_ROLL) == (shoulder.START, shoulder.ROLL)
    for frame in (5, 6):
        shoulder.write(shot / "frames" / f"{frame:06d}.png", light)
    listing = contract.ShotFolder(shot).listing
    record = json.loads(listing.read_text())
    cut = ((shoulder.shown(light) + 0.055) / 1.055) ** 2.4
    for display, expected in (({"display": "shoulder"}, light), ({}, cut)):
        listing.write_text(json.dumps({**record, **display}))
        addon("bake.insertion").insert_freeze(scene, shot, "detail")
        node_of(addon, scene).inputs["Mix"].default_value = 0.0
        assert np.abs(render(scene, tmp_path, 6) / expected - 1.0).max() < 2e-3
    groups = [group.name for group in bpy.data.node_groups if group.name.startswith("Splannequin Working Light")]
    assert groups == [], "what is not shown any more is gone"
