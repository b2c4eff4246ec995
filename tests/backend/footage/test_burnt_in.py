"""Burnt-in logos are found and masked over any moving background; a static camera finds nothing."""

import cv2
import numpy as np
import pytest

from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.footage.burnt_in import find_mark, looked_at
from torch_backend.footage.images import read_png
from torch_backend.footage.masks import read_masks
from torch_backend.shot import Shot

H, W = 180, 320


def grey(frames):
    return [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]


def stamped(frames, x, y, strength=0.6):
    """Frames with a half-transparent ring and cross, 36 pixels wide, at x, y; and the mark's area, bool [H, W]."""
    mark, inside = np.zeros((H, W), np.uint8), np.zeros((H, W), np.uint8)
    cv2.circle(mark, (x, y), 16, 255, 3)
    cv2.line(mark, (x - 10, y), (x + 10, y), 255, 3)
    cv2.line(mark, (x, y - 10), (x, y + 10), 255, 3)
    cv2.circle(inside, (x, y), 18, 1, -1)
    cover = strength * mark[..., None] / 255.0
    shown = [np.rint(frame * (1.0 - cover) + 255.0 * cover).astype(np.uint8) for frame in frames]
    return shown, inside > 0


@pytest.fixture
def panned(pan):
    return pan(30, H, W, speed=4)


def test_a_logo_is_found_whole_where_it_is_and_nothing_else(panned):
    frames, inside = stamped(panned, 280, 150)
    mark = find_mark(grey(frames))
    assert mark is not None
    assert (mark & inside).sum() > 0.97 * inside.sum() and (mark & ~inside).sum() < 0.5 * inside.sum()
    faint, inside = stamped(panned, 40, 30, strength=0.3)
    mark = find_mark(grey(faint))
    assert mark is not None and (mark & inside).sum() > 0.9 * inside.sum()


def test_clean_or_static_clip_has_no_burnt_in_marks(panned, pan):
    assert find_mark(grey(panned)) is None
    frames, _ = stamped([panned[0]] * 30, 280, 150)
    assert find_mark(grey(frames)) is None, "all of it stands: nobody can tell"
    crept, _ = stamped([panned[n // 15] for n in range(30)], 280, 150)
    assert find_mark(grey(crept)) is None
    small, _ = stamped(panned, 280, 150)
    assert find_mark(grey(small)[:8]) is None and find_mark([g[:, :128] for g in grey(small)]) is None


def test_camera_vignette_is_not_masked(panned):
    rimmed = [np.pad(frame[:, :-2], ((0, 0), (0, 2), (0, 0))) for frame in panned]
    assert find_mark(grey(rimmed)) is None


def test_number_of_examined_pictures_is_bounded():
    assert looked_at(0) == [] and looked_at(3) == [0, 1, 2] and len(looked_at(5000)) == 48
    assert looked_at(5000)[0] == 0 and looked_at(5000)[-1] == 4999


def test_import_reports_writes_and_removes_the_burnt_in_mask(tmp_path, panned, write_video, recorder):
    frames, inside = stamped(panned, 280, 150)
    write_video(tmp_path / "marked.mp4", frames, rate=10)
    write_video(tmp_path / "clean.mp4", panned, rate=10)
    shot, report = Shot.create(tmp_path / "a.splannequin"), recorder()
    import_footage(shot, str(tmp_path / "marked.mp4"), FootageConfig(step=1), report)
    (said,) = report.warnings
    record, file = load_frames(shot)["burnt_in"], shot.burnt_in
    assert said.startswith(
        f"{100 * record['share']:.1f} % of the picture stands still while the camera moves, for example a logo"
    )
    assert record["share"] == pytest.approx(float((read_png(file)[..., 0] > 0).mean()), abs=1e-5)
    (mask,) = read_masks(shot, {"ignore": str(file), "people": ""}, recorder()).values()
    assert (mask.of(5) & inside).sum() > 0.97 * inside.sum(), "the solve takes it as it is"
    report = recorder()
    import_footage(shot, str(tmp_path / "clean.mp4"), FootageConfig(step=1), report)
    assert report.warnings == [] and "burnt_in" not in load_frames(shot) and not file.exists()
