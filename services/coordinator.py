"""The coordinator: takes queued jobs and drives them on dask, one step after another.

It polls, and it alone writes progress: results that travel with callbacks are lost with their client, and a scheduler
keeps nothing over a restart. Whatever it holds in memory can be made again from the ledger.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from typing import Any

from distributed import Client, Future
from sqlalchemy import Engine, Row, select

from services.api.errors import problem_of
from services.settings import Settings
from storage import captures, database, jobs, mattes, uploads
from storage.database import writing
from storage.errors import Conflict, EnvmatteError, GaveUp
from storage.objects import Objects
from workflows.jobs import KINDS, Task, run_finish, run_prepare, run_tile

logger = logging.getLogger(__name__)

POLL = 0.1
"""Seconds between two looks at the ledger and the cluster."""
BEAT = 2.0
"""Seconds between two signs of life."""
FETCH = 5.0
"""Seconds to wait for the small result of a task that is done, before it counts as gone with its worker."""
DEPTH = 2
"""Tasks in flight for each thread of the cluster: one that runs, and one that waits so that no thread does."""


@dataclass
class Drive:
    """A job that is being driven."""

    job: str
    kind: str
    task: Task
    stage: str
    to_do: deque[int] = field(default_factory=deque)
    tiles: dict[Future, int] = field(default_factory=dict)
    step: Future | None = None
    """The task of the stage, where that is a single one."""
    misses: int = 0
    """How often that one has failed."""

    @property
    def in_flight(self) -> list[Future]:
        """All that the cluster has of it."""
        return [*self.tiles, *([self.step] if self.step else [])]


class Coordinator:
    """Drives jobs until it is stopped. There is one for a database.

    Parameters
    ----------
    settings : Settings
    engine : sqlalchemy.Engine
    objects : Objects
    client : distributed.Client
        Synchronous.
    """

    def __init__(self, settings: Settings, engine: Engine, objects: Objects, client: Client) -> None:
        self._settings = settings
        self._engine = engine
        self._objects = objects
        self._client = client
        self._drives: dict[str, Drive] = {}
        self._threads = 0
        self._beat_at = 0.0
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coordinator")

    def __enter__(self) -> "Coordinator":
        self._reconcile()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped.wait(POLL):
            try:
                self._step()
            except Exception:  # the database or the scheduler may be away for a while: jobs must not be
                logger.exception("the coordinator goes on after an error")
                self._stopped.wait(1)

    def _step(self) -> None:
        if time.monotonic() - self._beat_at > BEAT:
            threads = self._client.nthreads()
            self._threads = sum(threads.values())
            with writing(self._engine) as c:
                jobs.beat(c, len(threads), self._threads)
                expired = uploads.forget_expired(c)
            for upload in expired:
                uploads.remove(self._objects, upload)
            self._beat_at = time.monotonic()
        with self._engine.connect() as c:
            rows = {row.id: row for row in jobs.active(c)}
            cancelled = jobs.not_wound_up(c)
        for row in rows.values():
            if row.id not in self._drives and self._may_start(row):
                self._take_up(row)
        for row in cancelled:
            if row.id not in self._drives:
                self._discard(row.kind, row.capture, row.matte)
        for drive in list(self._drives.values()):
            try:
                self._advance(drive, row=rows.get(drive.job))
            except EnvmatteError as error:
                self._fail(drive, error)
            except Exception:
                # Whatever it was, and whatever it left half done here: the ledger knows where the job stands.
                del self._drives[drive.job]
                raise
        self._submit()

    def _may_start(self, row: Row[Any]) -> bool:
        """Whether the capture of a job is there; a job whose capture never will be is ended."""
        if row.kind == "ingest":
            return True
        with self._engine.connect() as c:
            capture = captures.get(c, row.capture)
        if capture.state == "failed":
            error = Conflict(f"capture {row.capture} could not be ingested: {capture.problem['detail']}")
            with writing(self._engine) as c:
                jobs.end(c, row.id, "failed", problem_of(error))
                mattes.change(c, row.matte, state="failed")
        return bool(capture.state == "ready")

    def _take_up(self, row: Row[Any]) -> None:
        task = Task(
            store=self._objects.url,
            capture=row.capture,
            matte=row.matte or "",
            options=row.options,
            limits=self._settings.limits,
            plan=row.plan or {},
        )
        drive = Drive(row.id, row.kind, task, "preparing")
        with writing(self._engine) as c:
            if row.plan is None:
                jobs.enter(c, row.id, drive.stage)
            else:
                drive.stage = KINDS[row.kind].stage
                drive.to_do.extend(jobs.to_do(c, row.id))
                jobs.enter(c, row.id, drive.stage)
        self._drives[row.id] = drive

    def _advance(self, drive: Drive, row: Row[Any] | None) -> None:
        if row is None:
            self._wind_up(drive)
        elif drive.stage == "preparing":
            self._in_one_step(drive, run_prepare, self._prepared)
        elif drive.stage == "finishing":
            self._in_one_step(drive, run_finish, self._finished)
        else:
            self._collect(drive)
            if not drive.to_do and not drive.tiles and drive.job in self._drives:
                self._enter(drive, "finishing")

    def _enter(self, drive: Drive, stage: str) -> None:
        drive.stage = stage
        with writing(self._engine) as c:
            jobs.enter(c, drive.job, stage)

    def _in_one_step(
        self,
        drive: Drive,
        function: Callable[[str, Task], dict[str, Any]],
        then: Callable[[Drive, dict[str, Any]], None],
    ) -> None:
        if drive.step is None:
            drive.step = self._client.submit(function, drive.kind, drive.task, pure=False)
        if not drive.step.done():
            return
        step, drive.step = drive.step, None
        try:
            result = step.result(timeout=FETCH)
        except EnvmatteError:  # it would be the same the next time
            raise
        except (TimeoutError, CancelledError):
            return
        except Exception as error:
            drive.misses += 1
            if drive.misses >= self._settings.attempts:
                raise GaveUp(f"{drive.stage} failed {drive.misses} times, last with {error!r}") from error
        else:
            drive.misses = 0
            then(drive, result)

    def _prepared(self, drive: Drive, plan: dict[str, Any]) -> None:
        drive.task = replace(drive.task, plan=plan)
        drive.to_do.extend(range(plan["tiles"]))
        drive.stage = KINDS[drive.kind].stage
        with writing(self._engine) as c:
            jobs.lay_down(c, drive.job, plan)
            if drive.kind == "ingest":
                found = {name: plan[name] for name in ("width", "height", "frames")}
                captures.change(c, drive.task.capture, **found)
            for line in plan.get("notes", ()):
                jobs.note(c, drive.job, line)
            jobs.enter(c, drive.job, drive.stage)

    def _finished(self, drive: Drive, figures: dict[str, Any]) -> None:
        with writing(self._engine) as c:
            if not jobs.end(c, drive.job, "succeeded"):
                return  # it was cancelled at the last moment, and is wound up next
            if drive.kind == "ingest":
                captures.change(c, drive.task.capture, state="ready")
            else:
                mattes.change(c, drive.task.matte, state="ready", figures=figures)
        del self._drives[drive.job]
        if drive.kind == "ingest":
            uploads.remove(self._objects, drive.task.capture)

    def _collect(self, drive: Drive) -> None:
        """Write down the tiles that have ended since the last look, all in one transaction."""
        ended = {future: tile for future, tile in drive.tiles.items() if future.done()}
        if not ended:
            return
        errors: list[tuple[int, Exception]] = []
        finished: list[tuple[int, float, int]] = []
        for future, tile in ended.items():
            del drive.tiles[future]
            try:
                finished.append((tile, *future.result(timeout=FETCH)))
            except (TimeoutError, CancelledError):  # gone with its worker, or forgotten by the scheduler
                drive.to_do.append(tile)
            except Exception as failure:
                errors.append((tile, failure))
        with writing(self._engine) as c:
            jobs.finish_tiles(c, drive.job, finished)
            for tile, error in errors:
                if jobs.miss_tile(c, drive.job, tile, repr(error), self._settings.attempts):
                    drive.to_do.append(tile)
        for tile, error in errors:
            if isinstance(error, EnvmatteError):  # it would be the same the next time
                raise error
            if tile not in drive.to_do:
                raise GaveUp(
                    f"tile {tile} failed {self._settings.attempts} times, last with {error!r}"
                ) from error

    def _submit(self) -> None:
        """Fill the cluster from all jobs in turn, so that a small one is not kept waiting by a large one."""
        free = DEPTH * self._threads - sum(len(drive.tiles) for drive in self._drives.values())
        waiting = deque(drive for drive in self._drives.values() if drive.to_do)
        while free > 0 and waiting:
            drive = waiting.popleft()
            tile = drive.to_do.popleft()
            future = self._client.submit(run_tile, drive.kind, drive.task, tile, pure=False)
            drive.tiles[future] = tile
            free -= 1
            if drive.to_do:
                waiting.append(drive)

    def _wind_up(self, drive: Drive) -> None:
        """Let the running tasks of a job that has ended early end too, for they can't be stopped.

        Only then is what they wrote removed, or they would go on to write it.
        """
        drive.to_do.clear()
        if all(future.done() for future in drive.in_flight):
            del self._drives[drive.job]
            self._discard(drive.kind, drive.task.capture, drive.task.matte)

    def _fail(self, drive: Drive, error: EnvmatteError) -> None:
        logger.error("job %s failed", drive.job, exc_info=error)
        problem = problem_of(error)
        with writing(self._engine) as c:
            jobs.end(c, drive.job, "failed", problem)
            if drive.kind == "ingest":
                captures.change(c, drive.task.capture, state="failed", problem=problem)
            else:
                mattes.change(c, drive.task.matte, state="failed")
        if drive.kind == "recover" or captures.may_be_retried(problem):  # what is done is kept
            self._client.cancel(drive.in_flight)
            del self._drives[drive.job]

    def _discard(self, kind: str, capture: str, matte: str) -> None:
        """Remove what an ended job wrote: a matte whole, of a capture all but the row that says what was wrong."""
        if kind == "recover":
            with writing(self._engine) as c:
                mattes.forget(c, matte)
            self._objects.delete(mattes.path(matte))
            return
        with writing(self._engine) as c:
            if captures.get(c, capture).state != "failed":
                problem = problem_of(Conflict("the ingest was cancelled; upload the capture again"))
                captures.change(c, capture, state="failed", problem=problem)
        self._objects.delete(captures.path(capture))
        uploads.remove(self._objects, capture)

    def _reconcile(self) -> None:
        """Remove what has no row in the ledger: what a killed process left."""
        with self._engine.connect() as c:
            rows = c.execute(select(database.captures)).all()
            kept = [row for row in rows if row.state != "failed" or captures.may_be_retried(row.problem)]
            under_way = {id: uploads.parts_of(c, id) for id in c.scalars(select(database.uploads.c.id))}
            known = {
                "captures": {row.id for row in kept},
                "uploads": {row.id for row in kept if row.state != "ready"} | under_way.keys(),
                "mattes": set(c.scalars(select(database.mattes.c.id))),
            }
        self._objects.sweep("uploads")
        for folder, names in known.items():
            for name in self._objects.names(folder):
                if name not in names and name != "zarr.json":
                    logger.info("removing %s/%s, which nothing refers to", folder, name)
                    self._objects.delete(f"{folder}/{name}")
        for upload, parts in under_way.items():
            uploads.sweep(self._objects, upload, parts)
