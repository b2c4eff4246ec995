"""Peak memory of every implementation on inputs that could exhaust it, each in a separate process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.raster_errors import BODIES
from tests.backend.raster.test_hard_cases import on_every_body

ROOT = Path(__file__).resolve().parents[3]
COMPILED = [body for body in BODIES if not body.startswith("reference")]
on_compiled_bodies = pytest.mark.parametrize("body", COMPILED)
on_every_program = pytest.mark.parametrize("body", [body for body in BODIES if body != "reference32"])
"""Without the float32 reference, which allocates the same tensors at half the size."""

CHILD = """
import resource, sys
import torch
from benchmarks.raster_cases import size
from benchmarks.raster_errors import BODIES, cloud, compare, single, stack
body = sys.argv[1]
_, dtype, device = BODIES[body]
resource.setrlimit(resource.RLIMIT_AS, (24 << 30,) * 2)  # whatever asks for more is refused, not the machine swamped
cloud(20, 20, 20).gradients(body)  # compiled and loaded
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
start = peak()
"""


def in_a_child(code, body, timeout=240):
    """Run code in a separate process, because peak memory is measured per process; return its last line as numbers."""
    pytest.importorskip("resource", reason="no peak of memory on this system")
    if sys.platform != "linux":
        pytest.skip("ru_maxrss has other units here")
    # Otherwise glibc learns to keep freed blocks, and peaks vary by a factor of two.
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MALLOC_MMAP_THRESHOLD_": "65536"}
    run = subprocess.run(
        [sys.executable, "-c", CHILD + code, body],
        capture_output=True,
        text=True,
        timeout=timeout,
        env=environment,
        cwd=ROOT,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return [float(v) for v in run.stdout.split()[-3:]]


@on_every_program
def test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel(body):
    # On the CPU more than 2^24 pixels, the largest count of float32; weights and gradients must still add up.
    side = {"cpu": 4128, "gpu": 4128, "cuda": 64}.get(body, 256)
    grown, weight, gradient = in_a_child(
        f"""
scene = single({side}, {side}, focal={side}.0, scale=8.0, logit=1.0)
leaves = scene.leaves(dtype, device)
out = scene.run(body, leaves, with_contributions=True)
out.colors.sum().backward()
alpha = out.alphas.detach().double().sum().item()
print(peak() - start, out.weight_sum.item() / alpha, leaves["colors"].grad[0, 0].item() / alpha)
""",
        body,
    )
    assert weight == pytest.approx(1, abs=1e-3)
    assert gradient == pytest.approx(1, abs=1e-3)
    # Image, alpha and their gradients: 32 bytes. The reference keeps tens of tensors per (pixel, Gaussian) for
    # autograd.
    each = 100 if body in COMPILED else 2000
    assert grown <= each * side * side + 64e6


@on_every_program
def test_ten_thousand_gaussians_in_one_pixel_take_memory_by_the_gaussian(body):
    count = 500 if body == "cuda" else 10_000
    is_reference = body not in COMPILED
    count *= 4 if is_reference else 1
    grown, _, _ = in_a_child(
        f"""
scene = size("10,000 Gaussians in one pixel", body)
for name in scene.tensors.keys() - {{"viewmats", "background"}}:
    scene.tensors[name] = torch.cat([scene.tensors[name]] * {4 if is_reference else 1})
out, grads = scene.gradients(body)
print(peak() - start, 0, 0)
""",
        body,
    )
    # The reference blends 2^20 (pixel, Gaussian) pairs at once; its forty tensors exceed the ten thousand Gaussians.
    step = 40 * 2**20 * BODIES[body][1].itemsize if is_reference else 64e6
    assert grown <= 4096 * count + step


@on_compiled_bodies
def test_more_hits_than_an_index_holds_are_refused_before_memory_is_taken(body):
    # 200,000 Gaussians over 11,236 tiles each: 2.2e9 pairs, above 2^31 and any available memory.
    if body == "cuda":
        pytest.skip("on fibers this would take hours; its list has a fixed capacity, see test_cuda.py")
    grown, refused, _ = in_a_child(
        """
scene = stack(single(1696, 1696, focal=1000.0, scale=20.0, logit=-4.0), 200_000)
try:
    scene.run(body)
    refused = 0
except RuntimeError as error:
    assert "200000 Gaussians cover 2247200000 tiles of a 1696x1696 image" in str(error), error
    refused = 1
print(peak() - start, refused, 0)
""",
        body,
    )
    assert refused
    assert grown <= 512e6


@on_every_body
def test_images_wider_than_a_tile_column_can_say_are_refused(tools, body):
    # 600,000 px are 37,500 tiles; a column index has 15 bits. Pixel positions of that size are also inexact in float32.
    scene = tools.single(600_000, 1, focal=1000.0, mean=(1100.0, 0.0, 2.0), scale=0.05)
    with pytest.raises(ValueError, match="width"):
        scene.run(body)
    scene.width, scene.height = 1, 600_000
    with pytest.raises(ValueError, match="height"):
        scene.run(body)
