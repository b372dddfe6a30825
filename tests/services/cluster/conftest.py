"""dask as the service configures it, for tests that use it in this process."""

import os
from collections.abc import Iterator

import pytest

from services.cluster.dask_config import configure_dask


@pytest.fixture(scope="session", autouse=True)
def _dask() -> None:
    configure_dask()


@pytest.fixture(scope="module", autouse=True)
def _environment() -> Iterator[None]:
    """Restore the environment after a module: a fork server that it starts in this process changes it."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)
