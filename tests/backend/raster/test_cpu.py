"""The CPU backend alone; test_bodies.py compares images and gradients of every backend with the float64 reference."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torch_backend.native import build, initialised_warp
from torch_backend.raster import RasterSettings, cpu_source


def test_a_median_depth_is_where_half_is_crossed_or_that_of_the_largest_weight(tools):
    """Some pixels reach an alpha of one half, others do not: 37 x 21 px, 60 Gaussians, `with_top` or not."""
    for with_top in (False, True):
        scene = tools.cloud(60, 37, 21, seed=11, with_depth=True, with_top=with_top)
        cpu, ref = scene.run("cpu"), scene.run("reference")
        seen = ref.alphas > 0.01
        crossed, never = seen & (ref.alphas > 0.52), seen & (ref.alphas < 0.48)
        assert min(int(crossed.sum()), int(never.sum())) > 100
        for kind in (crossed, never):
            assert ((cpu.depth_median - ref.depth_median).abs()[kind] > 1e-3).float().mean() < 0.01
        if with_top:
            assert (cpu.top_ids[seen] != ref.top_ids[seen]).float().mean() < 0.01
            assert (cpu.top_weights - ref.top_weights).abs().max() < 1e-3


@pytest.mark.parametrize("body", ["cpu", "reference"])
@pytest.mark.parametrize("degree", [0, 3])
def test_split_harmonics_equal_joined_ones(tools, body, degree):
    scene = tools.cloud(100, 50, 41, degree=3)
    together, expected = scene.gradients(body, sh_degree=degree)
    sh = scene.tensors["sh"]
    scene.tensors.update(sh=sh[:, :1].clone(), sh_rest=sh[:, 1:].clone())
    split, grads = scene.gradients(body, sh_degree=degree)
    assert torch.equal(split.colors, together.colors)
    joined = torch.cat([grads.pop("sh"), grads.pop("sh_rest")], dim=1)
    assert torch.equal(joined, expected.pop("sh"))
    assert all(torch.equal(grad, expected[name]) for name, grad in grads.items())


@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("cameras", [1, 2])
def test_gradients_of_invisible_gaussians_are_zero_in_reused_memory(tools, cameras, split):
    scene = tools.cloud(200, 50, 41, degree=2)
    scene.tensors["means"][::3, 2] = -5.0  # behind the camera
    tensors = scene.tensors | {"viewmats": scene.tensors["viewmats"].repeat(cameras, 1, 1)}
    if split:
        tensors |= {"sh": tensors["sh"][:, :1].clone(), "sh_rest": tensors["sh"][:, 1:].clone()}
    scene = tools.Scene(tensors, scene.Ks.repeat(cameras, 1, 1), 50, 41, scene.options)
    _, expected = scene.gradients("reference", sh_degree=1)
    torch.use_deterministic_algorithms(True)  # makes torch fill uninitialised memory with NaN
    try:
        _, grads = scene.gradients("cpu", sh_degree=1)
    finally:
        torch.use_deterministic_algorithms(False)
    tools.assert_gradients(grads, expected, 1e-3)
    assert all((grad[::3] == 0).all() for name, grad in grads.items() if len(grad) == 200)


def test_mismatched_split_harmonics_are_refused(tools):
    scene = tools.cloud(6, 8, 8, degree=1)
    sh = scene.tensors["sh"]
    for first, rest in ((sh, sh[:, 1:]), (sh[:, :1], sh[:, 1:3]), (sh[:, :1], sh[1:, 1:]), (None, sh[:, 1:])):
        scene.tensors.pop("sh", None)
        scene.tensors.update({} if first is None else {"sh": first})
        with pytest.raises(ValueError, match="sh"):
            scene.run("cpu", sh_rest=rest)


def test_thread_count_does_not_change_a_bit(tools):
    scene = tools.cloud(3000, 130, 70, degree=1, with_depth=True, with_contributions=True, with_top=True)
    one, one_grads = scene.gradients("cpu", settings=RasterSettings(threads=1))
    for threads in (2, 5):
        many, many_grads = scene.gradients("cpu", settings=RasterSettings(threads=threads))
        # only the CUDA implementation has this field
        filled = {name: value for name, value in vars(one).items() if name != "hits"}
        for name, value in filled.items():
            assert torch.equal(value, getattr(many, name)), name
        for name, grad in one_grads.items():
            assert torch.equal(grad, many_grads[name]), name


def test_front_gaussian_of_coincident_ones_is_on_top(tools):
    scene = tools.single(logit=0.0)
    twice = {
        name: torch.cat((value, value))
        if name in ("means", "quats", "log_scales", "opacity_logits", "colors")
        else value
        for name, value in scene.tensors.items()
    }
    out = tools.Scene(twice, scene.Ks, 16, 16).run("cpu", with_top=True)
    assert set(out.top_ids.unique().tolist()) <= {-1, 0}
    assert (out.top_ids == 0).any()


def test_interleaved_passes_of_any_sizes_do_not_share_state(tools):
    """Work space is reused: passes of a larger scene must leave no trace."""
    scenes = [tools.cloud(200, 40, 30), tools.cloud(2000, 100, 90, seed=9, degree=3, channels=5, with_depth=True)]
    single = [scene.gradients("cpu") for scene in scenes]
    leaves = [scene.leaves() for scene in scenes]
    images = [scene.run("cpu", leaf, with_contributions=True) for scene, leaf in zip(scenes, leaves)]
    for out in images:
        tools.scalar(out).backward()
    for (expected, grads), out, leaf in zip(single, images, leaves):
        for name in ("colors", "alphas", "means2d_grad", "means2d_absgrad"):
            assert torch.equal(getattr(expected, name), getattr(out, name)), name
        assert all(torch.equal(grad, leaf[name].grad) for name, grad in grads.items())


def test_no_grad_mode_and_float64_work(tools):
    scene = tools.cloud(60, 24, 17)
    with torch.no_grad():
        out = scene.run("cpu")
    assert not out.colors.requires_grad
    leaves = scene.leaves(torch.float64)
    wide = scene.run("cpu", leaves)
    assert torch.equal(wide.colors, out.colors)
    wide.colors.sum().backward()
    assert leaves["means"].grad.dtype == torch.float64


def test_concurrent_callers_do_not_disturb_each_other(tools):
    scenes = [tools.cloud(400 + 50 * i, 60 + i, 50, seed=i) for i in range(3)]
    single = [scene.gradients("cpu") for scene in scenes]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda i: scenes[i % 3].gradients("cpu"), range(24)))
    for i, (out, grads) in enumerate(together):
        assert torch.equal(out.colors, single[i % 3][0].colors)
        assert all(torch.equal(grad, single[i % 3][1][name]) for name, grad in grads.items())


def test_compiling_is_silent(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(initialised_warp().config, "kernel_cache_dir", str(tmp_path))
    build("silent", cpu_source.blend_source(1))
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()), "the kernel was compiled elsewhere"


def test_a_first_call_is_silent_and_forked_children_create_new_threads(tmp_path):
    code = """
import os, torch
from torch_backend.raster import RasterSettings, rasterize
torch.set_num_threads(1)
def run():
    e = torch.eye(4)[None]
    return rasterize(torch.rand(3000, 3) + 1, torch.ones(3000, 4), torch.full((3000, 3), -3.), torch.zeros(3000),
                     torch.ones(3000, 1), viewmats=e, Ks=e[:, :3, :3] * 30, width=90, height=70,
                     settings=RasterSettings(threads=3))
run()
if hasattr(os, "fork"):
    child = os.fork()
    if child == 0:
        run()
        os._exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
"""
    command = [sys.executable, "-W", "ignore", "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert run.stdout == run.stderr == ""
