"""Whether the service lives, and whether it can work."""

import time
from collections.abc import Callable
from typing import Literal

from fastapi import APIRouter, Response
from pydantic import BaseModel

from services.api.context import Needs
from storage import jobs

router = APIRouter(tags=["system"])
SILENCE = 15.0
"""Seconds after which a coordinator that gave no sign of life counts as gone."""


class Health(BaseModel):
    """The service lives."""

    status: Literal["alive"] = "alive"


class Readiness(BaseModel):
    """What the service needs, each ``ok`` or what is wrong with it."""

    ready: bool
    database: str
    store: str
    cluster: str


@router.get("/healthz")
def health() -> Health:
    """Whether the service lives."""
    return Health()


@router.get("/readyz")
def readiness(context: Needs, response: Response) -> Readiness:
    """Whether the database, the store and the cluster can be reached; 503 if not."""

    def database() -> str:
        with context.engine.connect() as c:
            jobs.last_beat(c)
        return "ok"

    def store() -> str:
        context.objects.check()
        return "ok"

    def cluster() -> str:
        with context.engine.connect() as c:
            beat = jobs.last_beat(c)
        if beat is None or time.time() - beat.beat_at > SILENCE:
            return "the coordinator gives no sign of life"
        return "ok" if beat.workers else "there are no workers"

    found = {check.__name__: _try(check) for check in (database, store, cluster)}
    ready = all(value == "ok" for value in found.values())
    response.status_code = 200 if ready else 503
    return Readiness(ready=ready, **found)


def _try(check: Callable[[], str]) -> str:
    try:
        return check()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
