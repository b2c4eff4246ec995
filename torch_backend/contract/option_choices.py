"""What options may be chosen from, and what several of them share."""

from __future__ import annotations

from typing import Any

from .hosts import host_names

LAST_FRAME = 1_048_574
"""Blender's last frame number: no scene reaches further."""
PRESET_STEPS = {"preview": 2000, "standard": 9000, "final": 30_000}
"""Training steps of each preset."""
PRESET_WIDTHS = {"preview": 320, "standard": 960, "final": 0}
"""Width in pixels of each preset's training images, never above the working frames'; 0: theirs."""
CARD_WIDTH, CARD_GAUSSIANS = 1920, 1_000_000
"""Of `final` on a graphics card: width in pixels of its images, never above the source's, and most Gaussians."""
CAMERA_MODELS = ("SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""What `SolveParams.camera_model` may be."""
ST_MAP_WAYS = ("undistort", "redistort")
"""What `SolveParams.st_map_way` may be."""
HOSTS = host_names()
"""Hosts of the deformation, as their files in deformation/ name themselves."""
METHODS = ("auto", *HOSTS, "static")
"""What `TrainParams.method` may be."""
HOST_CONFIGS = ("default", "reference")
"""What `TrainParams.host_config` may be."""
SUPERVISIONS = ("support", "paper", "none")
"""What `TrainParams.supervision` may be."""
DETECTORS = ("weight", "grad_norm", "grad_signed")
"""What `TrainParams.detector` may be."""
QUERIES = ("nearest", "plain")
"""What `FreezeParams.query` may be."""
MATTE_FORMATS = ("exr", "png")
"""What `MatteParams.matte_format` may be: suffixes of the files."""
DEVICES = ("auto", "cpu", "cuda")
"""Where a run may train and freeze."""

FRAMES = ((1 << 31) - 1) * 1.0
"""Frame numbers lie between this and its negative."""
PRESET = {0: "the preset's"}
"""What 0 means in an option that a preset has a value for."""
PLACEMENT: dict[str, Any] = {
    "flag": "--placement",
    "metavar": "FILE",
    "is_path": True,
    "help": "JSON that says where the solve stands in the scene for which splats and cameras leave",
    "words": "as Blender wrote it into the shot; without that upright, in solve units",
}
"""The option that freezing and exporting have."""
DEVICE: dict[str, Any] = {
    "flag": "--device",
    "choices": DEVICES,
    "help": "where to train and freeze: `auto` takes an NVIDIA GPU",
}
"""The option that several dataclasses have."""
