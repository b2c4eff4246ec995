"""The CUDA body against the float64 oracle: on Warp's CPU fibers everywhere, on the GPU too where there is one."""

import dataclasses
import math
from typing import Any

import pytest
import torch

from torch_backend.native import initialised_warp
from torch_backend.raster import RasterOutput, RasterSettings, cuda, rasterize

GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not GPU, reason="needs an NVIDIA GPU")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=needs_gpu)])
def device(request) -> torch.device:
    """'cpu' means fibers."""
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


def on_host(out: RasterOutput) -> Any:
    moved: dict[str, Any] = {}
    for name in (field.name for field in dataclasses.fields(out)):
        value = getattr(out, name)
        moved[name] = None if value is None else value.cpu()
    return RasterOutput(**moved)


def gradients(scene, device, where=1.0, **options) -> tuple[Any, dict[str, Any]]:
    """As `Scene.gradients`, on `device`; everything that comes back lies on the CPU."""
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


def assert_gradients(grads, reference, relative, bound):
    assert all(torch.isfinite(grad).all() for grad in grads.values())
    errors = {name: relative(grads[name], truth) for name, truth in reference.items()}
    assert max(errors.values()) <= bound, errors


def assert_same_images(a: RasterOutput, b: RasterOutput):
    for field in dataclasses.fields(a):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if left is not None and field.name not in ("hits", "means2d_grad", "means2d_absgrad"):
            assert torch.equal(left, right), field.name


def covering(tools, n=24, width=130, height=90):
    """Gaussians that each cover the image: more tiles than one thread lists, more hits than a first call holds."""
    scene = tools.cloud(n, width, height, seed=8, with_contributions=True)
    scene.tensors["log_scales"] = scene.tensors["log_scales"] * 0.1 + 0.5
    scene.tensors["opacity_logits"] -= 2.0
    return scene


def test_room_matches_the_oracle(small_room, tools, device):
    # A pixel at the alpha cut may fall on either side of it. Few do, and gradients are compared on the others.
    with torch.no_grad():
        same = (run(small_room, device).alphas.cpu() - small_room.run("reference").alphas).abs() < 3e-5
    assert same.float().mean() > 0.998
    out, grads = gradients(small_room, device, same, with_contributions=True)
    ref, ref_grads = small_room.gradients("reference", same, with_contributions=True)
    assert tools.psnr(out.colors, ref.colors) >= 95
    assert_gradients(grads, ref_grads, tools.relative, 1e-4)
    assert (out.radii != ref.radii).sum() <= 1
    assert tools.relative(out.means2d, ref.means2d) < 1e-6
    assert tools.relative(out.weight_sum, ref.weight_sum) < 1e-4
    assert (out.weight_max - ref.weight_max).abs().max() < 5e-3
    assert tools.relative(out.means2d_grad, ref.means2d_grad) < 1e-4
    assert tools.relative(out.means2d_absgrad, ref.means2d_absgrad) < 1e-4
    assert out.weight_sum.double().sum().item() == pytest.approx(out.alphas.double().sum().item(), rel=1e-5)


@pytest.mark.parametrize(("degree", "antialiased"), [(0, True), (1, False), (2, True), (3, False), (3, True)])
def test_harmonics_depth_and_pose(tools, device, degree, antialiased):
    scene = tools.cloud(
        150,
        37,
        29,
        seed=degree,
        channels=5,
        degree=degree,
        with_depth=True,
        settings=RasterSettings(antialiased=antialiased),
    )
    out, grads = gradients(scene, device)
    ref, ref_grads = scene.gradients("reference")
    assert tools.psnr(out.colors, ref.colors) >= 90
    assert_gradients(grads, ref_grads, tools.relative, 1e-3)
    solid = ref.alphas > 0.05
    assert ((out.depth_expected - ref.depth_expected).abs()[solid] < 1e-3).all()
    assert ((out.depth_median - ref.depth_median).abs() > 1e-3).float().mean() < 2e-3
    assert ((out.depth_median == 1e10) == (out.alphas == 0)).all()
    assert ((out.depth_expected == 1e10) == (out.alphas == 0)).all()


@pytest.mark.parametrize("channels", [1, 21])
def test_any_number_of_channels(tools, device, channels):
    scene = tools.cloud(80, 33, 20, seed=channels, channels=channels)
    out, grads = gradients(scene, device)
    ref, ref_grads = scene.gradients("reference")
    assert out.colors.shape == (1, 20, 33, channels)
    assert tools.psnr(out.colors, ref.colors) >= 90
    assert_gradients(grads, ref_grads, tools.relative, 1e-3)


