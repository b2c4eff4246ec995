"""The world of the compositing tests."""

import pytest


@pytest.fixture(scope="session")
def world(tmp_path_factory, quiet):
    """The board that sways; tests must restore what they change."""
    from tests.backend.freeze.composite.test_compositor import build

    return build(tmp_path_factory.mktemp("board"), quiet())
