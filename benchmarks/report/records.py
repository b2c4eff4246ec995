"""Records of benchmark runs: one JSON file per run, written atomically and read only by the report."""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch_backend.contract import check_version, from_dict, read_json
from torch_backend.shot import write_json

from .metrics import WHOLE, Key

RECORD_VERSION = 4
"""Increase when older figures are not comparable with new ones."""
PICTURES = "pictures"
"""Folder of pictures in the folder of the records."""
SPLATS, DEVELOPED, WITHHELD, DELIVERED = "splats", "developed", "withheld", "delivered"
"""Variants of a frozen frame: Gaussians of the run alone; Gaussians of the developed instant alone; the developed
instant with plate detail, without the plate of its own pose; the delivered frame."""


@dataclass
class FrameScore:
    """One pose of one frozen instant against the truth."""

    t_star: int
    """Frame number of the frozen instant."""
    pose: int
    """Frame number of the pose."""
    held_out: bool
    """True if the clip's frame at that pose was held out of training."""
    regions: dict[str, Any]
    """{region: {"pixels": int, metric: float or None}}, as `metrics.score` returns it."""
    best_90_psnr_db: float | None = None
    """PSNR over the best 90 % of the pixels."""
    gradient_ratio: float | None = None
    """Gradient energy relative to the truth's; below 1 is softer."""
    recalled: dict[str, Any] = field(default_factory=dict[str, Any])
    """{thing: [pixels that show it, pixels that should]} of a hard scene, see `things.recalled`."""
    opened: dict[str, Any] = field(default_factory=dict[str, Any])
    """{pane: share of it that the freeze's motion matte calls moving} of a hard scene; for Gaussians alone."""

    def value(self, metric: str, region: str = WHOLE) -> float | None:
        """A figure, or None if it is missing."""
        return self.regions.get(region, {}).get(metric)


@dataclass
class HeldOut:
    """A frame of the clip held out of training, rendered at its own time."""

    frame: int
    """Frame number."""
    psnr_db: dict[str, float | None]
    """{region: PSNR}: `WHOLE`, and where known `moving` and `static`; None for a nearly empty region."""


@dataclass
class Picture:
    """A frozen frame and its truth on disk, with paths relative to the folder of the records."""

    t_star: int
    pose: int
    ours: str
    truth: str
    psnr_db: float
    """PSNR over the whole frame, or for real clips over pixels that never move."""


@dataclass
class Detailed:
    """Freezes of a run in another variant, at the same instants and poses."""

    rows: list[FrameScore]
    jod: dict[str, float | None] = field(default_factory=dict[str, float | None])
    """t* -> ColorVideoVDP of its poses as a sequence."""
    frozen_fps: float | None = None
    """Frozen frames per second, including all their steps; None where it was not measured."""
    pictures: list[Picture] = field(default_factory=list[Picture])
    two_instants: list[Picture] = field(default_factory=list[Picture])
    """Pictures of one pose at two instants."""


