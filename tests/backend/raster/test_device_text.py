"""The text that a GPU compiles of our kernels, run on the CPU: what Warp's cpu device has, to the bit, but for sums of
another order.

Under sanitizers: `python -m benchmarks.device_text --sanitize`.
"""

import sys

import pytest

from benchmarks import device_text

KERNELS = {"project", "emit", "ranges", "blend", "blend_backward", "project_backward"}
OTHERS = {"ssim_pass", "adam", "plane_samples", "plane_gradients", "plane_points", "plane_penalty"}


@pytest.fixture(scope="module")
def launches():
    """Launches of small scenes on fibers and of the other kernels, and (hits, room in their list) of each scene."""
    if sys.platform != "linux":
        pytest.skip("the emulator's fibers are Linux's")
    if device_text.compiler() is None:
        pytest.skip("the emulator needs a C++ compiler (c++, g++ or clang++), and there is none")
    noted = device_text.Launches()
    hits = device_text.note_scenes(noted)
    device_text.note_others(noted)
    return noted, hits


def test_what_a_gpu_compiles_draws_what_the_fibers_draw(launches, tmp_path):
    noted, hits = launches
    assert any(many > room for many, room in hits) and any(many <= room for many, room in hits)
    noted.write(tmp_path)
    rows, said = device_text.run(device_text.build(tmp_path))
    assert said == "" and len(rows) == len(noted.records) and all(row["whole"] for row in rows)
    assert {row["kernel"].rstrip("0123456789").removeprefix("raster_") for row in rows} == KERNELS | OTHERS
    assert device_text.judge(rows) == []


def test_the_emulator_notices_a_sum_over_half_a_warp_and_a_shuffle_that_some_leave_out(launches, tmp_path):
    noted, _ = launches
    few = device_text.Launches()
    few.records, few.bodies = noted.records[:6], noted.bodies
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


@pytest.mark.parametrize(
    ("sound", "wrong", "kernel", "what"),
    [
        ("weight += tap; m[0] += tap * x;", "weight += tap; m[0] += x;", "ssim_pass", "blurreds"),
        ("t[0] += 1.f;", "t[0] += 2.f;", "adam", "reals"),
        ("product.c[c] * s : s", "product.c[c] + s : s", "plane_samples", "results"),
        ("before *= s[k];\n}\n", "}\n", "plane_gradients", "results"),
        ("along[AXES[k][1]] +=", "along[AXES[k][1]] -=", "plane_points", "results"),
        ("pull += 2.f * weight[1]", "pull += weight[1]", "plane_penalty", "grads"),
    ],
)
def test_the_emulator_notices_other_arithmetic_in_the_other_kernels(launches, tmp_path, sound, wrong, kernel, what):
    noted, _ = launches
    few = device_text.Launches()
    few.bodies = {name: body for name, body in noted.bodies.items() if name.rstrip("0123456789") == kernel}
    few.records = [record for record in noted.records if record.startswith(kernel.encode())]
    assert all(sound in body for body in few.bodies.values())
    few.bodies = {name: body.replace(sound, wrong) for name, body in few.bodies.items()}
    few.write(tmp_path)
    rows, _ = device_text.run(device_text.build(tmp_path))
    assert len(rows) == len(few.records) and any(what in row["differs"] for row in rows)
    assert any(f"{what} differs" in line for line in device_text.judge(rows))
