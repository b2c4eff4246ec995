"""Values of options, and entries that several options share."""

from __future__ import annotations

from typing import Any

from .hosts import host_names

LAST_FRAME = 1_048_574
"""Blender's last frame number: no scene reaches further."""
PRESET_STEPS = {"preview": 2000, "standard": 9000, "final": 30_000}
"""Training steps of each preset."""
PRESET_WIDTHS = {"preview": 320, "standard": 960, "final": 0}
"""Width in pixels of each preset's training images, at most the working frames' width; 0: the working frames' width."""
CARD_WIDTH, CARD_GAUSSIANS = 1920, 1_000_000
"""`final` on a graphics card: width in pixels of its images, at most the source's; largest number of Gaussians."""
CAMERA_MODELS = ("SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""Values of `SolveParams.camera_model`."""
ST_MAP_WAYS = ("undistort", "redistort")
"""Values of `SolveParams.st_map_way`."""
HOSTS = host_names()
"""Names of the deformation hosts, as the files in deformation/ define them."""
METHODS = ("auto", *HOSTS, "static")
"""Values of `TrainParams.method`."""
HOST_CONFIGS = ("default", "reference")
"""Values of `TrainParams.host_config`."""
SUPERVISIONS = ("support", "paper", "none")
"""Values of `TrainParams.supervision`."""
DETECTORS = ("weight", "grad_norm", "grad_signed")
"""Values of `TrainParams.detector`."""
QUERIES = ("nearest", "plain")
"""Values of `FreezeParams.query`."""
MATTE_FORMATS = ("exr", "png")
"""Values of `MatteParams.matte_format`: suffixes of the files."""
DEVICES = ("auto", "cpu", "cuda")
"""Devices on which a run may train and freeze."""

FRAMES = ((1 << 31) - 1) * 1.0
"""Largest absolute value of a frame number."""
PRESET = {0: "the preset's"}
"""Meaning of 0 in an option for which each preset has a value."""
PLACEMENT: dict[str, Any] = {
    "flag": "--placement",
    "metavar": "FILE",
    "is_path": True,
    "help": "JSON with the placement of the solve in the scene, used to export splats and cameras",
    "words": "as Blender wrote it into the shot; else upright, in solve units",
}
"""Entries of the option --placement, which freezing and exporting share."""
DEVICE: dict[str, Any] = {
    "flag": "--device",
    "choices": DEVICES,
    "help": "device to train and freeze on: `auto` uses an NVIDIA GPU if there is one",
}
"""Entries of the option --device, which several dataclasses share."""
