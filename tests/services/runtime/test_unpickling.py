"""No code here unpickles what it reads. Checked in the source, because no test input could show it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
FILES = sorted(
    path.relative_to(ROOT)
    for floor in ("services", "workflows", "storage")
    for path in (ROOT / floor).rglob("*.py")
)
RUN_WHAT_THEY_READ = {"dill", "joblib", "marshal", "shelve"}
"""Modules, besides those with `pickle` in their name."""


def is_pickle(name: str) -> bool:
    return "pickle" in name.lower() or name in RUN_WHAT_THEY_READ


def unpickling(code: str) -> Iterator[int]:
    """The lines that may unpickle something."""
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                module = getattr(node, "module", None) or ""
                parts = [part for name in (module, *(one.name for one in names)) for part in name.split(".")]
                # An array of numpy's may hold pickled objects; what reads it is called so that it can be seen.
                if any(is_pickle(part) for part in parts) or (
                    module == "numpy" and "load" in {one.name for one in names}
                ):
                    yield node.lineno
            case ast.Name(id=name) | ast.Attribute(attr=name) if is_pickle(name):
                yield node.lineno
            case ast.keyword(arg="allow_pickle", value=value):
                if not (isinstance(value, ast.Constant) and value.value is False):
                    yield node.lineno
            case ast.Call(func=ast.Attribute(value=ast.Name(id="np" | "numpy"), attr="load")):
                if "allow_pickle" not in {word.arg for word in node.keywords}:
                    yield node.lineno
            # A socket's recv takes a size; without one it is multiprocessing's, which unpickles.
            case ast.Call(func=ast.Attribute(attr="recv"), args=[], keywords=[]):
                yield node.lineno
            case ast.Constant(value=str(text)) if is_pickle(text) and text.isidentifier():
                yield node.lineno


def test_nothing_is_unpickled() -> None:
    assert len(FILES) > 100
    found = [f"{path}:{line}" for path in FILES for line in unpickling((ROOT / path).read_text())]
    assert found == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "import cloudpickle as c",
        "import distributed.protocol.pickle",
        "from distributed.protocol import pickle",
        "from distributed.protocol.pickle import loads",
        "from marshal import loads",
        "importlib.import_module('pickle')",
        "protocol.pickle.loads(data)",
        "pandas.read_pickle(file)",
        "from numpy import load",
        "np.load(file)",
        "np.load(file, None, True)",
        "numpy.load(file, allow_pickle=True)",
        "np.lib.format.read_array(file, allow_pickle=asked)",
        "connection.recv()",
        "Column(PickleType)",
    ],
)
def test_unpickling_code_is_found(code: str) -> None:
    assert list(unpickling(code)) == [1]


@pytest.mark.parametrize(
    "code", ["np.load(file, allow_pickle=False)", "connection.recv(1 << 16)", "json.load(file)"]
)
def test_other_code_is_not_reported(code: str) -> None:
    assert list(unpickling(code)) == []