@pytest.mark.parametrize("degree", [1, 2])
def test_cameras_of_a_batch_are_independent_and_their_gradients_add(tools, device, degree):
    scene = tools.cloud(80, 30, 22, seed=4, degree=degree, with_contributions=True, with_top=True)
    other = scene.tensors["viewmats"].clone()
    other[0, :3, 3] += torch.tensor([0.3, 0.1, 0.2])
    away = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))[None] @ scene.tensors["viewmats"]
    views = torch.cat([scene.tensors["viewmats"], away, other])
    Ks = torch.cat([scene.Ks, scene.Ks, tools.camera(30, 22, 35.0, 12.0, 13.0)])
    batch = tools.Scene(scene.tensors | {"viewmats": views}, Ks, 30, 22, scene.options)
    out, grads = gradients(batch, device)
    ref, ref_grads = batch.gradients("reference", with_top=False)
    assert tools.psnr(out.colors, ref.colors) >= 90
    assert_gradients(grads, ref_grads, tools.relative, 1e-3)
    assert tools.relative(out.means2d_grad, ref.means2d_grad) < 1e-3
    for c in range(3):
        one = tools.Scene(scene.tensors | {"viewmats": views[c : c + 1]}, Ks[c : c + 1], 30, 22, scene.options)
        alone = on_host(run(one, device))
        for name in ("colors", "alphas", "radii", "means2d", "weight_sum", "weight_max", "top_ids", "top_weights"):
            assert torch.equal(getattr(out, name)[c], getattr(alone, name)[0]), name


def test_the_top_gaussian_is_the_one_with_the_largest_weight(tools, device):
    scene = tools.cloud(40, 41, 23, seed=6, channels=40)
    # With one channel per Gaussian and no background, the image holds the weights themselves.
    scene.tensors |= {"colors": torch.eye(40).double(), "background": torch.zeros(40).double()}
    weights = scene.run("reference").colors
    scene.tensors |= {"colors": torch.rand(40, 3).double(), "background": torch.zeros(3).double()}
    out = on_host(run(scene, device, with_top=True))
    largest, ids = weights.max(-1)
    clear = (largest - weights.topk(2).values[..., 1]) > 1e-4
    assert out.top_ids.dtype == torch.int32
    assert clear.float().mean() > 0.5
    assert torch.equal(out.top_ids[clear].long(), ids[clear])
    assert (out.top_weights - largest).abs().max() < 5e-3
    assert ((out.top_weights - largest).abs() > 1e-5).float().mean() < 2e-3
    assert torch.equal(out.top_ids == -1, out.alphas == 0)
    assert torch.equal(out.top_weights == 0, out.alphas == 0)


def test_sh_degree_uses_the_first_bands_only(tools, device):
    scene = tools.cloud(60, 24, 17, degree=3)
    low, grads = gradients(scene, device, sh_degree=2)
    scene.tensors["sh"] = scene.tensors["sh"][:, :9]
    high, high_grads = gradients(scene, device)
    assert torch.equal(low.colors, high.colors)
    assert tools.relative(grads["sh"][:, :9], high_grads["sh"]) < 1e-5
    assert (grads["sh"][:, 9:] == 0).all()


def test_absgrad_can_be_left_out(tools, device):
    scene = tools.cloud(60, 24, 17)
    out, _ = gradients(scene, device, settings=RasterSettings(absgrad=False))
    full, _ = gradients(scene, device)
    assert (out.means2d_absgrad == 0).all()
    assert (full.means2d_absgrad >= full.means2d_grad * 0.999).all()
    assert tools.relative(out.means2d_grad, full.means2d_grad) < 1e-5


def test_forward_is_deterministic_and_passes_keep_their_own_state(tools, device):
    a = tools.cloud(300, 50, 40, seed=1, degree=1, with_depth=True, with_contributions=True, with_top=True, channels=5)
    b = tools.cloud(170, 44, 36, seed=2)
    first, _ = gradients(a, device)
    leaves = a.leaves()
    again = run(a, device, leaves)
    run(b, device).colors.sum().backward()
    again.colors.square().sum().backward()
    assert_same_images(first, on_host(again))
    other = a.leaves()
    run(a, device, other).colors.square().sum().backward()
    assert all(tools.relative(leaf.grad, other[name].grad) < 1e-5 for name, leaf in leaves.items())


