"""The hosts there are: every module of this package that says `HOST` is one. A fourth host is one more file here."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from typing import Any

from .protocol import HostSpec

CONFIGURATIONS = ("default", "reference")


@functools.cache
def hosts() -> dict[str, HostSpec]:
    """Name -> host, in the order of names. ValueError if two modules claim one name."""
    package = importlib.import_module(__package__ or "")
    found: dict[str, HostSpec] = {}
    for module in pkgutil.iter_modules(package.__path__):
        spec = getattr(importlib.import_module(f"{package.__name__}.{module.name}"), "HOST", None)
        if not isinstance(spec, HostSpec):
            continue
        if spec.name in found:
            raise ValueError(f"two modules of {package.__name__} name their host {spec.name!r}")
        found[spec.name] = spec
    return dict(sorted(found.items()))


def host(name: str) -> HostSpec:
    """The host of that name; ValueError names those there are."""
    if name not in hosts():
        raise ValueError(f"host is {name!r}: it should be one of {', '.join(hosts())}")
    return hosts()[name]


def host_config(name: str, configuration: str, iterations: int) -> Any:
    """A host's numbers: `default` (ours) or `reference` (published) for a run of `iterations`."""
    if configuration not in CONFIGURATIONS:
        raise ValueError(f"host configuration is {configuration!r}: it should be one of {', '.join(CONFIGURATIONS)}")
    spec = host(name)
    return spec.reference(iterations) if configuration == "reference" else spec.settings()
