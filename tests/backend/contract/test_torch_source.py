"""Choice of the PyTorch package in a set-up, and whether it includes CUDA."""

import pytest

from torch_backend.contract import CPU_INDEX, CUDA_INDEX, TORCH_INDEX, brings_cuda, torch_index

ROWS = [
    # system, has NVIDIA driver, has suitable GPU, index, includes CUDA
    ("linux", False, False, CPU_INDEX, False),
    ("linux", True, False, "", True),
    ("linux", True, True, "", True),
    ("win32", False, False, "", False),
    ("win32", True, False, "", False),
    ("win32", True, True, CUDA_INDEX, True),
    ("darwin", False, False, "", False),
]


@pytest.mark.parametrize(("system", "driver", "fits", "index", "cuda"), ROWS)
def test_torch_comes_with_cuda_where_a_card_can_use_it(monkeypatch, system, driver, fits, index, cuda):
    monkeypatch.delenv(TORCH_INDEX, raising=False)
    assert torch_index(system, driver, lambda: fits) == index
    assert brings_cuda(index, system) is cuda
    monkeypatch.setenv(TORCH_INDEX, "https://somewhere.else/simple")
    assert torch_index(system, driver, lambda: fits) == "https://somewhere.else/simple", "somebody's wish"


@pytest.mark.parametrize(("system", "driver"), [("linux", True), ("linux", False), ("win32", False), ("darwin", True)])
def test_slow_gpu_query_runs_only_where_it_matters(monkeypatch, system, driver):
    def has_card() -> bool:
        raise AssertionError("nobody needs to know")

    monkeypatch.delenv(TORCH_INDEX, raising=False)
    torch_index(system, driver, has_card)
    monkeypatch.setenv(TORCH_INDEX, "")
    assert torch_index("win32", True, has_card) == ""


@pytest.mark.parametrize(
    ("index", "linux", "windows"),
    [
        ("", True, False),
        ("https://download.pytorch.org/whl/cu126/", True, True),
        ("https://download.pytorch.org/whl/cpu/", False, False),
        ("https://mirror.studio/pytorch-cpu/simple", False, False),
        ("file:///srv/wheels", True, False),
    ],
)
def test_what_an_index_brings_is_read_from_its_name_or_else_is_what_pypi_has(index, linux, windows):
    assert brings_cuda(index, "linux") is linux
    assert brings_cuda(index, "win32") is brings_cuda(index, "darwin") is windows
