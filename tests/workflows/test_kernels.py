"""Kernels are compiled ahead of time: after `compile_kernels` no job and no request compiles any."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from workflows import kernels
from workflows.kernels import find_kernels

USE = """
import importlib, io, json, pkgutil, sys
from pathlib import Path
import numpy as np
import workflows
from storage.layout import uploads
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows import kernels
from workflows.composite import composite
from workflows.composite.live.encode import encode_live
from workflows.jobs import Task, run_all
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

objects = Objects(Path(sys.argv[1]).as_uri())
for name, depth, method in [("default", 16, "lobes"), ("quick", 8, "lobes"), ("sketch", 8, "nn-dgsr")]:
    file, key = io.BytesIO(), f"{name}-{method}"
    write_capture(glass_ball(20, 18, monitor=(512, 384), rays=4), preset(name, 512, 384), file, depth=depth, mask=True)
    objects.put(uploads.part_path(key, "all"), file.getvalue())
    uploads.seal(objects, key, [uploads.Part("all", len(file.getvalue()))])
    run_all(kernels.INGEST, objects, Task("j", key, "", {}, kernels.LIMITS))
    run_all(kernels.RECOVER, objects, Task("j", key, key, {"method": method}, kernels.LIMITS))
    composite(Matte(objects, key), np.ones((30, 40, 3), np.float32))
    encode_live(Matte(objects, key), threads=1)
for module in pkgutil.walk_packages(workflows.__path__, "workflows."):
    importlib.import_module(module.name)
found = kernels.find_kernels()
name = lambda kernel: f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
print(json.dumps({
    "kernels": len(found),
    "compiled": [name(kernel) for kernel in found if kernel.stats.cache_misses],
    # Those that are inlined become a part of what calls them, and have no entry of their own.
    "lacking": [
        name(kernel) for kernel in found
        if kernel.targetoptions.get("inline") != "always" and not kernel._cache._cache_file._load_index()
    ],
}))
"""


def ran(*command: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.slow
def test_after_warm_nothing_is_compiled(tmp_path: Path) -> None:
    warmed = ran("-m", "services", "warm", "--json")
    assert set(warmed) == {"cache", "kernels", "compiled", "seconds"}
    used = ran("-c", USE, str(tmp_path))
    assert used == {"kernels": warmed["kernels"], "compiled": [], "lacking": []}


def test_progress_counts_kernels_that_were_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path)
    for n, age in enumerate((100, 0, 0)):
        (tmp_path / f"{n}").mkdir()
        file = tmp_path / f"{n}" / "kernel.nbi"
        file.touch()
        os.utime(file, (time.time() - age,) * 2)
    assert kernels._written_since(time.time() - 50) == 2


def test_every_kernel_releases_the_interpreter_lock() -> None:
    """Else a request that computes would stop the event loop, and with it all others."""
    found = find_kernels()
    assert len(found) > 50
    assert not [kernel.py_func.__name__ for kernel in found if not kernel.targetoptions.get("nogil")]


@pytest.mark.parametrize("named", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_folder_of_the_cache_is_named(
    named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Path(__file__).parents[2]
    if named:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    else:
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    script = "import json; from workflows.kernels import cache_folder; print(json.dumps({'at': str(cache_folder())}))"
    assert ran("-c", script) == {"at": str(tmp_path if named else root / "workflows")}
