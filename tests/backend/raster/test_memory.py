"""Peak memory of the implementations that users run on inputs that could exhaust it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.raster_errors import BODIES
from tests.backend.raster.test_hard_cases import on_every_body

ROOT = Path(__file__).resolve().parents[3]

CHILD = """
import resource, sys
import torch
from benchmarks.raster_cases import size
from benchmarks.raster_errors import BODIES, cloud, single, stack
body = sys.argv[1]
_, dtype, device = BODIES[body]
resource.setrlimit(resource.RLIMIT_AS, (24 << 30,) * 2)  # whatever asks for more is refused, not the machine swamped
cloud(20, 20, 20).gradients(body)  # compiled and loaded
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
start = peak()

size("10,000 Gaussians in one pixel", body).gradients(body)
print(peak() - start)
scene = stack(single(1696, 1696, focal=1000.0, scale=20.0, logit=-4.0), 200_000)
try:
    scene.run(body)
except RuntimeError as error:
    print(error)
del scene
print(peak() - start)
scene = single(4128, 4128, focal=4128.0, scale=8.0, logit=1.0)
leaves = scene.leaves(dtype, device)
out = scene.run(body, leaves, with_contributions=True)
out.colors.sum().backward()
alpha = out.alphas.detach().double().sum().item()
print(peak() - start, out.weight_sum.item() / alpha, leaves["colors"].grad[0, 0].item() / alpha)
"""


@pytest.mark.parametrize("body", [body for body in BODIES if body in ("cpu", "gpu")])
def test_memory_grows_by_the_gaussian_and_by_the_pixel(body):
    """Three scenes in one process, the hungriest last, because the peak is measured per process."""
    pytest.importorskip("resource", reason="no peak of memory on this system")
    if sys.platform != "linux":
        pytest.skip("ru_maxrss has other units here")
    # Otherwise glibc learns to keep freed blocks, and peaks vary by a factor of two.
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MALLOC_MMAP_THRESHOLD_": "65536"}
    run = subprocess.run(
        [sys.executable, "-c", CHILD, body], capture_output=True, text=True, timeout=240, env=environment, cwd=ROOT
    )
    assert run.returncode == 0, run.stderr[-2000:]
    crowd, refusal, refused, giant = run.stdout.splitlines()
    assert float(crowd) <= 4096 * 10_000 + 64e6
    # 200,000 Gaussians over 11,236 tiles each: 2.2e9 pairs, above 2^31 and any available memory.
    assert "200000 Gaussians cover 2247200000 tiles of a 1696x1696 image" in refusal
    assert float(refused) <= 512e6
    # More than 2^24 pixels, the largest count of float32; weights and gradients must still add up.
    grown, weight, gradient = map(float, giant.split())
    assert weight == pytest.approx(1, abs=1e-3)
    assert gradient == pytest.approx(1, abs=1e-3)
    # Image, alpha and their gradients: 32 bytes.
    assert grown <= 100 * 4128 * 4128 + 64e6


@on_every_body
def test_images_wider_than_a_tile_column_can_say_are_refused(tools, body):
    # 600,000 px are 37,500 tiles; a column index has 15 bits. Pixel positions of that size are also inexact in float32.
    scene = tools.single(600_000, 1, focal=1000.0, mean=(1100.0, 0.0, 2.0), scale=0.05)
    with pytest.raises(ValueError, match="width"):
        scene.run(body)
    scene.width, scene.height = 1, 600_000
    with pytest.raises(ValueError, match="height"):
        scene.run(body)
