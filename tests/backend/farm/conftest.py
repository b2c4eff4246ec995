"""Shots with the records of an import, for code that only reads records."""

import dataclasses

import pytest

from torch_backend.contract import FreezeParams, ImportParams, ShotFolder, SolveParams, TrainParams, write_json


def _imported(root, name, first=1, last=20, size=(640, 360), source=(1920, 1080)):
    """Write a shot folder with the records of an import."""
    shot = ShotFolder(root / f"{name}.splannequin")
    write_json(shot.info_path, {"version": 1, "name": name, "first": first, "last": last})
    frames = [{"frame": n, "file": f"raw/{n:06d}.png"} for n in range(first, last + 1)]
    record = {"frames": frames, "width": size[0], "height": size[1], "source_size": list(source)}
    write_json(shot.listing, record)
    return shot


@pytest.fixture
def requests():
    """requests(**freeze): parameters of a command line without options, except these of the freeze."""

    def make(**freeze):
        params = FreezeParams(only_missing=True)
        return {
            "import": ImportParams(),
            "solve": SolveParams(),
            "train": TrainParams(),
            "freeze": dataclasses.replace(params, **freeze),
        }

    return make


@pytest.fixture
def shot(tmp_path):
    """shot(name, ...): writes an imported shot into the test's folder."""
    return lambda name, **words: _imported(tmp_path / "shots", name, **words)


@pytest.fixture
def imported():
    """imported(folder, name, ...): writes an imported shot into a folder."""
    return _imported
