"""Scenes and helpers of the rasteriser's tests, and the count of generated cases at the end of a session."""

from collections import Counter

import pytest

from benchmarks import raster_errors
from benchmarks.raster_errors import Scene, workload

GENERATED: Counter[str] = Counter()


@pytest.fixture(scope="session")
def small_room() -> Scene:
    """The benchmark's workload W0: 400 Gaussians, 64 x 48."""
    return workload("W0")


@pytest.fixture(scope="session")
def tools():
    """The module `benchmarks.raster_errors` with Scene, cloud, and others, because tests cannot import this file."""
    return raster_errors


@pytest.fixture
def generated(request):
    """Function to call once per generated case; the session's summary prints the counts."""
    name = request.node.originalname
    return lambda: GENERATED.update((name,))


def pytest_terminal_summary(terminalreporter):
    if GENERATED:
        parts = ", ".join(f"{name} {count}" for name, count in GENERATED.items())
        terminalreporter.write_line(f"rasteriser: {sum(GENERATED.values())} generated cases ({parts})")
