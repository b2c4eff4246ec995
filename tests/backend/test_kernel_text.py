"""The parts of kernel files that are compiled."""

import re
from pathlib import Path

import pytest

from torch_backend.deformation import planes_cuda
from torch_backend.kernel_text import kernel_text
from torch_backend.raster import cpu_source, cuda_source

BACKEND = Path(__file__).resolve().parents[2] / "torch_backend"


def test_the_head_is_not_compiled_and_the_rest_is_to_the_letter(tmp_path):
    (tmp_path / "part.cpp").write_text("// A part.\n\nint part;\n")
    whole = tmp_path / "whole.cpp"
    whole.write_text('// A whole,\n// in two lines.\n\n// Kept.\nint a;\n#include "part.cpp"\n\n  int b; @NAME@\n')
    assert kernel_text(whole) == "\n// Kept.\nint a;\n\nint part;\n\n  int b; @NAME@\n"


def test_line_ends_of_a_checkout_on_windows_change_no_cache_key(tmp_path):
    path = tmp_path / "kernel.cu"
    path.write_bytes(b"// Head.\r\n\r\nint a;\r\n")
    assert kernel_text(path) == "\nint a;\n"


def test_a_file_without_a_head_is_named(tmp_path):
    path = tmp_path / "kernel.cu"
    path.write_text("int a;\n")
    with pytest.raises(ValueError, match=r"kernel\.cu: a kernel file begins with //"):
        kernel_text(path)


def test_every_kernel_file_is_used_and_no_placeholder_is_left():
    texts = [cpu_source.stages_source(), cpu_source.blend_source(3)]
    texts += [*cuda_source.stages().values(), *cuda_source.blending(3).values()]
    texts += [planes_cuda.source(name, 16) for name in ("plane_samples", "plane_gradients", "plane_points")]
    texts.append(planes_cuda.source("plane_penalty", 16))
    assert not [found for text in texts for found in re.findall(r"@\w+@|#include", text)]
    sources = [path.read_text(encoding="utf-8") for path in BACKEND.rglob("*.py")]
    sources += [path.read_text(encoding="utf-8") for path in BACKEND.rglob("kernels/**/*.c*")]
    for path in BACKEND.rglob("kernels/**/*.c*"):
        named = re.compile(rf'["/]{path.name}"|"{path.stem}"')
        assert any(named.search(text) for text in sources), path
