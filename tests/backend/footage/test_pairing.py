"""Pictures are assigned to frames by their whole set of numbers, not one by one."""

import pytest

from torch_backend.footage.pairing import Counted, pair, pairing_words


def step_of(paired):
    """Number that was added to the pictures' numbers; None if the pictures were taken in order."""
    steps = {frame - picture for frame, picture in paired.numbers.items()}
    return steps.pop() if len(steps) == 1 else None


CASES = [
    # pictures, frames, (first, last) of the clip, shift of the import, expected step for masks and for cameras
    (range(1, 101), range(1, 101), (1, 100), 0, 0),
    (range(0, 100), range(1, 101), (1, 100), 0, 1),
    (range(0, 150), range(1, 101), (1, 150), 0, 1),  # pictures of the whole clip, which was imported in part
    (range(0, 150), range(1, 101), (1, 200), 0, 1),
    (range(0, 101), range(1, 101), (1, 100), 0, 1),  # one picture too many for either numbering
    (range(0, 120), range(1, 101), (1, 100), 0, 1),
    (range(0, 120), range(1001, 1101), (1001, 1100), 1000, 1001),
    (range(0, 120), range(5, 101), (5, 100), 0, 0),  # pictures include handles around the clip
    (range(0, 120), range(0, 100), (0, 119), 0, 0),
    (range(1, 101), range(0, 100), (0, 99), 0, -1),
    (range(1, 151), range(51, 101), (1, 150), 0, 0),
    (range(1, 51), range(51, 101), (1, 150), 0, 50),  # pictures of the range only
    (range(99, 120), range(101, 111), (101, 110), 0, 0),
    (range(0, 10), range(101, 111), (101, 110), 0, 101),
    (range(1, 121), range(1011, 1101), (1001, 1120), 0, 1000),
    (range(1001, 1101), range(1, 101), (1, 100), 0, -1000),
    (range(1, 101), range(1001, 1101), (1001, 1100), 1000, 1000),
    (range(1001, 1101), range(1001, 1101), (1001, 1100), 1000, 0),
    (range(0, 150), range(1001, 1051), (951, 1100), 950, 951),
    (range(1, 151), range(1001, 1051), (951, 1100), 950, 950),
    (range(0, 100), range(1, 101), None, 0, 1),  # an import that did not record the clip's length
    (range(1, 151), range(51, 101), None, 0, 0),
]


@pytest.mark.parametrize(("pictures", "frames", "clip", "shift", "step"), CASES)
@pytest.mark.parametrize("needs_all", [True, False])
def test_how_pictures_are_counted(pictures, frames, clip, shift, step, needs_all):
    paired = pair(list(pictures), Counted(list(frames), clip, shift), needs_all)
    assert list(paired.numbers) == list(frames) and step_of(paired) == step
    said = pairing_words("The mask", list(pictures), paired)
    assert step == 0 or f"picture {frames[0] - step} is used for frame {frames[0]}," in said[0]


def test_ambiguous_pairing_is_reported():
    assert pairing_words("The mask", [0], pair(range(0, 101), Counted(list(range(1, 101)), (1, 100)))) is not None
    assert pairing_words("The mask", [0], pair(range(1, 101), Counted(list(range(1, 101)), (1, 100)))) is None


def test_missing_cameras_do_not_shift_others():
    frames = list(range(1, 101))
    for lost in ({3, 50}, {98, 99}, set(range(1, 100, 2)), {*range(40, 90)}):
        kept = [n for n in range(100) if n not in lost]
        paired = pair(kept, Counted(frames, (1, 100)))
        assert step_of(paired) == 1 and list(paired.numbers.values()) == kept


def test_a_mask_that_lacks_a_picture_in_the_middle_is_not_pushed_together():
    pictures = [n for n in range(1, 102) if n != 50]
    assert 50 not in pair(pictures, Counted(list(range(1, 101)), (1, 200)), needs_all=True).numbers


@pytest.mark.parametrize("needs_all", [True, False])
def test_numbering_of_most_frames_is_not_forced_on_all(needs_all):
    paired = pair(range(101, 121), Counted(list(range(105, 125))), needs_all)
    assert step_of(paired) == 0 and list(paired.numbers) == list(range(105, 121))


def test_pictures_that_were_counted_anew_over_a_gap_are_taken_in_order():
    frames = [n for n in range(1, 102) if n != 50]
    paired = pair(range(1, 101), Counted(frames, (1, 101)), needs_all=True)
    assert list(paired.numbers.values()) == list(range(1, 101)) and not paired.by_frame_number


def test_numbers_that_no_count_explains_are_not_pushed_onto_the_frames():
    assert not pair(range(500, 510), Counted(list(range(1, 21)))).numbers
    assert not pair(range(500, 520), Counted(list(range(1, 21))), may_shift=False).numbers
    assert not pair([], Counted([1, 2])).numbers
