"""dask as the service configures it, for tests that use it in this process."""

import pytest

from services.cluster.dask_config import configure_dask


@pytest.fixture(scope="session", autouse=True)
def _dask() -> None:
    configure_dask()
