"""Fuzzes each parser of files from disk: it returns, or raises the error that it documents, with one sentence.

pytest tests/faults/test_parsers.py --fuzz 20000    # nightly: about a million files in all
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import resource
import shutil
import signal
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from launcher.environments import Environment
from launcher.summary import failed_job, read_summary
from tests.backend.conftest import Quiet
from torch_backend import contract
from torch_backend.cameras import imported
from torch_backend.cameras.export import export_cameras
from torch_backend.cameras.placement import placement_for
from torch_backend.cameras.stored import load_cameras, load_points
from torch_backend.contract import CameraPath, JobError, LiveView, TakeFolder
from torch_backend.contract.checkpoint_header import checkpoint_facts
from torch_backend.contract.path_rules import RULES_VARIABLE, mapped
from torch_backend.contract.results import depth_line, take_figures, verdict_lines
from torch_backend.farm.rates import MEASURED, read_rates
from torch_backend.farm.rates import to_json as rates_to_json
from torch_backend.farm.request import read_request
from torch_backend.footage.depth_maps import UnusableMap, read_map
from torch_backend.footage.images import is_whole_png, read_frame, read_png
from torch_backend.footage.importing import load_frames
from torch_backend.footage.look import look_space
from torch_backend.footage.opening import open_source
from torch_backend.freeze.exr import read_frozen_exr, read_key
from torch_backend.freeze.mattes.files import read_matte
from torch_backend.freeze.mattes.job import stored_lassos
from torch_backend.freeze.mattes.lassos import read_lassos
from torch_backend.freeze.surface.job import make_surface, read_surface
from torch_backend.gaussians.ply import read_ply
from torch_backend.lens.map_reading import read_lens
from torch_backend.lens.stmap import write_map
from torch_backend.motion.mattes import load_motion, record_of
from torch_backend.motion.surface import read_surface as read_surface_points
from torch_backend.motion.surface import write_surface as write_surface_points
from torch_backend.scene import load_scene
from torch_backend.shot import Shot, write_json
from torch_backend.train.checkpoint import read_meta
from torch_backend.train.config import config_from_json
from torch_backend.train.loaded import load_run

from .harness import Prepared
from .mutations import mutated

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")

SECONDS = 30
"""Time limit of a parser in seconds; the slowest valid file takes a tenth of a second."""
MEMORY = 6 << 30
"""Bytes of address space that a parser may use in addition to the process's."""


@dataclass
class Parser:
    """A file to mutate, and its parser."""

    file: Callable[[Path], Path]
    """Path of the valid file in the folder with shot and files."""
    read: Callable[[Path, Path], Any]
    """Parser; called with the folder and the file."""
    errors: tuple[type[Exception], ...] = (JobError,)
    """Accepted errors: `JobError` if a user reads the message, `ValueError` if the parser documents it."""
    share: float = 1.0
    """Fraction of the `--fuzz` files; lower for parsers of large files, which are slow."""


def shot_of(root: Path) -> Shot:
    return Shot(root / "shot.splannequin")


def in_shot(name: str) -> Callable[[Path], Path]:
    return lambda root: next((root / "shot.splannequin").glob(name))


def named(name: str) -> Callable[[Path], Path]:
    return lambda root: root / name


def request_of(path: Path) -> object:
    data = contract.read_json(path)
    contract.check_version(data, "job request")
    request: contract.JobRequest = contract.from_dict(contract.JobRequest, data)
    return request.typed_params()


def messages_of(path: Path) -> list[object]:
    """All messages of a stream, with each header parsed as a view."""
    found: list[object] = []
    with open(path, "rb") as stream:
        while (message := contract.read_message(stream)) is not None:
            found.append(contract.from_dict(LiveView, message[0]))
    return found


def take_of(root: Path, path: Path) -> object:
    facts, folder = contract.read_json(path), TakeFolder(path.parent)
    return take_figures(facts, folder), verdict_lines(facts), contract.placement_of(facts)


