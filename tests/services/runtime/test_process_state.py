"""The docstring of `services.runtime` lists all state that a process keeps."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import services.runtime

ROOT = Path(__file__).parents[3]
CACHES = {"cache", "lru_cache"}


def name_of(node: ast.expr) -> str:
    """The last name of what is called, or used as a decorator."""
    match node:
        case ast.Call(func=function):
            return name_of(function)
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name
    return ""


def state(module: str, code: str) -> Iterator[str]:
    """Functions with a cache and variables that are assigned again, by their full names."""
    for node in ast.walk(ast.parse(code)):
        match node:
            case (
                ast.FunctionDef(name=name, decorator_list=decorators)
                | ast.AsyncFunctionDef(name=name, decorator_list=decorators)
            ):
                if CACHES & {name_of(one) for one in decorators}:
                    yield f"{module}.{name}"
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Call() as call) if CACHES & {
                name_of(call)
            }:
                yield f"{module}.{name}"
            case ast.Global(names=names):
                yield from (f"{module}.{name}" for name in names)


def test_every_cache_of_a_process_is_listed() -> None:
    found = set()
    for package in ("services", "workflows", "storage"):
        for path in (ROOT / package).rglob("*.py"):
            found |= set(state(".".join(path.relative_to(ROOT).with_suffix("").parts), path.read_text()))
    listed = re.findall(
        r"^((?:services|workflows|storage)\.\S+)", services.runtime.__doc__ or "", re.MULTILINE
    )
    assert sorted(found) == listed


def test_caches_are_found_however_they_are_written() -> None:
    code = "@cache\ndef a(): ...\n@functools.lru_cache(2)\ndef b(): ...\nc = lru_cache(1)(d)\ndef e():\n    global f\n"
    assert set(state("m", code)) == {"m.a", "m.b", "m.c", "m.f"}
