"""The coordinator: takes queued jobs and drives them on dask, one step after another.

Any number of coordinators may run; the one that holds the lease runs jobs (`storage.records.leases`). It polls, and it
alone writes progress: results that travel with callbacks are lost with their client, and a scheduler keeps nothing over
a restart. Whatever it holds in memory can be rebuilt from the ledger.
"""

import logging
import os
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy import Connection, Engine, Row

from services.cluster.dispatcher import Dispatcher
from services.coordinator.job_kinds import KINDS
from services.coordinator.job_run import Drive, end_badly
from services.coordinator.retention import count, forget_expired, forget_jobs, remove, sweep
from services.runtime.logs import about
from services.settings import Settings
from storage.database.engine import reading, writing
from storage.errors import EnvmatteError, GaveUp, NoRoom, Unavailable
from storage.objects.store import Objects
from storage.records import jobs, leases, tiles
from storage.records.leases import Superseded

logger = logging.getLogger(__name__)

POLL = 0.1
"""Seconds between two looks at the ledger; what the cluster has done is looked at as soon as it is."""
BEAT = 2.0
"""Seconds between two signs of life."""
SETTLE = 0.25
"""Seconds between two writes of progress, whatever the number of jobs and tiles."""
DYING = 1.2
"""Seconds after which no worker works on a job any more that was cancelled, see `services.cluster.worker_preload`."""
FORGET = 30.0
"""Seconds between two looks for jobs that are kept no longer."""
SWEEP = 3600.0
"""Seconds between two sweeps of the store."""


