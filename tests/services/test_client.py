"""The client on its own."""

import subprocess
import sys

import pytest

from services.client import Client, ServiceError

HEAVY = (
    "numpy",
    "numba",
    "scipy",
    "zarr",
    "dask",
    "distributed",
    "fastapi",
    "sqlalchemy",
    "workflows",
    "storage",
)


@pytest.mark.parametrize("module", ["services.client", "services.cli"])
def test_importing_it_pulls_in_nothing_heavy(module: str) -> None:
    script = (
        f"import sys, {module}; print(*{{name.partition('.')[0] for name in sys.modules}} & set({HEAVY!r}))"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


def test_a_service_that_is_not_there_is_named() -> None:
    with (
        Client("http://127.0.0.1:9") as client,
        pytest.raises(ServiceError, match=r"127\.0\.0\.1:9.*envmatte serve"),
    ):
        client.job("any")
