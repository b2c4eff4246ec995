"""A tiny world of this folder, and a finished run of it that is trained once."""

import shutil

import pytest

from tests.backend.conftest import build_world
from tests.backend.quiet import Quiet
from tests.backend.trainings import short
from torch_backend.train import train_shot


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """The solved tiny shot. A freeze of another folder's world adds mattes to it, with which a run is another run."""
    return build_world(tmp_path_factory.mktemp("train"))


@pytest.fixture(scope="session")
def master(world):
    """Folder of a finished run of 60 steps; tests must not change it."""
    train_shot(world.shot, short("master"), Quiet())
    return world.shot.run("master")


@pytest.fixture
def finished(world, master):
    """finished("x"): folder of a finished run x, a copy of `master`."""
    return lambda name: shutil.copytree(master, world.shot.run(name))