def config_in(data: dict[str, Any]) -> dict[str, Any]:
    found = data.get("config")
    return found if isinstance(found, dict) else {"host": "none"}


def status_of(path: Path) -> object:
    return contract.from_dict(contract.Status, contract.read_json(path, contract.SHORT_JSON))


def footage_of(path: Path) -> object:
    source = open_source(str(path))
    return list(source.frames(None, 3))


def rules_of(path: Path) -> str:
    os.environ[RULES_VARIABLE] = str(path)
    try:
        return mapped("/a/b")
    finally:
        del os.environ[RULES_VARIABLE]


def frame_of(path: Path) -> object:
    return read_frozen_exr(path), read_key(path), contract.is_whole_picture(path)


BOTH = (JobError, ValueError)
FRAMES = {"width": 64, "height": 48, "source_size": [64, 48]}
PARSERS: dict[str, Parser] = {
    "shot.json": Parser(in_shot("shot.json"), lambda root, _: Shot.open(shot_of(root).root)),
    "frames.json": Parser(in_shot("frames/frames.json"), lambda root, _: load_frames(shot_of(root))),
    "frames.json of a scene": Parser(in_shot("frames/frames.json"), lambda root, _: load_scene(shot_of(root))),
    "cameras.json": Parser(in_shot("solve/cameras.json"), lambda root, _: load_cameras(shot_of(root))),
    "cameras.json of a scene": Parser(in_shot("solve/cameras.json"), lambda root, _: load_scene(shot_of(root))),
    "points.npz": Parser(in_shot("solve/points.npz"), lambda root, _: load_points(shot_of(root))),
    "checkpoint": Parser(in_shot("runs/main/checkpoint.*"), lambda root, _: load_run(shot_of(root), "main"), share=0.2),
    "checkpoint header": Parser(
        in_shot("runs/main/checkpoint.*"), lambda _, path: (checkpoint_facts(path), read_meta(path)), share=0.2
    ),
    "config.json": Parser(
        in_shot("runs/main/config.json"), lambda _, path: config_from_json(config_in(contract.read_json(path))), BOTH
    ),
    "summary.json": Parser(
        in_shot("runs/main/summary.json"),
        lambda _, path: (verdict_lines(contract.read_json(path)), depth_line(contract.read_json(path))),
    ),
    "take.json": Parser(in_shot("takes/base/take.json"), take_of),
    "frozen EXR": Parser(in_shot("takes/base/000104.exr"), lambda _, path: frame_of(path), BOTH),
    "frozen.ply": Parser(in_shot("takes/base/frozen.ply"), lambda _, path: read_ply(path), BOTH),
    "surface.ply": Parser(in_shot("takes/base/surface.ply"), lambda _, path: read_surface(path), BOTH),
    "mattes.json": Parser(
        in_shot("takes/base/mattes/mattes.json"),
        lambda root, _: stored_lassos(TakeFolder(shot_of(root).take("base")), 64, 48),
    ),
    "matte EXR": Parser(
        in_shot("takes/base/mattes/single/drawn/000104.exr"), lambda _, path: read_matte(path, (0, 0)), BOTH
    ),
    "working frame": Parser(in_shot("frames/000101.png"), lambda _, path: (read_frame(path), is_whole_png(path))),
    "picture": Parser(in_shot("frames/000101.png"), lambda _, path: (read_png(path), contract.png_size(path))),
    "painted matte": Parser(in_shot("motion_paint/000101.png"), lambda root, _: load_motion(shot_of(root), 101)),
    "placement.json": Parser(in_shot("placement.json"), lambda root, _: placement_for(shot_of(root))),
    "lock.json": Parser(in_shot("lock.json"), lambda root, _: contract.read_writer(shot_of(root).root)),
    "request.json": Parser(in_shot("jobs/*/request.json"), lambda _, path: request_of(path)),
    "status.json": Parser(in_shot("jobs/*/status.json"), lambda _, path: status_of(path)),
    "events.jsonl": Parser(in_shot("jobs/*/events.jsonl"), lambda _, path: list(contract.read_lines(path))),
    "camera path": Parser(named("path.json"), lambda _, path: CameraPath.load(path)),
    "camera path to import": Parser(named("path.json"), lambda _, path: imported.read(path)),
    "transforms.json": Parser(named("nerfstudio/transforms.json"), lambda _, path: imported.read(path)),
    **{
        f"COLMAP {name}": Parser(named(f"{folder}/{name}"), lambda _, path: imported.read(path.parent))
        for folder, end in (("binary", "bin"), ("text", "txt"))
        for name in (f"cameras.{end}", f"images.{end}", f"points3D.{end}")
    },
    "lassos": Parser(named("files/drawn.json"), lambda _, path: read_lassos(path, 64, 48)),
    "look": Parser(named("look.cube"), lambda _, path: look_space(str(path))),
    "ST map": Parser(
        named("map.exr"), lambda _, path: read_lens(str(path), "undistort", "", FRAMES, Quiet()), share=0.2
    ),
    "depth map": Parser(named("depth.exr"), lambda _, path: read_map(path), (JobError, UnusableMap)),
    "video": Parser(named("clip.mp4"), lambda _, path: footage_of(path), share=0.2),
    "sequence": Parser(named("files/clip/0002.png"), lambda _, path: footage_of(path.parent), share=0.2),
    "picture as it ends": Parser(in_shot("takes/base/000104.exr"), lambda _, path: contract.is_whole_picture(path)),
    "video as it ends": Parser(named("clip.mp4"), lambda _, path: contract.is_whole_picture(path)),
    "farm request": Parser(named("request.json"), lambda _, path: read_request(path)),
    "farm rates": Parser(named("rates.json"), lambda _, path: read_rates(path)),
    "path rules": Parser(named("rules.json"), lambda _, path: rules_of(path)),
    "live messages": Parser(named("messages.bin"), lambda _, path: messages_of(path), BOTH),
    "motion record": Parser(named("motion/record.json"), lambda _, path: record_of(path)),
    "surface points": Parser(named("motion/000101.npz"), lambda _, path: read_surface_points(path.parent)),
    "set-up stamp": Parser(
        named("environment/.splannequin/installed.json"), lambda root, _: environment(root).changed()
    ),
    "summary of a command": Parser(named("summary.json"), lambda _, path: read_summary(path.parent)),
    "status of a command": Parser(in_shot("jobs/*/status.json"), lambda root, _: failed_job(root)),
}
"""Map from name to the parser of a file that a user, another program or a disturbed process may leave."""


