"""Health checks: whether the service is alive, and whether it can work."""

from collections.abc import Callable
from typing import Literal

from fastapi import APIRouter, Response
from pydantic import BaseModel

from services.api.context import AnonymousContext
from services.api.jobs.wait_reason import trouble_of
from storage.database.engine import reading, writing
from storage.records import leases

router = APIRouter(tags=["system"])


class Health(BaseModel):
    """The service is alive."""

    status: Literal["alive"] = "alive"


class Readiness(BaseModel):
    """What the service depends on: each is ``ok``, or the text says what is wrong."""

    ready: bool
    database: str
    store: str
    cluster: str


@router.get("/healthz")
def health() -> Health:
    """Whether the service is alive."""
    return Health()


@router.get("/readyz")
def readiness(context: AnonymousContext, response: Response) -> Readiness:
    """Whether the database, the store and the cluster can be reached; 503 if not."""

    def database() -> str:
        with writing(context.engine) as c:  # a write: a full database can still be read
            leases.check_writable(c)
        return "ok"

    def store() -> str:
        context.objects.check_reachable()
        return "ok"

    def cluster() -> str:
        with reading(context.engine) as c:
            sign = leases.last_heartbeat(c)
        return trouble_of(sign) or "ok"

    found = {check.__name__: _try(check) for check in (database, store, cluster)}
    ready = all(value == "ok" for value in found.values())
    response.status_code = 200 if ready else 503
    return Readiness(ready=ready, **found)


def _try(check: Callable[[], str]) -> str:
    try:
        return check()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
