"""The CUDA implementation, compared with the float64 reference: on Warp's CPU fibers, and on a GPU if there is one."""

import dataclasses
import math
from typing import Any

import pytest
import torch

from benchmarks.raster_errors import on_host
from torch_backend.native import initialised_warp
from torch_backend.raster import RasterOutput, cuda, hit_lists, rasterize

GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not GPU, reason="needs an NVIDIA GPU")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=needs_gpu)])
def device(request) -> torch.device:
    """Device of the kernels; 'cpu' runs fibers."""
    return torch.device(request.param)


def run(scene, device, leaves=None, **options) -> Any:
    leaves = scene.leaves() if leaves is None else leaves
    return rasterize(
        **{name: leaf.to(device) for name, leaf in leaves.items()},
        Ks=scene.Ks.to(device),
        width=scene.width,
        height=scene.height,
        backend="cuda",
        **(scene.options | options),
    )


def gradients(scene, device, where=1.0, **options) -> tuple[Any, dict[str, Any]]:
    """Like `Scene.gradients`, on `device`; all results are on the CPU."""
    leaves, generator = scene.leaves(), torch.Generator().manual_seed(5)
    out = run(scene, device, leaves, **options)
    where = torch.as_tensor(where, dtype=torch.float32)
    images = on_host(out)
    loss = (images.colors * torch.randn(images.colors.shape, generator=generator) * where[..., None]).sum()
    loss = loss + (images.alphas * torch.randn(images.alphas.shape, generator=generator) * where).sum()
    if images.depth_expected is not None:
        depth = torch.where(images.alphas > 0.2, images.depth_expected, torch.zeros_like(images.alphas))
        loss = loss + (depth * torch.randn(depth.shape, generator=generator) * where).sum()
    loss.backward()
    return on_host(out), {name: leaf.grad for name, leaf in leaves.items()}


def assert_same_images(a: RasterOutput, b: RasterOutput):
    for field in dataclasses.fields(a):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if left is not None and field.name not in ("hits", "means2d_grad", "means2d_absgrad"):
            assert torch.equal(left, right), field.name


def covering(tools, n=24, width=130, height=90):
    """Gaussians that cover the whole image: more tiles than one thread lists, more hits than the initial list holds."""
    scene = tools.cloud(n, width, height, seed=8, with_contributions=True)
    scene.tensors["log_scales"] = scene.tensors["log_scales"] * 0.1 + 0.5
    scene.tensors["opacity_logits"] -= 2.0
    return scene


def test_forward_is_deterministic_and_passes_do_not_share_state(tools, device):
    a = tools.cloud(300, 50, 40, seed=1, degree=1, with_depth=True, with_contributions=True, with_top=True, channels=5)
    b = tools.cloud(170, 44, 36, seed=2)
    first, _ = gradients(a, device)
    leaves = a.leaves()
    again = run(a, device, leaves)
    run(b, device).colors.sum().backward()
    again.colors.square().sum().backward()
    assert_same_images(first, on_host(again))
    second = a.leaves()
    run(a, device, second).colors.square().sum().backward()
    assert all(tools.relative(leaf.grad, second[name].grad) < 1e-5 for name, leaf in leaves.items())


def test_a_camera_that_is_no_number_is_refused_on_fibers_and_sees_nothing_on_a_gpu(tools, device):
    """Values on a GPU are not checked, because the host would have to synchronise."""
    scene = tools.cloud(40, 30, 22, seed=3)
    scene.Ks = scene.Ks * math.nan
    if device.type == "cuda":
        assert (run(scene, device).alphas == 0).all()
    else:
        with pytest.raises(ValueError, match="must be finite"):
            run(scene, device)


def test_hits_beyond_the_list_cost_time_only(tools, device, monkeypatch):
    monkeypatch.setattr(hit_lists, "HITS_STEP", 1)
    monkeypatch.setattr(hit_lists, "_demands", {})
    scene = covering(tools)
    with monkeypatch.context() as short:
        short.setattr(hit_lists, "HITS_MAX", 96)
        small, small_grads = gradients(scene, device)
    wanted, listed = small.hits.tolist()
    assert listed == 96 < wanted, "the list should have been too short"
    if GPU:
        torch.cuda.synchronize()  # the demand arrives asynchronously
    large, large_grads = gradients(scene, device)
    assert large.hits[0] == wanted
    assert large.hits[1] >= wanted * 1.3
    assert_same_images(small, large)
    assert all(tools.relative(small_grads[name], grad) < 1e-5 for name, grad in large_grads.items())
    ref, ref_grads = scene.gradients("reference")
    assert tools.psnr(large.colors, ref.colors) >= 90
    tools.assert_gradients(large_grads, ref_grads, 1e-3)
    # A smaller view in between does not reduce the known demand.
    run(tools.cloud(5, 130, 90), device)
    assert run(scene, device).hits[1] >= wanted


