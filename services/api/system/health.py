"""Health checks: whether the service is alive, and whether it can work. Both answer at once, whatever else goes on."""

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import anyio.to_thread
from fastapi import APIRouter, Request, Response
from pydantic import BaseModel
from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from services.api.jobs.wait_reason import trouble_of
from storage import installation
from storage.database.disk_reserve import file_of
from storage.database.engine import reading
from storage.disks import require_reserve
from storage.errors import EnvmatteError, Unavailable
from storage.objects import marker
from storage.objects.store import Objects
from storage.records import leases
from storage.records.leases import Heartbeat

logger = logging.getLogger(__name__)
router = APIRouter(tags=["system"])
INTERVAL = 1.0
"""Seconds between two checks of the same thing, however often readiness is asked for."""
PATIENCE = 0.02
"""Seconds that an answer waits for a check; after that it has the result of the check before. The first has none."""
SILENCE = 3.0
"""Seconds after which a check without a result counts as failed."""


class Health(BaseModel):
    """The service is alive."""

    status: Literal["alive"] = "alive"


class Readiness(BaseModel):
    """What the service depends on: each is ``ok``, or the text says what is wrong."""

    ready: bool
    database: str
    store: str
    cluster: str


class Check:
    """A check of something that the service depends on, in a thread of its own, and only if somebody asks."""

    def __init__(self, name: str, check: Callable[[], str]) -> None:
        self._name = name
        self._check = check
        self._last: str | None = None
        self._began = 0.0
        self._task: asyncio.Task[str] | None = None

    async def result(self) -> str:
        """``ok``, or what is wrong."""
        if self._task is None or (self._task.done() and time.monotonic() - self._began > INTERVAL):
            self._began = time.monotonic()
            self._task = asyncio.create_task(
                anyio.to_thread.run_sync(self._try, limiter=anyio.CapacityLimiter(1))
            )
        await asyncio.wait((self._task,), timeout=SILENCE if self._last is None else PATIENCE)
        if self._task.done():
            self._last = self._task.result()
        silence = time.monotonic() - self._began
        if self._last is None or (silence > SILENCE and not self._task.done()):
            return f"no answer for {silence:.1f} s"
        return self._last

    def _try(self) -> str:
        try:
            return self._check()
        except Exception as error:
            # Anybody may ask. What libraries say may name servers, buckets, files and keys, and what a bucket answers.
            unsaid = f"{type(error).__name__}; the log of the service has more"
            found = error.detail if isinstance(error, EnvmatteError) else unsaid
            if found != self._last:
                exc_info = not isinstance(error, EnvmatteError)
                logger.warning("not ready: %s: %s", self._name, found, exc_info=exc_info)
            return found


def checks(engine: Engine, objects: Objects) -> dict[str, Check]:
    """The checks of a service, by their fields in `Readiness`. None of them writes.

    Coordinators write their heartbeat to the database all the time, so a database that takes no writes is seen by it.
    """

    def last_heartbeat() -> Heartbeat | None:
        with reading(engine) as c:
            return leases.last_heartbeat(c)

    def database() -> str:
        last_heartbeat()
        if (file := file_of(engine)) is not None:
            require_reserve(file.parent)
        return "ok"

    def store() -> str:
        objects.check_reachable()
        if objects.installation is None:  # it stays the same; there is none until a coordinator has started
            # The database's check tells what is wrong with it.
            with suppress(Unavailable, SQLAlchemyError), reading(engine) as c:
                objects.installation = installation.find(c)
        if objects.installation is not None:
            marker.require(objects, objects.installation)
        objects.require_reserve()
        return "ok"

    def cluster() -> str:
        return trouble_of(last_heartbeat()) or "ok"

    return {check.__name__: Check(check.__name__, check) for check in (database, store, cluster)}


@router.get("/healthz")
async def health() -> Health:
    """Whether the service is alive."""
    return Health()


@router.get("/readyz", responses={503: {"model": Readiness, "description": "Something can't be reached"}})
async def readiness(request: Request, response: Response) -> Readiness:
    """Whether the database, the store and the cluster can be reached; 503 if not."""
    checks: dict[str, Check] = request.app.state.checks
    results = await asyncio.gather(*(check.result() for check in checks.values()))
    found = dict(zip(checks, results, strict=True))
    ready = all(value == "ok" for value in results)
    response.status_code = 200 if ready else 503
    return Readiness(ready=ready, **found)
