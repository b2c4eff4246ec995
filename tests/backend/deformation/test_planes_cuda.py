"""The GPU's planes: accepted inputs and compiled code. test_planes.py checks values and gradients."""

import re

import pytest
import torch

from tests.backend.deformation.test_planes import fields, points
from torch_backend.deformation import HexPlaneConfig, planes_cuda
from torch_backend.native import initialised_warp


def test_what_it_does_not_take_is_refused_and_what_the_self_test_refused_is_torchs(monkeypatch):
    ours, exact = fields()
    taken = ours._by_level()
    assert planes_cuda.supports(taken)
    assert not planes_cuda.supports(exact._by_level())
    assert not planes_cuda.supports([p.detach().contiguous() for p in taken])
    with pytest.raises(ValueError, match="float32 on one device"):
        planes_cuda.features(torch.zeros(1, 4), exact._by_level())
    with pytest.raises(ValueError, match="float32 on one device"):
        planes_cuda.penalty(exact._by_level(), [(1.0, 1.0, 1.0)] * 12)
    monkeypatch.setattr(planes_cuda, "refused", "a kernel does not build or run on it")
    assert not planes_cuda.supports(taken)
    assert HexPlaneConfig().row_bytes() > 1024  # torch's implementation keeps every sample
    monkeypatch.undo()
    assert HexPlaneConfig().row_bytes() + 4 * 10 * 16 * 2 == 4 * (12 * 16 * 2 + 64 * 15)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_field_on_a_gpu_uses_its_kernels():
    ours, _ = fields()
    field, where = ours.to("cuda"), points().cuda()
    got = field.features_at(where[:, :3], where[:, 3])
    assert torch.equal(got, planes_cuda.features(where, field._by_level()))


@pytest.mark.parametrize("arch", [75, 90, 120])
def test_kernels_compile_for_absent_gpus(tmp_path, arch):
    wp = initialised_warp()
    module = planes_cuda.kernels(16).samples.module
    wp.compile_aot_module(module, arch=arch, module_dir=str(tmp_path), use_ptx=True)
    (ptx,) = tmp_path.rglob("*.ptx")
    text = ptx.read_text(errors="replace")
    # A thread reads four channels at once, adds with atomics, and keeps its data in registers.
    assert len(re.findall(r"ld\.(global\.)?v4", text)) == 24 and text.count("atom.global.add.f32") == 24
    assert "ld.local" not in text
