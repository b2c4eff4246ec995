"""Camera looks: footage, plates and output are converted by a .cube table."""

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.footage import plate_encoding
from torch_backend.footage.images import read_png
from torch_backend.footage.importing import FootageConfig, import_footage, load_frames
from torch_backend.footage.opening import open_source
from torch_backend.footage.sources import Known, overrides_of
from torch_backend.shot import Shot

CURVE = np.linspace(0.0, 1.0, 33) ** 0.5


def write_1d(path):
    rows = "\n".join(f"{v:.6f} {v:.6f} {v:.6f}" for v in CURVE)
    path.write_text(f'TITLE "a look"\nLUT_1D_SIZE 33\n{rows}\n')
    return path


def write_3d(path, size=17):
    """Write a 3D table that swaps red and blue and brightens the picture."""
    at = np.linspace(0, 1, size) ** 0.5
    rows = "\n".join(f"{b:.6f} {g:.6f} {r:.6f}" for b in at for g in at for r in at)
    path.write_text(f"LUT_3D_SIZE {size}\n{rows}\n")
    return path


def shown(picture, order):
    """[H, W, 3] in 0..1: uint8 codes through the 1D curve with linear interpolation."""
    return np.interp(picture[..., order] / 255.0, np.linspace(0, 1, 33), CURVE)


@pytest.mark.parametrize("kind", ["video", "pictures"])
@pytest.mark.parametrize("size", ["1D", "3D"])
def test_frames_and_plates_are_seen_through_the_look(tmp_path, pan, write_video, recorder, kind, size):
    frames = [np.clip(f, 40, 220) for f in pan(10)]
    if kind == "video":
        write_video(tmp_path / "a.mp4", frames)
        source = tmp_path / "a.mp4"
    else:
        source = tmp_path / "a"
        source.mkdir()
        for n, pixels in enumerate(frames, start=1):
            assert oiio.ImageBuf(np.ascontiguousarray(pixels)).write(str(source / f"f_{n:04d}.png"))
    cube = write_1d(tmp_path / "look.cube") if size == "1D" else write_3d(tmp_path / "look.cube")
    wanted = shown(frames[3], [0, 1, 2] if size == "1D" else [2, 1, 0])
    config = FootageConfig(lut=str(cube))
    shot = Shot.create(tmp_path / "shot")
    import_footage(shot, str(source), config, recorder())
    record = load_frames(shot)
    working = read_png(shot.frames / record["frames"][3]["file"])
    assert working.dtype == (np.uint16 if kind == "pictures" else np.uint8)
    assert np.abs(working / np.iinfo(working.dtype).max - wanted).mean() < 0.01
    opened = open_source(str(source), overrides=overrides_of(config))
    reader = opened.plates(Known({n: (n - 1) / 24 for n in range(1, 11)}, 0.0, lambda *_: True))
    assert np.abs(plate_encoding.display(reader.plate(4)) - wanted).mean() < 0.01
    reader.close()
    assert record["reading"]["colour"] == "by the look look.cube"


def test_another_content_of_the_look_is_another_import(tmp_path, pan, write_video):
    write_video(tmp_path / "a.mp4", pan(8))
    keys = []
    for write in (write_1d, write_3d):
        interpretation = overrides_of(FootageConfig(lut=str(write(tmp_path / "look.cube"))))
        keys.append(open_source(str(tmp_path / "a.mp4"), overrides=interpretation).info.key)
    assert keys[0] != keys[1]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("gone.cube", None, "cannot be read"),
        ("look.txt", "LUT_1D_SIZE 2\n0 0 0\n1 1 1\n", "is not a .cube file"),
        ("words.cube", "not a look\n", "is damaged, or not a .cube table"),
        ("short.cube", "LUT_3D_SIZE 4\n0 0 0\n1 1 1\n", "is damaged, or not a .cube table"),
        ("huge.cube", "LUT_3D_SIZE 9000\n0 0 0\n", "is damaged, or not a .cube table"),
        ("empty.cube", "", "is damaged, or not a .cube table"),
    ],
)
def test_what_is_no_look_is_refused_in_one_sentence(tmp_path, pan, write_video, name, content, words):
    write_video(tmp_path / "a.mp4", pan(8))
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(JobError) as caught:
        open_source(str(tmp_path / "a.mp4"), overrides=overrides_of(FootageConfig(lut=str(tmp_path / name))))
    assert words in caught.value.message and "\n" not in caught.value.message
    assert caught.value.exit_code == ExitCode.FOOTAGE


def test_look_and_colour_space_together_are_refused():
    with pytest.raises(JobError, match="^Both a colour space"):
        overrides_of(FootageConfig(lut="a.cube", colour_space="ACEScg"))
