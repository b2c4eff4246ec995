import numpy as np
import pytest

from torch_backend.footage.images import read_png, write_png
from torch_backend.freeze.take.contact_sheet import CELL, pick_columns, write_contact_sheet

GROUND = (30, 30, 30)
ACCENT = (250, 194, 76)
ALARM = (226, 74, 51)


def pictures(folder, name, count, height=48, width=64, dtype=np.uint8):
    """Flat pictures; red encodes the index, blue the row."""
    paths = []
    for index in range(count):
        picture = np.empty((height, width, 3), dtype)
        picture[:] = (100 + 10 * index, 0, 250 if name == "frozen" else 120)
        if dtype == np.uint16:
            picture *= 257
        paths.append(folder / name / f"{index:06d}.png")
        write_png(paths[-1], picture)
    return paths


def is_colour(sheet, colour):
    return np.abs(sheet.astype(int) - colour).max(axis=-1) <= 1


def box(mask):
    y, x = np.nonzero(mask)
    return y.min(), y.max() + 1, x.min(), x.max() + 1


def test_contact_sheet_shows_plates_above_their_frozen_frames(tmp_path):
    plates, frozen = pictures(tmp_path, "plates", 4), pictures(tmp_path, "frozen", 4)
    path = write_contact_sheet(tmp_path / "Größe 測試" / "sheet.png", plates, frozen, [12, 13, 14, 15], "shot: t* = 13")
    sheet = read_png(path)
    lefts = []
    for index in range(4):
        above = box(is_colour(sheet, (100 + 10 * index, 0, 120)))
        below = box(is_colour(sheet, (100 + 10 * index, 0, 250)))
        assert above[2:] == below[2:]
        assert above[1] < below[0]
        assert above[3] - above[2] == CELL
        assert above[1] - above[0] == CELL * 48 // 64
        lefts.append(above[2])
    assert lefts == sorted(lefts)
    assert [p.name for p in path.parent.iterdir()] == ["sheet.png"]


def test_title_and_frame_numbers_are_drawn(tmp_path):
    frozen = pictures(tmp_path, "frozen", 2)
    drawn = {}
    for name, frames, title in [("a", [1, 2], "run"), ("b", [1, 7], "run"), ("c", [1, 2], "another run")]:
        drawn[name] = read_png(write_contact_sheet(tmp_path / f"{name}.png", None, frozen, frames, title))
    top, bottom, left, _ = box(is_colour(drawn["a"], (100, 0, 250)))
    second = box(is_colour(drawn["a"], (110, 0, 250)))
    assert (drawn["a"][:top].max(axis=-1) > 200).any()
    assert (drawn["a"][bottom:, left : second[2]].max(axis=-1) > 200).any()
    changed = (drawn["a"] != drawn["b"]).any(axis=-1)
    assert box(changed)[0] >= bottom
    assert box(changed)[2] >= second[2]
    assert box((drawn["a"] != drawn["c"]).any(axis=-1))[1] <= top


def test_the_frame_of_t_star_is_shown_and_outlined(tmp_path):
    frozen = pictures(tmp_path, "frozen", 12)
    sheet = read_png(write_contact_sheet(tmp_path / "a.png", None, frozen, list(range(12)), "t", mark=4, columns=3))
    shown = [i for i in range(12) if is_colour(sheet, (100 + 10 * i, 0, 250)).any()]
    assert shown == [0, 4, 11]
    top, bottom, left, right = box(is_colour(sheet, (140, 0, 250)))
    for y, x in [(top - 2, left), (bottom + 1, left), (top, left - 2), (top, right + 1)]:
        assert is_colour(sheet[y, x], ACCENT)
    top, bottom, left, right = box(is_colour(sheet, (100, 0, 250)))
    assert is_colour(sheet[top - 2, left], GROUND)


