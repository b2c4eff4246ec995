"""The CUDA implementation compiles for the oldest and the newest GPU generation, also on machines without a GPU."""

import re

import pytest

from torch_backend.native import initialised_warp
from torch_backend.raster import cuda, cuda_source

ARCHITECTURES = (75, 120)
MODULES = {cuda.module_name("raster_project"): [(name, 0) for name in cuda_source.stages()]}
MODULES |= {cuda.module_name(name, c): [(name, c)] for c in (3, 22) for name in cuda_source.blending(c)}


@pytest.mark.parametrize("module", MODULES)
def test_kernels_compile_without_local_memory(module, tmp_path, capfd):
    wp = initialised_warp()
    for name, channels in MODULES[module]:
        cuda.build(name, channels)
    paths = wp.compile_aot_module(module, arch=ARCHITECTURES, module_dir=tmp_path, use_ptx=True)
    assert len(paths) == len(ARCHITECTURES)
    for path, arch in zip(paths, ARCHITECTURES, strict=True):
        text = path.read_text(errors="replace")
        assert re.search(rf"^\.target sm_{arch}\b", text, re.MULTILINE)
        for name, _ in MODULES[module]:
            assert re.search(rf"\.entry {name}_\w*cuda_kernel_forward", text), name
        # All data must stay in registers: arrays in local memory make such kernels slow.
        assert "__local_depot" not in text
    assert capfd.readouterr() == ("", "")


def test_machine_code_is_compiled(tmp_path):
    name = "raster_blend_backward"
    cuda.build(name, 3)
    (path,) = initialised_warp().compile_aot_module(
        cuda.module_name(name, 3), arch=75, module_dir=tmp_path, use_ptx=False
    )
    code = path.read_bytes()
    assert code[:4] == b"\x7fELF"
    assert name.encode() in code
