"""Training images of a run: the shot's working frames, or plates if the run needs a higher resolution.

Working frames have at most 720 lines by default, which is enough for training on the CPU. Training on a GPU may use
plates: undistorted frames of the source's size, with the display transform of the working frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ..contract import Reporter
from ..footage.plates import STAYS, Plates
from ..scene import Scene, load_images
from ..shot import Shot
from .config import TrainConfig


@dataclass(frozen=True)
class Pictures:
    """Training images of a run that are read on demand."""

    scene: Scene
    """Scene that the frames belong to."""
    size: tuple[int, int]
    """Width and height in pixels."""
    plates: Plates | None
    """Source of the images; None: the working frames."""

    def load(self, indices: list[int], report: Reporter | None = None, folder: Path | None = None) -> Tensor:
        """Loads frames `indices` of the scene as `scene.load_images` does. JobError also if a plate cannot be read."""
        plates, frames = self.plates, self.scene.frames
        if plates is None:
            return load_images(self.scene, indices, *self.size, report, folder)

        def read(index: int) -> Tensor:
            return plates.display(frames[index]).clamp(0.0, 1.0)

        try:
            return load_images(self.scene, indices, *self.size, report, folder, read)
        finally:
            plates.close()


def pictures_of(shot: Shot, scene: Scene, config: TrainConfig, report: Reporter) -> Pictures:
    """Training images at the size that `config` requests.

    They are read from plates if `config` allows it and plates are larger than the working frames. If the footage is
    missing, a warning says why the working frames are used.
    """
    if config.plates and not 0 < config.width <= scene.width:
        plates = Plates(shot)
        width = min(config.width or plates.width, plates.width)
        if width > scene.width:
            size = width, max(16, round(scene.height * width / scene.width))
            return Pictures(scene, size, Plates(shot, size, keep=1))
        if plates.note:
            report.warning(f"{plates.note.removesuffix(STAYS)}The run is trained on the working frames.")
    return Pictures(scene, training_size(scene, config.width), None)


def training_size(scene: Scene, requested_width: int) -> tuple[int, int]:
    """(width, height) of the training images: the working frames' shape, at most their size; 0: their size."""
    width = min(requested_width or scene.width, scene.width)
    return width, max(16, round(scene.height * width / scene.width))