@pytest.mark.parametrize("cameras", [0, 1])
@pytest.mark.parametrize("n", [0, 3])
def test_nothing_to_see(tools, device, cameras, n):
    scene = tools.cloud(n, 19, 18, with_depth=True, with_contributions=True, with_top=True, channels=5, degree=1)
    scene.tensors["means"][:, 2] = -3.0
    scene.tensors["viewmats"], scene.Ks = scene.tensors["viewmats"][:cameras], scene.Ks[:cameras]
    out, grads = gradients(scene, device)
    assert out.colors.shape == (cameras, 18, 19, 5)
    assert torch.equal(out.colors, scene.tensors["background"].float().expand(cameras, 18, 19, 5))
    assert (out.alphas == 0).all()
    assert (out.depth_median == 1e10).all()
    assert (out.top_ids == -1).all()
    assert out.radii.shape == (cameras, n)
    assert all((grad == 0).all() for name, grad in grads.items() if name != "background")


def test_invalid_gaussians_and_cameras_leave_no_trace(tools, device):
    scene = tools.cloud(40, 30, 22, seed=3, channels=6, degree=1)
    truth = on_host(run(scene, device))
    for name, value in (
        ("means", math.nan),
        ("quats", math.inf),
        ("quats", 0.0),
        ("log_scales", math.inf),
        ("opacity_logits", math.nan),
        ("colors", math.inf),
        ("sh", math.nan),
    ):
        bad = torch.full_like(scene.tensors[name][:1], value)
        for key, tensor in scene.tensors.items():
            if key not in ("viewmats", "background"):
                scene.tensors[key] = torch.cat([tensor, bad if key == name else tensor[:1]])
    out, grads = gradients(scene, device)
    assert torch.equal(out.colors, truth.colors)
    assert all(
        torch.isfinite(grad).all() and (grad[40:] == 0).all()
        for name, grad in grads.items()
        if name not in ("viewmats", "background")
    )
    # Values on a GPU are not checked; there a broken camera sees nothing.
    if device.type == "cuda":
        scene.Ks = scene.Ks * math.nan
        assert (run(scene, device).alphas == 0).all()
    else:
        scene.Ks = scene.Ks * math.nan
        with pytest.raises(ValueError, match="must be finite"):
            run(scene, device)


def test_hits_beyond_the_list_cost_time_only(tools, device, monkeypatch):
    monkeypatch.setattr(cuda, "_HITS_STEP", 1)
    monkeypatch.setattr(cuda, "_demands", {})
    scene = covering(tools)
    with monkeypatch.context() as short:
        short.setattr(cuda, "_HITS_MAX", 96)
        small, small_grads = gradients(scene, device)
    wanted, held = small.hits.tolist()
    assert held == 96 < wanted, "the list should have been too short"
    if GPU:
        torch.cuda.synchronize()  # what the device wanted arrives whenever it arrives
    large, large_grads = gradients(scene, device)
    assert large.hits[0] == wanted
    assert large.hits[1] >= wanted * 1.3
    assert_same_images(small, large)
    assert all(tools.relative(small_grads[name], grad) < 1e-5 for name, grad in large_grads.items())
    ref, ref_grads = scene.gradients("reference")
    assert tools.psnr(large.colors, ref.colors) >= 90
    assert_gradients(large_grads, ref_grads, tools.relative, 1e-3)
    # Once known, the demand stays covered when a quieter view comes in between.
    run(tools.cloud(5, 130, 90), device)
    assert run(scene, device).hits[1] >= wanted


def test_the_first_call_of_a_size_lists_all_its_hits(tools, device, monkeypatch):
    monkeypatch.setattr(cuda, "_HITS_STEP", 1)
    monkeypatch.setattr(cuda, "_demands", {})
    with torch.no_grad():
        wanted, held = run(covering(tools), device).hits.tolist()
        assert wanted > 4 * 24 and wanted <= held <= wanted * 4 // 3 + 1
        # Twice the Gaussians of a round of growth: nobody has to find out by a slow call.
        wanted, held = run(covering(tools, n=48), device).hits.tolist()
    assert wanted <= held


def test_kernels_of_a_module_are_made_together(monkeypatch):
    # One that came later would make Warp unload the others, under CUDA graphs that hold them.
    wp = initialised_warp()
    monkeypatch.setattr(cuda, "_kernels", {("", 0): cuda._structure(wp)})
    monkeypatch.setattr(cuda, "module_name", lambda name, channels=0: "tests.raster.cuda.fresh")
    cuda.build("raster_project")
    assert set(wp.get_module("tests.raster.cuda.fresh").kernels) == set(cuda.source.stages())


def test_training_follows_a_first_call_in_inference_mode(tools, device, monkeypatch):
    monkeypatch.setattr(cuda, "_demands", {})
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


def test_too_many_channels_are_refused(tools, device):
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
