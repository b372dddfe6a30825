"""The package that scripts import: cheap until a matte is opened, and plain where something is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

import tests.workflows.mattes.imports.conftest as archives
from storage.layout.matte_archive import Archive
from storage.objects.store import Objects

EMPTY_ZIP = b"PK\x05\x06" + bytes(18)
HEAVY = ("xarray", "dask", "numpy", "zarr", "numba", "workflows", "storage", "services")


@pytest.fixture
def file(objects: Objects, tmp_path: Path) -> Path:
    """The archive of a matte."""
    archives.make_matte(objects)
    path = tmp_path / "matte.zip"
    path.write_bytes(b"".join(Archive(objects, "m")))
    return path


def run(program: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_loads_nothing_heavy() -> None:
    heavy = f"[name for name in {HEAVY} if name in sys.modules]"
    assert run(f"import sys, envmatte; print({heavy})").strip() == "[]"


def test_without_xarray_it_says_what_to_install(file: Path) -> None:
    program = f"""
import sys
sys.modules["xarray"] = None
import envmatte
try:
    envmatte.open({str(file)!r})
except ImportError as error:
    print(error)
"""
    assert run(program).strip() == "envmatte.open needs xarray: pip install 'envmatte[xarray]'"


def test_napari_opens_an_archive_as_layers(file: Path) -> None:
    """By npe2, napari's own plugin engine, without napari: it imports nothing of a window."""
    program = f"""
from npe2 import PluginManager, PluginManifest, read

PluginManifest.from_distribution("envmatte").validate_imports()
PluginManager.instance().discover()
for data, shown, kind in read([{str(file)!r}], stack=False):
    print(shown["name"], data.shape, kind, type(data).__module__.partition(".")[0])
"""
    layers = [line for line in run(program).splitlines() if line]
    assert layers == [
        "S (20, 35, 3) image dask",
        "rho (20, 35, 3) image dask",
        "alpha (20, 35) image dask",
        "confidence (20, 35) image dask",
    ]


@pytest.mark.parametrize("content", [b"no ZIP", EMPTY_ZIP])
def test_napari_leaves_other_files_to_others(tmp_path: Path, content: bytes) -> None:
    other = tmp_path / "other.zip"
    other.write_bytes(content)
    program = f"from envmatte.napari_reader import get_reader; print(get_reader({str(other)!r}))"
    assert run(program).strip() == "None"
