"""Gaussian model: parameters, initialisation, densification and PLY files. Depends on the scene only."""

from .densify import PRUNE_STOP, Densifier, DensifyConfig
from .initialise import InitConfig, initialise
from .model import PARAM_NAMES, Gaussians, covering, sh_bases

__all__ = [
    "PARAM_NAMES",
    "PRUNE_STOP",
    "Densifier",
    "DensifyConfig",
    "Gaussians",
    "InitConfig",
    "covering",
    "initialise",
    "sh_bases",
]