def test_frames_that_will_not_hold_lose_a_corner_of_the_frozen_picture(tmp_path):
    plates, frozen = pictures(tmp_path, "plates", 3), pictures(tmp_path, "frozen", 3)
    before = read_png(write_contact_sheet(tmp_path / "a.png", plates, frozen, [1, 2, 3], "t"))
    after = read_png(write_contact_sheet(tmp_path / "b.png", plates, frozen, [1, 2, 3], "t", unsure={2, 9}))
    top, _, _, right = box(is_colour(before, (110, 0, 250)))
    changed = (before != after).any(axis=-1)
    assert box(changed) == (top, top + 22, right - 22, right) and changed.sum() == 22 * 23 // 2
    assert is_colour(after[top, right - 1], ALARM) and is_colour(after[top, right - 30], (110, 0, 250))


def test_note_is_wrapped_under_the_title(tmp_path):
    frozen = pictures(tmp_path, "frozen", 2)
    sheets = {}
    for count in (0, 3, 40):
        note = "word " * count
        sheets[count] = read_png(write_contact_sheet(tmp_path / f"{count}.png", None, frozen, [1, 2], "t", note=note))
    bare, one, many = sheets[0], sheets[3], sheets[40]
    assert len(bare) < len(one) < len(many) and bare.shape[1] == one.shape[1] == many.shape[1]
    top = box(is_colour(one, (100, 0, 250)))[0]
    title = box(is_colour(bare, (100, 0, 250)))[0] - 12  # top of the pictures without a note
    assert (one[title:top].max(axis=-1) > 120).any(), "the note is drawn"
    assert is_colour(many[:, -16:], GROUND).all(), "and never over the border"


def test_takes_portrait_and_16_bit_plates_of_another_size(tmp_path):
    plates = pictures(tmp_path, "plates", 2, 200, 100, np.uint16)
    frozen = pictures(tmp_path, "frozen", 2, 96, 48)
    sheet = read_png(write_contact_sheet(tmp_path / "a.png", plates, frozen, [1, 2], "portrait"))
    for blue in (120, 250):
        top, bottom, left, right = box(is_colour(sheet, (110, 0, blue)))
        assert (bottom - top, right - left) == (CELL, CELL // 2)


@pytest.mark.parametrize("title", ["", "測試 \U0001f600", "x" * 300])
def test_any_title_gives_a_sheet_that_holds_it(tmp_path, title):
    sheet = read_png(write_contact_sheet(tmp_path / "a.png", None, pictures(tmp_path, "frozen", 1), [1], title))
    assert is_colour(sheet, (100, 0, 250)).sum() == CELL * (CELL * 48 // 64)
    assert is_colour(sheet[:, -16:], GROUND).all()


@pytest.mark.parametrize(
    ("frames", "columns", "mark", "expected"),
    [
        (range(100, 160), 8, None, [0, 8, 17, 25, 34, 42, 51, 59]),
        (range(100, 160), 8, 130, [0, 8, 17, 25, 30, 42, 51, 59]),
        (range(100, 160), 8, 101, [0, 1, 17, 25, 34, 42, 51, 59]),
        (range(100, 160), 8, 100, [0, 8, 17, 25, 34, 42, 51, 59]),
        (range(100, 160), 8, 999, [0, 8, 17, 25, 34, 42, 51, 59]),
        (range(100, 160), 1, 130, [30]),
        ([5, 9], 8, 9, [0, 1]),
        ([5], 8, None, [0]),
    ],
)
def test_columns_are_spread_evenly_with_both_ends_and_t_star(frames, columns, mark, expected):
    assert pick_columns(frames, columns, mark) == expected


def test_refuses_lists_that_do_not_match_and_missing_pictures(tmp_path):
    frozen = pictures(tmp_path, "frozen", 2)
    with pytest.raises(ValueError, match="got 1 plate, 2 frozen"):
        write_contact_sheet(tmp_path / "a.png", frozen[:1], frozen, [1, 2], "t")
    with pytest.raises(ValueError, match="at least one"):
        write_contact_sheet(tmp_path / "a.png", None, [], [], "t")
    with pytest.raises(FileNotFoundError, match=r"none\.png"):
        write_contact_sheet(tmp_path / "a.png", None, [tmp_path / "none.png"], [1], "t")
    assert not (tmp_path / "a.png").exists()
