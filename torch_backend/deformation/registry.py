"""Registry of hosts: all modules of this package with a `HOST`. A new host only needs a new file in this package."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from typing import Any

from .protocol import HostSpec

CONFIGURATIONS = ("default", "reference")


@functools.cache
def hosts() -> dict[str, HostSpec]:
    """Hosts by name, in alphabetical order. ValueError if two modules use the same name."""
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
    """Host with the given name. ValueError lists the existing names."""
    if name not in hosts():
        raise ValueError(f"host is {name!r}: it should be one of {', '.join(hosts())}")
    return hosts()[name]


def host_config(name: str, configuration: str, iterations: int) -> Any:
    """Configuration of a host for a run of `iterations`: `default` (ours) or `reference` (published)."""
    if configuration not in CONFIGURATIONS:
        raise ValueError(f"host configuration is {configuration!r}: it should be one of {', '.join(CONFIGURATIONS)}")
    spec = host(name)
    return spec.reference(iterations) if configuration == "reference" else spec.settings()
