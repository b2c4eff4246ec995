"""Inputs that `rasterize` refuses; the message names the argument."""

import math

import pytest
import torch

from tests.backend.raster.test_hard_cases import on_every_body
from torch_backend.raster import RasterSettings, rasterize


@on_every_body
def test_wrong_arguments_are_named(tools, body):
    scene = tools.cloud(5, 8, 8)
    wrong = {
        "quats": scene.tensors["quats"][:, :3],
        "means": scene.tensors["means"][:, :2],
        "log_scales": scene.tensors["log_scales"][:4],
        "colors": scene.tensors["colors"][0],
        "background": torch.zeros(4),
        "viewmats": torch.eye(3)[None],
    }
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=name):
            scene.run(body, scene.leaves() | {name: value})
    with pytest.raises(ValueError, match="finite"):
        scene.run(body, scene.leaves() | {"viewmats": torch.full((1, 4, 4), math.nan)})
    with pytest.raises(ValueError, match="K = 1, 4, 9 or 16"):
        scene.run(body, sh=torch.zeros(5, 5, 3))
    with pytest.raises(ValueError, match="near"):
        scene.run(body, settings=RasterSettings(near=0.0))
    with pytest.raises(ValueError, match="near"):
        scene.run(body, settings=RasterSettings(near=math.nan))
    with pytest.raises(ValueError, match="width"):
        rasterize(**scene.leaves(), Ks=scene.Ks, width=0, height=4)


def test_a_backend_that_does_not_exist_is_named(tools):
    with pytest.raises(ValueError, match="backend"):
        rasterize(**tools.cloud(5, 8, 8).leaves(), Ks=tools.camera(8, 8, 7.0), width=8, height=8, backend="opengl")


def test_unsupported_device_gives_a_readable_error(tools):
    scene = tools.cloud(5, 8, 8)
    leaves = {name: value.to("meta") for name, value in scene.tensors.items() if name != "viewmats"}
    with pytest.raises(NotImplementedError, match="meta"):
        scene.run("auto", leaves | {"viewmats": torch.eye(4)[None]})
