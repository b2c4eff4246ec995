"""Metrics of a training: metrics.jsonl, preview images and the summary of a run."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contract import LONGEST_JSON, METRICS_FILE, PREVIEWS_FOLDER, Reporter, is_link, open_regular, remove_link
from ..footage.images import write_png
from ..shot import make_folder, write_atomic
from .evidence import gather_evidence
from .model import DynamicModel
from .modelled import modelled
from .movers import Mattes
from .trainer import Trainer
from .verdict import figures_of, verdict_fields


class Metrics:
    """Writes metrics.jsonl and preview images of a run during training.

    iteration: step from which the run continues; later measurements of an earlier process are dropped. -1: a new run.
    """

    def __init__(self, folder: Path, report: Reporter, iteration: int) -> None:
        self.folder, self.report = folder, report
        self.path = folder / METRICS_FILE
        if is_link(self.path):  # lines would be appended to the link's target
            remove_link(self.path)
        make_folder(folder / PREVIEWS_FOLDER)
        for picture in (folder / PREVIEWS_FOLDER).glob("*.png"):
            if picture.stem.isdigit() and int(picture.stem) > iteration:
                picture.unlink()
        lines = _lines(self.path) if self.path.is_file() else []
        kept = [line for line in lines if _iteration_of(line) <= iteration]
        self._measured = max(map(_iteration_of, kept), default=-1.0)
        if kept != lines:
            write_atomic(self.path, "".join(f"{line}\n" for line in kept).encode("utf-8"))

    def add(self, trainer: Trainer, test: list[int], held_out: Tensor) -> None:
        """Measures PSNR on held-out frames, appends a line and saves a preview, unless the step already has them."""
        if self._measured < trainer.iteration:
            self._measure(trainer, test, held_out)
        preview = self.folder / PREVIEWS_FOLDER / f"{trainer.iteration:06d}.png"
        if not preview.is_file():
            index = test[len(test) // 2] if test else trainer.train_ids[len(trainer.train_ids) // 2]
            save_png(preview, trainer.render_frame(index))
            self.report.image("preview", preview)

    def _measure(self, trainer: Trainer, test: list[int], held_out: Tensor) -> None:
        value = trainer.heldout_psnr(test, held_out)
        row = {
            "seconds": round(trainer.trained_seconds, 2),
            "iteration": trainer.iteration,
            "heldout_psnr_db": None if value is None else round(value, 3),
            "gaussians": len(trainer.model.gaussians),
            "moving_share": round(moving_share(trainer.model), 5),
        }
        with open(self.path, "a", encoding="utf-8") as lines:
            lines.write(json.dumps(row) + "\n")
        self._measured = trainer.iteration
        self.report.metric("training", row)


def _lines(path: Path) -> list[str]:
    with open_regular(path, LONGEST_JSON) as source:
        return source.read().decode("utf-8", "replace").splitlines()


def _iteration_of(line: str) -> float:
    """Iteration of a line of metrics.jsonl; infinite if the line is incomplete."""
    try:
        return float(json.loads(line)["iteration"])
    except (ValueError, KeyError, TypeError):  # a killed process may leave half a line
        return float("inf")


def moving_share(model: DynamicModel) -> float:
    """Share of the Gaussians that the field moves."""
    return len(model.open_rows()) / max(1, len(model.gaussians))


def save_png(path: Path, image: Tensor) -> None:
    """Writes a display-referred [H, W, 3] image as 8-bit PNG."""
    write_png(path, (image.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).contiguous().cpu().numpy())


def summarise(
    trainer: Trainer, name: str, test: list[int], held_out: Tensor, key: str, mattes: Mattes | None = None
) -> dict[str, Any]:
    """Content of summary.json: the run's figures with units in the key names, what was modelled and its cost."""
    value = trainer.heldout_psnr(test, held_out)
    model, seen = trainer.model, gather_evidence(trainer, test, held_out, mattes)
    return {
        "version": 1,
        "key": key,
        "run": name,
        "preset": trainer.config.preset,
        "method": trainer.config.method,
        "host": trainer.config.host,
        "host_config": trainer.config.host_config,
        "supervision": trainer.config.supervision.preset,
        "iterations": trainer.iteration,
        "extensions": [dataclasses.asdict(extension) for extension in trainer.extensions],
        "width_px": trainer.width,
        "height_px": trainer.height,
        "train_frames": len(trainer.train_ids),
        "heldout_frames": len(test),
        "heldout_psnr_db": None if value is None else round(value, 3),
        **verdict_fields(figures_of(seen, trainer.scene.width, trainer.width * trainer.height)),
        "gaussians": len(model.gaussians),
        "moving_gaussians": len(model.open_rows()),
        "moving_share": round(moving_share(model), 5),
        "device": model.device.type,
        "sh_degree": model.sh_degree,
        "train_seconds": round(trainer.trained_seconds, 2),
        "modelled": modelled(trainer),
        **({} if trainer.depth is None else {"depth": trainer.depth.facts}),
    }
