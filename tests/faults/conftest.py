"""Options of the fault harness and of the fuzzer."""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("faults")
    group.addoption("--faults", type=int, default=30, help="fault cases to run (30 in CI, 200 nightly)")
    group.addoption(
        "--program-faults", type=int, default=3, help="of solve, farm, launcher, Blender (3 in CI, 40 nightly)"
    )
    group.addoption("--faults-from", type=int, default=0, help="number of the first case: repeats one with --faults 1")
    group.addoption("--fuzz", type=int, default=60, help="mutated files per parser (60 in CI)")
    group.addoption("--seed", type=int, default=65, help="seed of faults and mutations")


@pytest.fixture(scope="session")
def small_shot(tmp_path_factory: pytest.TempPathFactory):
    """The small shot that fault cases and fuzzing copy; tests must not change it."""
    from .prepare import make_shot

    return make_shot(tmp_path_factory.mktemp("small"))