def environment(root: Path) -> Environment:
    return Environment("the tests'", root / "environment", (), "", 0.0)


@pytest.fixture(scope="module")
def valid(small_shot: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a valid file for each parser."""
    root = tmp_path_factory.mktemp("fuzz")
    shutil.copytree(small_shot.shot, root / "shot.splannequin")
    shutil.copytree(small_shot.files, root / "files")
    shot = shot_of(root)
    make_surface(shot, contract.SurfaceParams(take="base"), Quiet())
    write_json(shot.placement, contract.Placement().to_json())
    job = contract.new_job(shot, "light", contract.LightParams(take="base"))
    write_json(job / "status.json", vars(contract.Status("light", "failed", 1, 0.0, 0.0, 0.0, host="x", message="m")))
    (job / "events.jsonl").write_text(
        '{"type": "progress", "seq": 0, "time": 0.0, "data": {}}\n' * 20, encoding="utf-8"
    )
    write_json(shot.lock, vars(contract.Writer("x", 1, 0.0, "light", job.name, 0.0)))
    shutil.copy(shot.cameras, root / "path.json")
    for kind, folder, text in (
        ("nerfstudio", "nerfstudio", False),
        ("colmap", "binary", False),
        ("colmap", "text", True),
    ):
        written = export_cameras(shot, kind, root / "export" / folder, text)
        shutil.copytree(written[0].parent, root / folder)
    (root / "look.cube").write_text(
        "LUT_3D_SIZE 2\n" + "".join(f"{r} {g} {b}\n" for b in (0, 1) for g in (0, 1) for r in (0, 1)), encoding="utf-8"
    )
    _write_pictures(root)
    write_json(root / "request.json", {"version": 1, "import": {}, "train": {}, "freeze": {}})
    write_json(root / "rates.json", rates_to_json(MEASURED))
    rule = {"source_path_format": "POSIX", "source_path": "/a", "destination_path": "/c"}
    write_json(root / "rules.json", {"version": "pathmapping-1.0", "path_mapping_rules": [rule]})
    view = {"view": 1, "seq": 1, "viewmat": [1.0] * 16, "K": [1.0] * 4, "width": 4, "height": 4, "t_star": 1.0}
    stream = io.BytesIO()
    for _ in range(3):
        contract.write_message(stream, view, b"pixels" * 10)
    (root / "messages.bin").write_bytes(stream.getvalue())
    write_json(root / "motion" / "record.json", {"version": 1, "key": "k", "result": {}})
    stamp = {"venv": "v", "files": {"x.lock": "0"}, "packages": {"numpy-2.dist-info": {"record": "0", "files": 3}}}
    write_json(root / "environment" / ".splannequin" / "installed.json", stamp)
    (root / "environment" / "pyvenv.cfg").write_text("v", encoding="utf-8")
    (root / "environment" / "lib" / "python3.11" / "site-packages").mkdir(parents=True)
    write_json(root / "summary.json", {"command": "freeze", "exit_code": 0})
    return root


def _write_pictures(root: Path) -> None:
    import numpy as np

    from torch_backend.freeze.take.video import write_video

    rows, columns = np.mgrid[0:48, 0:64]
    st = np.stack([(columns + 0.5) / 64, 1 - (rows + 0.5) / 48, np.zeros((48, 64))], -1).astype(np.float32)
    write_map(root / "map.exr", st + 0.002 * np.sin(st))
    write_video(root / "clip.mp4", np.random.default_rng(0).integers(0, 255, (4, 48, 64, 3), dtype=np.uint8), 24.0)
    write_map(root / "depth.exr", np.full((48, 64, 3), 2.0, np.float32))
    xyz = np.zeros((5, 3), np.float32)
    (root / "motion").mkdir()
    write_surface_points(root / "motion" / "000101.npz", xyz, np.zeros((5, 3), np.uint8))


@contextlib.contextmanager
def bounded() -> Generator[None]:
    """Limit time and memory; exceeding them raises an exception."""

    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"a parser took longer than {SECONDS} s")

    before, limits = signal.signal(signal.SIGALRM, late), resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, limits[1]))
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, limits)


def fault_of(parser: Parser, root: Path, path: Path) -> str:
    """Description of a wrong reaction of a parser to a file; empty if the reaction is right."""
    signal.alarm(SECONDS)
    try:
        parser.read(root, path)
    except parser.errors as error:
        return f"more than one line: {error!r}" if "\n" in str(error).strip() else ""
    except Exception as error:
        import traceback

        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {str(error)[:200]}"
    finally:
        signal.alarm(0)
    return ""


@pytest.mark.parametrize("name", PARSERS)
def test_mutated_files_are_read_or_refused(name: str, valid: Path, request: pytest.FixtureRequest):
    parser, option = PARSERS[name], request.config.getoption
    path = parser.file(valid)
    whole = path.read_bytes()
    assert not fault_of(parser, valid, path), "the valid file"
    parser.read(valid, path)
    found: dict[str, int] = {}
    try:
        with bounded():
            for number in range(max(1, int(option("--fuzz", 60) * parser.share))):
                path.write_bytes(mutated(whole, random.Random(f"{option('--seed', 65)}-{name}-{number}")))
                fault = fault_of(parser, valid, path)
                if fault and len(found) < 10 and fault not in found:
                    found[fault] = number
    finally:
        path.write_bytes(whole)
    assert not found, "\n".join(f"file {number}: {fault}" for fault, number in found.items())
