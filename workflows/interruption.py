"""How long work ends early: it looks up again and again whether anybody still wants its result.

A kernel cannot be stopped from outside. So a caller that may lose interest sets a check with `interruptible`, and work
that may take long calls `checkpoint` between parts that take a second at most.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_check: ContextVar[Callable[[], None]] = ContextVar("check", default=lambda: None)


@contextmanager
def interruptible(check: Callable[[], None]) -> Iterator[None]:
    """Let `checkpoint` call ``check`` during the block, which ends the work by an exception."""
    token = _check.set(check)
    try:
        yield
    finally:
        _check.reset(token)


def checkpoint() -> None:
    """Raise an exception if the work that calls this has to end."""
    _check.get()()
