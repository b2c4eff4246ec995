"""Complete and truncated files of every format that Blender writes."""

from pathlib import Path

import bpy
import pytest

PICTURES = {
    "PNG": {}, "JPEG": {}, "WEBP": {}, "BMP": {}, "IRIS": {}, "HDR": {}, "TARGA": {}, "TARGA_RAW": {}, "CINEON": {},
    "DPX": {}, "TIFF": {}, "JPEG2000": {}, "OPEN_EXR": {}, "OPEN_EXR_MULTILAYER": {},
}  # fmt: skip
MOVIES = {"MPEG4": "H264", "QUICKTIME": "MPEG4", "MKV": "H264", "WEBM": "WEBM", "AVI": "MPEG4", "OGG": "THEORA"}


def media(settings, kind: str) -> None:
    if hasattr(settings, "media_type"):
        settings.media_type = kind


@pytest.mark.parametrize("kind", PICTURES)
def test_truncated_picture_is_detected(addon, scene, tmp_path, kind):
    noise = bpy.data.images.new("noise", 96, 64)
    noise.pixels.foreach_set([(7919 * n % 1009) / 1009 for n in range(96 * 64 * 4)])
    settings = scene.render.image_settings
    media(settings, "MULTI_LAYER_IMAGE" if kind.endswith("LAYER") else "IMAGE")
    settings.file_format = kind
    path = tmp_path / f"picture{scene.render.file_extension}"
    scene.render.resolution_x, scene.render.resolution_y = 96, 64
    if kind.endswith("LAYER"):  # only an image from a render has layers to write
        tree = addon("compat").new_compositor_tree(scene, "tree")
        shown = tree.nodes.new("CompositorNodeImage")
        shown.image = noise
        tree.links.new(shown.outputs[0], addon("compat").output_socket(tree))
        addon("compat").enable_compositor(scene)
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
    else:
        noise.save_render(str(path), scene=scene)
    check(addon, path, -600 if kind.startswith("TARGA") else -3)  # a Targa file ends with a footer after all pixels


@pytest.mark.parametrize("container", MOVIES)
def test_truncated_movie_is_detected(addon, scene, tmp_path, container):
    media(scene.render.image_settings, "VIDEO")
    scene.render.image_settings.file_format = "FFMPEG"
    scene.render.ffmpeg.format, scene.render.ffmpeg.codec = container, MOVIES[container]
    scene.render.resolution_x, scene.render.resolution_y, scene.frame_end = 96, 64, 3
    tree = addon("compat").new_compositor_tree(scene, "tree")
    colour = tree.nodes.new("CompositorNodeRGB")
    tree.links.new(colour.outputs[0], addon("compat").output_socket(tree))
    addon("compat").enable_compositor(scene)
    scene.render.filepath = str(tmp_path / "movie")
    bpy.ops.render.render(animation=True)
    (path,) = tmp_path.iterdir()
    check(addon, path, -3)


@pytest.mark.parametrize("is_compressed", [True, False])
def test_truncated_blend_is_detected(addon, tmp_path, is_compressed):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"), compress=is_compressed)
    check(addon, tmp_path / "file.blend", -1)


def check(addon, path: Path, last: int) -> None:
    is_whole, data = addon("bake.rendering").contract.is_whole_picture, path.read_bytes()
    assert is_whole(path)
    for length in (0, 10, 100, len(data) // 2, len(data) + last):
        path.write_bytes(data[:length])
        assert not is_whole(path), f"{length} of {len(data)} bytes"
    path.unlink()
    assert not is_whole(path)
