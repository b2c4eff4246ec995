"""The text that a GPU compiles of the rasteriser's kernels, run on the CPU: the same images as the fibers', to the bit.

Under sanitizers: `python -m benchmarks.device_text --sanitize`.
"""

import sys

import pytest

from benchmarks import device_text

KERNELS = {"project", "emit", "ranges", "blend", "blend_backward", "project_backward"}


@pytest.fixture(scope="module")
def launches():
    """Launches of small scenes on fibers, and (hits, room in their list) of each scene."""
    if sys.platform != "linux":
        pytest.skip("the emulator's fibers are Linux's")
    if device_text.compiler() is None:
        pytest.skip("the emulator needs a C++ compiler (c++, g++ or clang++), and there is none")
    noted = device_text.Launches()
    return noted, device_text.note_scenes(noted)


def test_what_a_gpu_compiles_draws_what_the_fibers_draw(launches, tmp_path):
    noted, hits = launches
    assert any(many > room for many, room in hits) and any(many <= room for many, room in hits)
    noted.write(tmp_path)
    rows, said = device_text.run(device_text.build(tmp_path))
    assert said == "" and len(rows) == len(noted.records) and all(row["whole"] for row in rows)
    assert {row["kernel"].rstrip("0123456789").removeprefix("raster_") for row in rows} == KERNELS
    assert device_text.judge(rows) == []


def test_the_emulator_notices_a_sum_over_half_a_warp_and_a_shuffle_that_some_leave_out(launches, tmp_path):
    noted, _ = launches
    few = device_text.Launches()
    few.records, few.kernels = noted.records[:6], noted.kernels
    few.write(tmp_path)
    text = (tmp_path / "kernels.inc").read_text()
    for sound, wrong in (
        ("for (int h = 16; h > 0; h >>= 1)", "for (int h = 8; h > 0; h >>= 1)"),
        ("if (!WARP_ANY(touched)) continue;", "if (!touched) continue;"),
    ):
        assert sound in text
        text = text.replace(sound, wrong)
    (tmp_path / "kernels.inc").write_text(text)
    rows, _ = device_text.run(device_text.build(tmp_path))
    told = {row["kernel"]: (row["met"], set(row["differs"])) for row in rows}
    (blend,) = (name for name in told if name.startswith("raster_blend") and "backward" not in name)
    assert told[blend] == (True, {"weight_sum", "weight_max"})
    assert [name for name, (met, _) in told.items() if not met] == [f"raster_blend_backward{blend[12:]}"]
    wrong = device_text.judge(rows)
    assert any("weight_sum differs" in line for line in wrong)
    assert any("is not reached by all threads" in line for line in wrong)
