"""A router whose plain functions run in threads, in the turn of the request's owner."""

from collections.abc import Awaitable, Callable
from functools import partial, wraps
from inspect import iscoroutinefunction
from typing import Any, ParamSpec, TypeVar

from fastapi import APIRouter

P = ParamSpec("P")
R = TypeVar("R")


class Router(APIRouter):
    """A router; each plain function of it takes a ``context``, see `in_turn`."""

    def add_api_route(self, path: str, endpoint: Callable[..., Any], *args: Any, **options: Any) -> None:
        function = endpoint if iscoroutinefunction(endpoint) else in_turn(endpoint)
        super().add_api_route(path, function, *args, **options)


def in_turn(function: Callable[P, R]) -> Callable[P, Awaitable[R]]:
    """A function for a request, as one that runs in a thread once its owner has a turn, see `Context.call`.

    FastAPI would run it in one of the threads that all requests share: while those of one owner wait in all of them
    for the database, nobody else is served.
    """

    @wraps(function)
    async def call(*args: P.args, **given: P.kwargs) -> R:
        context: Any = given["context"]
        found: R = await context.call(partial(function, *args, **given))
        return found

    return call
