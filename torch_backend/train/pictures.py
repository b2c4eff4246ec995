"""The pictures that a run is trained on: the shot's working frames, or where it asks for more the source's own.

Working frames have 720 lines at most unless the import was told otherwise: enough for a processor. Training on a card
may use plates: undistorted frames of the source's size, on the working frames' display.
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
    """Pictures of a run's frames, which are not read yet."""

    scene: Scene
    """Whose frames they are."""
    size: tuple[int, int]
    """Width and height in pixels."""
    plates: Plates | None
    """Where they are read from; None: the working frames."""

    def load(self, indices: list[int], report: Reporter | None = None, beside: Path | None = None) -> Tensor:
        """Frames `indices` of the scene, as `scene.load_images` has them. JobError too if a plate cannot be read."""
        plates, frames = self.plates, self.scene.frames
        if plates is None:
            return load_images(self.scene, indices, *self.size, report, beside)

        def read(index: int) -> Tensor:
            return plates.display(frames[index]).clamp(0.0, 1.0)

        try:
            return load_images(self.scene, indices, *self.size, report, beside, read)
        finally:
            plates.close()


def pictures_of(shot: Shot, scene: Scene, config: TrainConfig, report: Reporter) -> Pictures:
    """Pictures of the size that a run asks for, of plates if it may have them and they are finer than working frames.

    A warning says why the working frames have to do, if the footage is not there any more.
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
    """(width, height) of the training images: the working frames' shape, never larger; as large if 0 is requested."""
    width = min(requested_width or scene.width, scene.width)
    return width, max(16, round(scene.height * width / scene.width))
