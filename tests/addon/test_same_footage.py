"""Detection of data-blocks that show the plate, for all spellings of a path."""

import os
import shutil
import zlib

import bpy
import numpy as np
import pytest


@pytest.fixture
def plate(tmp_path, pictures):
    """Three frames of a plate, version v002, and a v001 with the same numbers and other pictures."""
    folder = tmp_path / "plates"
    folder.mkdir()
    for n in (5, 6, 7):
        for version in (1, 2):
            colour = np.full((12, 16, 3), 40 * version + n, np.uint8)
            pictures.write(folder / f"plate.v00{version}.{n:04d}.png", colour)
    return folder / "plate.v002.0005.png"


@pytest.fixture
def video(tmp_path):
    """File that Blender does not have to read; only name and bytes matter."""
    path = tmp_path / "plates" / "clip.mov"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(zlib.compress(os.urandom(3_000_000), 0))
    return path


def image(path, source):
    """Data-block as stored in a .blend file: unread, with the stored path."""
    data = bpy.data.images.new("plate", 4, 4)
    data.source, data.filepath = source, str(path)
    return data


def spelled(kind, file, tmp_path, monkeypatch):
    """Path of the same footage as `file`, in another spelling."""
    if kind == "relative":
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "comp" / "shot.blend"), check_existing=False)
        return "//../plates/" + file.name
    if kind == "dotted":
        return file.parent / ".." / "plates" / "." / file.name
    if kind == "linked folder":
        (tmp_path / "mount").symlink_to(file.parent, target_is_directory=True)
        return tmp_path / "mount" / file.name
    if kind == "hard links":
        (tmp_path / "mount").mkdir()
        for each in file.parent.iterdir():
            os.link(each, tmp_path / "mount" / each.name)
        return tmp_path / "mount" / file.name
    if kind == "linked files":
        (tmp_path / "published").mkdir()
        for each in file.parent.iterdir():
            (tmp_path / "published" / each.name.replace("plate", "bg")).symlink_to(each)
        return tmp_path / "published" / file.name.replace("plate", "bg")
    assert kind == "copy"
    shutil.copytree(file.parent, tmp_path / "copy")
    for each in (tmp_path / "copy").iterdir():
        os.utime(each, (1, 1))
    return tmp_path / "copy" / file.name


SPELLINGS = ["relative", "dotted", "linked folder", "hard links", "linked files", "copy"]


@pytest.mark.parametrize("kind", SPELLINGS)
@pytest.mark.parametrize("named", ["0007", "####", "0099"])
def test_a_sequence_is_known_by_any_of_its_pictures(addon, plate, tmp_path, monkeypatch, kind, named):
    """This includes a missing picture: the number in a path does not matter."""
    (tmp_path / "comp").mkdir()
    path = str(spelled(kind, plate, tmp_path, monkeypatch)).replace("0005", named)
    shows = addon("scene.same_footage").shows
    assert shows(image(path, "SEQUENCE"), [plate])
    assert shows(image(path, "SEQUENCE"), [plate.with_name("plate.v002.####.png")])
    other_version = path.replace("v002", "v001")
    assert not shows(image(other_version, "SEQUENCE"), [plate]), "another version of the plate, with the same numbers"
    assert not shows(image(path, "MOVIE"), [plate]) and not shows(None, [plate])


@pytest.mark.parametrize("kind", SPELLINGS)
def test_a_video_is_known_by_its_file(addon, video, tmp_path, monkeypatch, kind):
    (tmp_path / "comp").mkdir()
    data = video.read_bytes()
    (video.parent / "plate.mov").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    path = spelled(kind, video, tmp_path, monkeypatch)
    shows = addon("scene.same_footage").shows
    assert shows(image(path, "MOVIE"), [video])
    assert not shows(image(path, "MOVIE"), [video.with_name("plate.mov")]), "as long, and other in its last byte"
    assert not shows(image(path, "MOVIE"), [tmp_path / "gone.mov"])


def test_clip_and_image_of_one_footage_match_and_a_still_does_not(addon, plate):
    shows = addon("scene.same_footage").shows
    clip = bpy.data.movieclips.load(str(plate.with_name("plate.v002.0006.png")))
    assert clip.source == "SEQUENCE" and shows(clip, [plate])
    assert not shows(image(plate.with_name("plate.v002.0006.png"), "FILE"), [plate])
    assert shows(image(plate, "FILE"), [plate])


def test_footage_that_was_chosen_by_its_folder(addon, plate):
    for each in plate.parent.glob("plate.v001*"):
        each.unlink()
    shows = addon("scene.same_footage").shows
    assert shows(image(plate, "SEQUENCE"), [plate.parent])
    assert not shows(image(plate, "SEQUENCE"), [plate.parent.parent])


def test_the_freeze_goes_behind_a_plate_of_a_project_that_was_moved(addon, scene, shot, plate, tmp_path, contract):
    """shot.json names a missing folder; the .blend file and the plates were moved together."""
    info = contract.read_json(shot / "shot.json")
    contract.write_json(shot / "shot.json", {**info, "source": f"/old/project/plates/{plate.name}"})
    listing = contract.read_json(shot / "frames" / "frames.json")
    relative_path = os.path.relpath(plate, shot)
    contract.write_json(shot / "frames" / "frames.json", {**listing, "beside": relative_path})
    compat = addon("compat")
    tree = compat.new_compositor_tree(scene, "Artist")
    node, second_node = (tree.nodes.new("CompositorNodeImage") for _ in range(2))
    node.image = bpy.data.images.load(str(plate.with_name("plate.v002.0006.png")))
    second_node.image = bpy.data.images.load(str(plate.with_name("plate.v001.0005.png")))
    node.image.source = second_node.image.source = "SEQUENCE"
    over = tree.nodes.new("CompositorNodeAlphaOver")
    for source, place in ((node, 1), (second_node, 2)):
        tree.links.new(source.outputs["Image"], [s for s in over.inputs if s.type == "RGBA"][place - 1])
    tree.links.new(over.outputs[0], compat.output_socket(tree))
    addon("bake.insertion").insert(scene, shot, "freeze")
    group = addon("bake.freeze_group").group_node(tree)
    assert [link.to_node for link in node.outputs["Image"].links] == [group]
    assert [link.to_node for link in second_node.outputs["Image"].links] == [over]