@dataclass
class RunRecord:
    """One training run and all figures of its freezes."""

    run_id: str
    """Name of the file, with a hash of scene and settings."""
    scene: str
    """Name of the scene."""
    kind: str
    """synthetic (rendered truth) or real (truth where nothing moves)."""
    cameras: str
    """exact or solved."""
    host: str
    """TrainConfig.method."""
    supervision: str
    """none, paper or support."""
    preset: str
    """Training preset."""
    variant: str
    """default, reference, or the name of an ablation."""
    seed: int
    """Training seed."""
    query: str
    """Time query of Gaussians at t*: nearest or plain."""
    iterations: int
    """Training steps."""
    width: int
    """Width in pixels for training and scoring."""
    height: int
    train_seconds: float
    """Wall seconds of the training loop, including delays by other load on the machine."""
    train_cpu_seconds: float | None
    """Processor seconds of the training job; None if it was interrupted."""
    threads: int | None
    """Training threads; None if the run was interrupted and resumed with another number."""
    jobs: int | None
    """Number of runs at once during training, including this one; None if it changed, as for `threads`."""
    step_ms: float | None
    """Wall milliseconds per training step over the last third of the run, including held-out measurements."""
    gaussians: int
    moving_share: float
    """Share of the Gaussians that the field moves."""
    model_bytes: int
    """Size of the data needed to freeze at any instant: Gaussians, field, support, exposure."""
    frozen_fps: float | None
    """Frozen frames per second, one instant, all outputs (colour, alpha, depth, mattes); None if not measured."""
    heldout_psnr_db: float | None
    """PSNR on frames held out of training, each at its own time."""
    rows: list[FrameScore]
    heldout: list[HeldOut] = field(default_factory=list[HeldOut])
    """Scores of each held-out frame."""
    jod: dict[str, float | None] = field(default_factory=dict[str, float | None])
    """t* -> ColorVideoVDP of its poses as a sequence."""
    pictures: list[Picture] = field(default_factory=list[Picture])
    two_instants: list[Picture] = field(default_factory=list[Picture])
    """Pictures of one pose at two instants."""
    plates: dict[str, str] = field(default_factory=dict[str, str])
    """Frame number -> plate on disk, for the instants of `two_instants`."""
    missing: dict[str, str] = field(default_factory=dict[str, str])
    """Metric -> sentence that explains why it was not measured."""
    machine: dict[str, Any] = field(default_factory=dict[str, Any])
    """Processor, cores, load and versions, see `machine_facts`."""
    device: str = "cpu"
    """Device of training and rendering: cpu or cuda."""
    command: str = ""
    """Command that repeats the run."""
    finished: str = ""
    """Date and time, UTC."""
    detailed: dict[str, Detailed] = field(default_factory=dict[str, Detailed])
    """`DEVELOPED`, `WITHHELD`, `DELIVERED` -> the same freezes in that variant; `rows` and the other fields are for
    Gaussians alone."""
    shown: str = SPLATS
    """Variant of this record's frames; always `SPLATS` on disk, see `as_shown`."""
    matte: dict[str, Any] = field(default_factory=dict[str, Any])
    """{pane: {"moving", "unknown": share of it}} by the solve's motion matte, over all frames of a hard scene."""
    version: int = RECORD_VERSION

    @property
    def setting(self) -> tuple[str, str, str, str, str, str]:
        """The compared setting: (host, supervision, preset, variant, cameras, shown)."""
        return self.host, self.supervision, self.preset, self.variant, self.cameras, self.shown

    def as_shown(self, shown: str) -> RunRecord:
        """This record for a variant of `detailed`, without held-out frames, which are not frozen."""
        of = self.detailed[shown]
        return dataclasses.replace(
            self, shown=shown, detailed={}, rows=of.rows, jod=of.jod, frozen_fps=of.frozen_fps, pictures=of.pictures,
            two_instants=of.two_instants, heldout=[], heldout_psnr_db=None,
        )  # fmt: skip

    @property
    def place(self) -> tuple[str, str, int]:
        """Key at which settings are compared: (scene, cameras, seed)."""
        return self.scene, self.cameras, self.seed

    def jod_values(self) -> dict[Key, float | None]:
        """ColorVideoVDP by instant, for `metrics.paired`."""
        return {(*self.place, int(t_star), -1): value for t_star, value in self.jod.items()}

    def values(self, metric: str, region: str = WHOLE) -> dict[Key, float | None]:
        """A metric by frame, for `metrics.paired`."""
        return {(*self.place, row.t_star, row.pose): row.value(metric, region) for row in self.rows}

    def heldout_values(self, region: str = WHOLE) -> dict[Key, float | None]:
        """PSNR in dB of the clip's held-out frames, for `metrics.paired`."""
        return {(*self.place, row.frame, row.frame): row.psnr_db.get(region) for row in self.heldout}

    def per_frame(self, read: Callable[[FrameScore], float | None]) -> list[float | None]:
        """A figure of every frame, computed by `read`."""
        return [read(row) for row in self.rows]


def save_record(folder: str | Path, record: RunRecord) -> Path:
    """Writes results/<run_id>.json atomically."""
    path = Path(folder) / f"{record.run_id}.json"
    write_json(path, dataclasses.asdict(record))
    return path


def load_record(path: str | Path) -> RunRecord:
    """Inverse of `save_record`. FileNotFoundError, or ValueError that names the file and the fault."""
    data = read_json(path)
    check_version(data, str(path), RECORD_VERSION)
    try:
        data = _with_parts(data)
        data["heldout"] = [from_dict(HeldOut, row) for row in data["heldout"]]
        data["detailed"] = {
            shown: from_dict(Detailed, _with_parts(of)) for shown, of in data.get("detailed", {}).items()
        }
        return from_dict(RunRecord, data)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is no record of a benchmark run: {error}") from error


def _with_parts(data: dict[str, Any]) -> dict[str, Any]:
    """JSON of a `RunRecord` or a `Detailed`, with its frames and pictures as objects."""
    rows = [from_dict(FrameScore, row) for row in data["rows"]]
    pictures = {name: [from_dict(Picture, row) for row in data[name]] for name in ("pictures", "two_instants")}
    return {**data, "rows": rows, **pictures}


def finished(folder: str | Path, run_id: str) -> bool:
    """True if the folder has a record of the current version."""
    path = Path(folder) / f"{run_id}.json"
    return path.is_file() and read_json(path).get("version") == RECORD_VERSION


def load_records(folder: str | Path, run_ids: Iterable[str] | None = None) -> list[RunRecord]:
    """The records of a folder by name, or those of `run_ids`. Ignores the launcher's summary.json."""
    chosen = None if run_ids is None else set(run_ids)
    paths = sorted(p for p in Path(folder).glob("*.json") if p.name != "summary.json")
    paths = [p for p in paths if chosen is None or p.stem in chosen]
    return [load_record(path) for path in paths]


def machine_facts() -> dict[str, Any]:
    """Processor, cores, load average and versions of the computing packages."""
    import importlib.metadata
    import os
    import sys

    versions = {}
    for name in ("torch", "warp-lang", "numpy", "flip-evaluator", "stlpips-pytorch", "cvvdp", "opencv-python-headless"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": sys.version.split()[0],
        "load_1min": load,
        "versions": versions,
    }


def _processor() -> str:
    """The processor's name as reported by the system."""
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
