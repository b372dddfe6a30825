"""Importing a module changes nothing for its process: what has effects is called where a process starts."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROGRAM = """
import ast, importlib, logging, os, pathlib, resource, signal, sys, threading, warnings
from contextlib import suppress

ours = ("services", "workflows", "storage")
files = [path for package in ours for path in sorted(pathlib.Path(package).rglob("*.py"))]
files = [path for path in files if "files" not in path.parts]  # scripts for other programs
files = [path for path in files if "versions" not in path.parts and path.name not in ("__main__.py", "env.py")]


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Import(names=names):
                yield from (one.name for one in names)
            case ast.ImportFrom(module=module, names=names, level=0):
                yield module
                yield from (f"{module}.{one.name}" for one in names)


# What libraries do at their import is their own affair.
for name in sorted({name for path in files for name in imported(path)}):
    if name.partition(".")[0] not in ours:
        with suppress(ImportError):
            importlib.import_module(name)

import dask, multiprocessing, zarr
from zarr.registry import get_pipeline_class


def state():
    loggers = {"": logging.root, **logging.root.manager.loggerDict}
    return {
        "dask": repr(dask.config.config),
        "zarr": repr(zarr.config.config),
        "pipeline": get_pipeline_class(),
        "loggers": {
            name: (one.level, one.propagate, list(one.handlers))
            for name, one in loggers.items()
            if isinstance(one, logging.Logger) and name.partition(".")[0] not in ours
        },
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "hooks": (sys.excepthook, threading.excepthook),
        "environment": dict(os.environ),
        "warnings": list(warnings.filters),
        "processes": (multiprocessing.get_start_method(allow_none=True), multiprocessing.active_children()),
        "threads": {thread.name for thread in threading.enumerate()},
        "limits": {name: resource.getrlimit(getattr(resource, name)) for name in dir(resource) if "RLIMIT_" in name},
        "niceness": os.nice(0),
    }


before = state()
for path in files:
    importlib.import_module(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
after = state()
for name in before:
    if name == "loggers":  # a library may make one later
        after[name] = {one: after[name][one] for one in before[name]}
    if before[name] != after[name]:
        print(name, before[name], after[name])
print(len(files), "imported")
"""


def test_no_import_changes_the_state_of_the_process() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, timeout=250
    )
    assert done.returncode == 0, done.stderr
    *changed, count = done.stdout.splitlines()
    assert changed == []
    assert int(count.split()[0]) > 150
