"""How Gaussians move: one protocol, a host per file, and the gate that says which Gaussians move at all."""

from .gate import GateConfig, open_gate, residual_per_gaussian
from .hexplane import HexPlane, HexPlaneConfig
from .protocol import Deformation, Deltas, apply_deltas, split_deltas

__all__ = [
    "Deformation",
    "Deltas",
    "GateConfig",
    "HexPlane",
    "HexPlaneConfig",
    "apply_deltas",
    "open_gate",
    "residual_per_gaussian",
    "split_deltas",
]
