"""The package as a whole: examples run, and what one method computes does not depend on what was compiled before."""

import doctest
import importlib
import pkgutil
from collections import Counter
from collections.abc import Iterator
from types import CodeType, FunctionType

import pytest
from numba.core.dispatcher import Dispatcher

from workflows import recovery


def code_in(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from code_in(constant)


def called_by(function: FunctionType) -> set[Dispatcher]:
    """The kernels that a function names."""
    names = {name for code in code_in(function.__code__) for name in code.co_names}
    there = (function.__globals__.get(name) for name in names)
    return {kernel for kernel in there if isinstance(kernel, Dispatcher)}


def within(kernel: Dispatcher) -> set[Dispatcher]:
    """A kernel and all that it calls."""
    found, left = set(), {kernel}
    while left:
        one = left.pop()
        found.add(one)
        left |= called_by(one.py_func) - found
    return found


def test_kernels_that_several_methods_share_are_compiled_when_they_are_loaded() -> None:
    modules = [
        importlib.import_module(found.name)
        for found in pkgutil.walk_packages(recovery.__path__, f"{recovery.__name__}.")
    ]
    plain = [
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, FunctionType) and value.__module__ == module.__name__
    ]
    of_methods: dict[str, set[Dispatcher]] = {}
    for entry in set().union(*map(called_by, plain)):
        method = entry.py_func.__module__.removeprefix(f"{recovery.__name__}.").partition(".")[0]
        of_methods.setdefault(method, set()).update(within(entry))
    assert {"lobes", "dgsr"} <= set(of_methods)
    shared = [
        kernel
        for kernel, methods in Counter(kernel for found in of_methods.values() for kernel in found).items()
        if methods > 1 and kernel.targetoptions.get("inline") != "always"  # a part of each of its callers
    ]
    assert {"inner", "subtract"} <= {kernel.py_func.__name__ for kernel in shared}
    for kernel in shared:
        # what has types of its own takes no others
        with pytest.raises(TypeError, match="No matching definition"):
            kernel(*[0j] * kernel.py_func.__code__.co_argcount)


def test_examples_run() -> None:
    found = [
        doctest.testmod(importlib.import_module(module.name))
        for module in pkgutil.walk_packages(recovery.__path__, f"{recovery.__name__}.")
    ]
    assert sum(result.attempted for result in found) > 0
    assert not sum(result.failed for result in found)
