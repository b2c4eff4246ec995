"""Kernel code as compiled for GPUs, run on the CPU.

Results equal those of Warp's cpu device bit for bit, except for sums in another order. With sanitizers: `python -m
benchmarks.device_text --sanitize`.
"""

import sys

import pytest

from benchmarks import device_text

KERNELS = {"project", "emit", "ranges", "blend", "blend_backward", "project_backward"}
MORE_KERNELS = {"ssim_pass", "adam", "plane_samples", "plane_gradients", "plane_points", "plane_penalty"}


@pytest.fixture(scope="module")
def launches():
    """Launches of small scenes on fibers and of the other kernels; and (hits, list capacity) of each scene."""
    if sys.platform != "linux":
        pytest.skip("the emulator's fibers are Linux's")
    if device_text.compiler() is None:
        pytest.skip("the emulator needs a C++ compiler (c++, g++ or clang++), and there is none")
    noted = device_text.Launches()
    hits = device_text.note_scenes(noted)
    device_text.note_training_kernels(noted)
    return noted, hits


def test_what_a_gpu_compiles_draws_what_the_fibers_draw(launches, tmp_path):
    noted, hits = launches
    assert any(many > room for many, room in hits) and any(many <= room for many, room in hits)
    noted.write(tmp_path)
    rows, said = device_text.run(device_text.build(tmp_path))
    assert said == "" and len(rows) == len(noted.records) and all(row["whole"] for row in rows)
    assert {row["kernel"].rstrip("0123456789").removeprefix("raster_") for row in rows} == KERNELS | MORE_KERNELS
    assert device_text.judge(rows) == []
