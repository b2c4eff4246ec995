"""Deformation of Gaussians: a protocol, one host per file, and the gate that selects the moving Gaussians."""

from .gate import GateConfig, change_of, painted, stays_open
from .hexplane import HexPlane, HexPlaneConfig
from .protocol import Deformation, Deltas, HostConfig, Rehearsal, Start, apply_deltas, field_box, split_deltas
from .registry import CONFIGURATIONS, host, host_config, hosts

__all__ = [
    "CONFIGURATIONS",
    "Deformation",
    "Deltas",
    "GateConfig",
    "HexPlane",
    "HexPlaneConfig",
    "HostConfig",
    "Rehearsal",
    "Start",
    "apply_deltas",
    "change_of",
    "field_box",
    "host",
    "host_config",
    "hosts",
    "painted",
    "split_deltas",
    "stays_open",
]