class Coordinator:
    """Drives jobs until it is stopped, whenever it holds the lease.

    Parameters
    ----------
    settings : Settings
    engine : sqlalchemy.Engine
    objects : Objects
    dispatcher : Dispatcher
    """

    def __init__(self, settings: Settings, engine: Engine, objects: Objects, dispatcher: Dispatcher) -> None:
        self._settings = settings
        self._engine = engine
        self._objects = objects
        self._dispatcher = dispatcher
        self._name = f"{socket.gethostname()}:{os.getpid()}"
        self._token: int | None = None
        self._drives: dict[str, Drive] = {}
        self._leaving: deque[tuple[float, Row[Any]]] = deque()
        """When what ended jobs wrote is removed: a time, and the job's row."""
        self._troubles: Counter[str] = Counter()
        self._beat_at = self._forgot_at = self._swept_at = self._settled_at = self._read_at = -1e9
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coordinator")
        self._house = ThreadPoolExecutor(1, thread_name_prefix="housekeeping")

    def __enter__(self) -> "Coordinator":
        if self._settings.alone:  # and nobody writes to the store yet
            sweep(self._engine, self._objects, seconds=0)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopped.set()
        self._dispatcher.news.set()
        self._thread.join()
        self._house.shutdown(cancel_futures=True)
        if self._token is not None:
            with suppress(Unavailable, NoRoom), writing(self._engine) as c:
                leases.give_back(c, self._token)

    @property
    def token(self) -> int | None:
        """Of the lease; None while another holds it."""
        return self._token

    def _run(self) -> None:
        while not self._stopped.is_set():
            self._dispatcher.news.clear()
            try:
                if self._leads():
                    self._step()
            except Superseded as error:
                logger.warning("%s: %s", self._name, error)
                self._stand_down()
            except (Unavailable, NoRoom) as error:
                logger.warning("going on as soon as it can: %s", error.detail)
                self._stopped.wait(1)
            except Exception:  # nothing may end this thread
                logger.exception("the coordinator goes on after an error")
                self._stopped.wait(1)
            self._dispatcher.news.wait(POLL)

    def _leads(self) -> bool:
        """Whether the lease is held: it is extended, or asked for, when that is due."""
        now = time.monotonic()
        if now - self._beat_at < BEAT:
            return self._token is not None
        self._beat_at = now
        if self._token is None:
            with writing(self._engine) as c:
                self._token = leases.take(c, self._name, seize=self._settings.alone)
            if self._token is None:
                return False
            logger.info("%s drives the jobs from now on", self._name)
        with self._writing() as c:
            leases.beat(c, self._token, self._dispatcher.cluster)
            expired = forget_expired(c)
        for path in expired:
            self._house.submit(_logged, remove, self._objects, path)
        if now - self._forgot_at > FORGET:
            self._forgot_at = now
            kept = self._settings.job_seconds
            self._house.submit(_logged, forget_jobs, self._engine, self._objects, kept)
        if now - self._swept_at > SWEEP:
            self._swept_at = now
            self._house.submit(_logged, sweep, self._engine, self._objects)
            self._house.submit(_logged, count, self._engine, self._objects)
        return True

    def _stand_down(self) -> None:
        """Let go of everything: another has it."""
        self._token = None
        for job in list(self._drives):
            self._drop(job)
        self._leaving.clear()

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        """A transaction that is refused once another coordinator has taken over."""
        if self._token is None:
            raise Superseded("this coordinator holds no lease")
        with writing(self._engine) as c:
            leases.check(c, self._token)
            yield c

    def _step(self) -> None:
        self._submit()  # first, for a thread may be idle
        now = time.monotonic()
        if now - self._read_at >= POLL:
            self._read_at = now
            self._read()
        for outcome in self._dispatcher.collect():
            if outcome.job in self._drives:
                self._drives[outcome.job].hear(outcome)
        for drive in self._due():
            self._guarded(drive.job, self._settle, drive)
        self._discard()
        self._submit()

    def _read(self) -> None:
        """See in the ledger which jobs there are to drive, and which no more."""
        with reading(self._engine) as c:
            active = {row.id: row for row in jobs.active(c)}
            cancelled = jobs.not_wound_up(c)
        for row in active.values():
            if row.id not in self._drives:
                self._guarded(row.id, self._take_up, row)
        for job in self._drives.keys() - active.keys():
            self._drop(job)
        for row in cancelled:
            self._wind_up(row)

    def _guarded(self, job: str, act: Any, *arguments: Any) -> None:
        """Do something about a job; what is wrong with it must not hold up the others."""
        try:
            with about(job):
                act(*arguments)
        except (Superseded, Unavailable, NoRoom):  # of the ledger: no job is to blame
            raise
        except EnvmatteError as error:
            self._fail(job, error)
        except Exception as error:
            # Whatever it was, and whatever it left half done here: the ledger knows where the job stands.
            with about(job):
                logger.exception("the job is taken up anew")
            if job in self._drives:
                self._drop(job)
            self._troubles[job] += 1
            if self._troubles[job] >= self._settings.attempts:
                self._fail(job, GaveUp(f"the coordinator failed at it, last with {error!r}"))

    def _take_up(self, row: Row[Any]) -> None:
        """Begin to drive a job, once what it needs is there; one for which it never will be is ended."""
        with reading(self._engine) as c:
            if not KINDS[row.kind].is_due(c, row):
                return
        with self._writing() as c:
            tiles.begin(c, row.id)
            drive = self._drive_of(c, row)
            jobs.enter(c, row.id, drive.stage)
        drive.start = min((other.used() for other in self._drives.values()), default=0.0)
        self._drives[row.id] = drive
        logger.info("%s, from the stage %s on", row.kind, drive.stage)

    def _drive_of(self, connection: Connection, row: Row[Any]) -> Drive:
        return Drive.of(row, tiles.to_do(connection, row.id), self._objects.url, self._settings.limits)

    def _due(self) -> list[Drive]:
        """The jobs of which something is written down now.

        Those that can't go on before it is, and otherwise one at a time: the one that has waited longest.
        """
        due = []
        for drive in self._drives.values():
            if drive.news and not drive.to_do and not self._dispatcher.under_way(drive.job):
                due.append(drive)
        now = time.monotonic()
        if now - self._settled_at > SETTLE:
            waiting = [drive for drive in self._drives.values() if drive.news and drive not in due]
            if waiting:
                due.append(min(waiting, key=lambda drive: drive.settled_at))
                self._settled_at = now
        return due

    def _settle(self, drive: Drive) -> None:
        """Write down what became of a job's tiles, and go on with it from there."""
        under_way = self._dispatcher.under_way(drive.job)
        with self._writing() as c:
            following = drive.settle(c, self._settings.attempts, self._dispatcher.threads, under_way)
        drive.go_on(following)
        if following.ended:
            self._drop(drive.job)
            self._tidy(drive.job)

    def _drop(self, job: str) -> None:
        """Drive a job no more: what the cluster has of it is cancelled."""
        del self._drives[job]
        self._dispatcher.drop(job)

    def _fail(self, job: str, error: EnvmatteError) -> None:
        """End a job that can't be driven."""
        with self._writing() as c:
            row = jobs.get(c, job)
            end_badly(c, row.kind, self._drive_of(c, row).task, error)
        if job in self._drives:
            self._drop(job)
        self._tidy(job)

    def _tidy(self, job: str) -> None:
        """Remove what nobody needs once a job has ended: what it was given, or all of what can't be used."""
        with reading(self._engine) as c:
            row = jobs.get(c, job)
        if row.state == "succeeded":
            self._house.submit(_logged, KINDS[row.kind].tidy, self._objects, row)
            self._house.submit(_logged, count, self._engine, self._objects)
        elif row.state == "failed" and KINDS[row.kind].discards(row.problem):
            self._leaving.append((time.monotonic() + DYING, row))

    def _wind_up(self, row: Row[Any]) -> None:
        """Free what a cancelled job wrote, once nobody works on it."""
        with self._writing() as c:
            KINDS[row.kind].cancelled(c, row)
        dying = DYING if row.started_at else 0
        self._leaving.append((time.monotonic() + dying, row))

    def _discard(self) -> None:
        """Remove what ended jobs wrote, as soon as no worker works on them any more."""
        now = time.monotonic()
        while self._leaving and self._leaving[0][0] <= now:
            _, row = self._leaving.popleft()
            self._house.submit(_logged, KINDS[row.kind].discard, self._objects, row)

    def _submit(self) -> None:
        """Fill the cluster, the job that has had the fewest seconds of it first.

        One that begins counts from the least of the others, so that it neither waits for a large one to end nor takes
        everything until it has caught up.
        """
        dispatcher = self._dispatcher
        under_way = {job: dispatcher.under_way(job) for job in self._drives}
        dispatcher.want(sum(len(drive.to_do) + under_way[job] for job, drive in self._drives.items()))
        waiting = [drive for drive in self._drives.values() if drive.to_do]
        for _ in range(dispatcher.free):
            if not waiting:
                return
            drive = min(waiting, key=lambda drive: (drive.used(under_way[drive.job]), under_way[drive.job]))
            if not dispatcher.submit(drive.kind, drive.task, drive.to_do[0], drive.trace):
                return
            drive.to_do.popleft()
            under_way[drive.job] += 1
            if not drive.to_do:
                waiting.remove(drive)


def _logged(act: Callable[..., None], *arguments: Any) -> None:
    """Do something in the background; what it could not do, the next sweep does."""
    try:
        act(*arguments)
    except Exception:
        logger.exception("housekeeping failed, and is tried again later")