def test_the_first_call_of_a_size_lists_all_its_hits(tools, device, monkeypatch):
    monkeypatch.setattr(hit_lists, "HITS_STEP", 1)
    monkeypatch.setattr(hit_lists, "_demands", {})
    with torch.no_grad():
        wanted, listed = run(covering(tools), device).hits.tolist()
        assert wanted > 4 * 24 and wanted <= listed <= wanted * 4 // 3 + 1
        # Twice as many Gaussians, as after a round of growth, still fit at the first call.
        wanted, listed = run(covering(tools, n=48), device).hits.tolist()
    assert wanted <= listed


def test_kernels_of_a_module_are_compiled_together(monkeypatch):
    # If a kernel were added later, Warp would unload the others, which CUDA graphs still use.
    wp = initialised_warp()
    monkeypatch.setattr(cuda, "_kernels", {("", 0): cuda._structure(wp)})
    monkeypatch.setattr(cuda, "module_name", lambda name, channels=0: "tests.raster.cuda.fresh")
    cuda.build("raster_project")
    assert set(wp.get_module("tests.raster.cuda.fresh").kernels) == set(cuda.source.stages())


def test_training_follows_a_first_call_in_inference_mode(tools, device, monkeypatch):
    monkeypatch.setattr(hit_lists, "_demands", {})
    scene = tools.cloud(20, 24, 17)
    with torch.inference_mode():
        seen = on_host(run(scene, device))
    out, grads = gradients(scene, device)
    assert torch.equal(out.colors, seen.colors)
    assert grads["means"].abs().sum() > 0


def test_second_derivatives_are_refused(tools, device):
    leaves = tools.cloud(20, 24, 17).leaves()
    out = run(tools.cloud(20, 24, 17), device, leaves)
    (grad,) = torch.autograd.grad(out.colors.square().sum(), leaves["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


def test_wide_tile_numbers_sort_alike(tools, device, monkeypatch):
    scene = tools.cloud(60, 50, 40, seed=2)
    narrow = on_host(run(scene, device))
    monkeypatch.setattr(cuda.source, "WIDE_FROM", 1)
    assert_same_images(narrow, on_host(run(scene, device)))


def test_channel_count_above_the_limit_is_refused(tools, device):
    with pytest.raises(ValueError, match="at most 56"):
        run(tools.cloud(3, 9, 9, channels=57), device)


@pytest.mark.skipif(GPU, reason="needs a machine without an NVIDIA GPU")
def test_without_a_usable_gpu_one_sentence_says_what_to_do():
    with pytest.raises(RuntimeError, match="update the NVIDIA driver to version 580"):
        cuda.warm_up(3, "cuda")


@needs_gpu
def test_the_host_never_waits_for_the_gpu(tools):
    scene = tools.cloud(300, 64, 48, degree=2, with_depth=True, with_contributions=True, with_top=True)
    leaves = {name: leaf.detach().cuda().requires_grad_() for name, leaf in scene.leaves().items()}
    Ks = scene.Ks.float().cuda()

    def step() -> None:
        out: Any = rasterize(**leaves, Ks=Ks, width=64, height=48, **scene.options)
        (out.colors.sum() + out.depth_expected.clamp_max(10).sum()).backward()

    step()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        step()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@needs_gpu
def test_a_training_step_is_captured_as_a_cuda_graph(tools):
    scene = tools.cloud(300, 64, 48, degree=1)

    def setup():
        leaves = {
            name: leaf.detach().cuda().requires_grad_(name not in ("viewmats", "background"))
            for name, leaf in scene.leaves().items()
        }
        return leaves, torch.optim.Adam([leaf for leaf in leaves.values() if leaf.requires_grad], 1e-2, capturable=True)

    Ks, target = scene.Ks.float().cuda(), torch.full((1, 48, 64, 3), 0.5, device="cuda")

    def step(leaves, optimizer):
        optimizer.zero_grad(set_to_none=False)
        out: Any = rasterize(**leaves, Ks=Ks, width=64, height=48)
        loss = (out.colors - target).square().mean()
        loss.backward()
        optimizer.step()
        return loss, out.hits

    leaves, optimizer = setup()
    eager = [step(leaves, optimizer)[0].item() for _ in range(23)]
    leaves, optimizer = setup()
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            step(leaves, optimizer)
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        loss, hits = step(leaves, optimizer)
    replayed = []
    for _ in range(20):
        graph.replay()
        replayed.append(loss.item())
    assert replayed == pytest.approx(eager[3:], rel=1e-3)
    assert replayed[-1] < replayed[0]
    assert 0 < hits[0] <= hits[1]
