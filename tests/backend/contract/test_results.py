"""Verdicts and measurements from files: values of the wrong form are ignored."""

import pytest

from torch_backend.contract import verdict_lines, verdict_of
from torch_backend.contract.results import measured


@pytest.mark.parametrize(
    "row",
    [
        {},
        {"seconds": 1.0},
        {"seconds": True, "heldout_psnr_db": 30.0},
        {"seconds": "1", "heldout_psnr_db": 30.0},
        {"seconds": 1.0, "heldout_psnr_db": float("nan")},
        {"seconds": 1e12, "heldout_psnr_db": 30.0},
    ],
)
def test_what_is_no_measurement_is_none(row):
    assert measured(row) is None


def test_a_measurement_is_two_numbers():
    assert measured({"seconds": 2, "heldout_psnr_db": 31.5, "more": "x"}) == (2.0, 31.5)


@pytest.mark.parametrize(
    "verdict",
    [None, 7, "good", {}, {"word": "good"}, {"word": "best", "sentences": ["A."]}, {"word": "good", "sentences": []},
     {"word": "good", "sentences": ["A.", 3]}, {"word": "good", "sentences": ["A."], "more": 1},
     {"word": "good", "sentences": "A."}],
)  # fmt: skip
def test_a_verdict_that_cannot_be_shown_is_none(verdict):
    assert verdict_of({"verdict": verdict}) is None and verdict_lines({"verdict": verdict}, {}) == []


def test_lines_of_two_verdicts_have_no_duplicates():
    run = {"verdict": {"word": "fair", "sentences": ["The left is soft."], "advice": ["Film slower."]}}
    take = {"verdict": {"word": "good", "sentences": ["97 % plate.", "Frame 7 is torn."], "advice": ["Film slower."]}}
    assert verdict_lines(run, {}, take) == [
        "Fair. The left is soft.", "Film slower.", "Good. 97 % plate.", "Frame 7 is torn.",
    ]  # fmt: skip
