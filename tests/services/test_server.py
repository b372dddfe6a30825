"""What the processes of a service import: a coordinator alone needs no HTTP API."""

import subprocess
import sys

import pytest


def loaded_by(*modules: str) -> set[str]:
    """Names of all modules that a new process has after it imported some."""
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    return set(done.stdout.split())


def test_no_route_is_imported_before_the_app() -> None:
    modules = {"services.api", "services.server", "services.coordinator.coordinator"}
    loaded = loaded_by(*modules)
    assert modules <= loaded
    assert not {name for name in loaded if name.startswith("services.api.")}
    assert not loaded & {"fastapi", "uvicorn"}


@pytest.mark.slow
def test_routes_are_imported_with_the_app() -> None:
    assert {"services.api.captures.captures", "fastapi"} <= loaded_by("services.api.app")
