"""The coordinator: takes queued jobs and runs their steps on the cluster.

Any number of coordinators may be up; the one that holds the lease runs the jobs (`storage.records.leases`). It polls,
and it alone writes progress: results delivered by callbacks are lost with their client, and a dask scheduler keeps
nothing over a restart. Whatever the coordinator holds in memory can be rebuilt from the ledger.
"""

import logging
import os
import socket
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import chain
from typing import Any, ParamSpec

from sqlalchemy import Connection, Engine, Row

from services.cluster.dispatcher import Dispatcher
from services.coordinator.job_kinds import JOB_KINDS
from services.coordinator.job_run import JobRun, task_of, write_failure
from services.coordinator.retention import (
    count_bytes,
    delete_expired,
    delete_old_jobs,
    remove,
    sweep,
    sweep_uploads,
)
from services.runtime.logs import about
from services.runtime.problems import problem_of
from services.settings import CoordinatorSettings
from storage.database.disk_reserve import keep_reserve
from storage.database.engine import reading, writing
from storage.errors import EnvmatteError, GaveUp, NoRoom, Unavailable
from storage.maintenance.inventory import GRACE_SECONDS
from storage.objects.store import Objects
from storage.outage import Outage
from storage.records import jobs, leases, tiles
from storage.records.leases import Superseded

logger = logging.getLogger(__name__)
P = ParamSpec("P")

POLL = 0.1
"""Seconds between two reads of the ledger. News from the cluster is handled at once."""
BEAT = 2.0
"""Seconds between two heartbeats."""
BATCH = 0.5
"""Seconds after which no more jobs are started or cleaned up until the next poll: first the lease is renewed."""
WRITE = 0.25
"""Seconds between two writes of progress, whatever the number of jobs and tiles."""
DYING = 1.2
"""Seconds until no worker works on a cancelled job any more, see `services.cluster.worker_preload`."""
AGAIN = 10.0
"""Seconds until files that could not be removed are removed again."""
DELETE = 30.0
"""Seconds between two searches for old jobs to delete, and two checks of the database's reserve."""
SWEEP = 3600.0
"""Seconds between two sweeps of the store."""


class Coordinator:
    """Runs jobs while it holds the lease, until it is stopped.

    Parameters
    ----------
    settings : CoordinatorSettings
    engine : sqlalchemy.Engine
    objects : Objects
    dispatcher : Dispatcher
    """

    def __init__(
        self, settings: CoordinatorSettings, engine: Engine, objects: Objects, dispatcher: Dispatcher
    ) -> None:
        self._settings = settings
        self._engine = engine
        self._objects = objects
        self._dispatcher = dispatcher
        self._name = f"{socket.gethostname()}:{os.getpid()}"
        self._token: int | None = None
        self._runs: dict[str, JobRun] = {}
        self._removals: list[tuple[float, Row[Any]]] = []
        """Jobs whose files are to be removed: the earliest time, and the job's row."""
        self._errors: Counter[str] = Counter()
        """Unexpected errors while each job was run."""
        self._database_full = Outage(logger, quiet=5)
        self._beat_at = self._deleted_at = self._swept_at = self._wrote_at = self._read_at = -1e9
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="coordinator")
        self._housekeeping = ThreadPoolExecutor(1, thread_name_prefix="housekeeping")

    def __enter__(self) -> "Coordinator":
        if self._settings.alone:  # and nothing writes to the store yet
            sweep_uploads(self._engine, self._objects)
            self._sweep_store(self._objects.clock())
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopped.set()
        self._dispatcher.news.set()
        self._thread.join()
        self._housekeeping.shutdown(cancel_futures=True)
        if self._token is not None:
            with suppress(Unavailable, NoRoom), writing(self._engine) as c:
                leases.release(c, self._token)

    @property
    def token(self) -> int | None:
        """Token of the lease; None while another coordinator holds it."""
        return self._token

    def _loop(self) -> None:
        while not self._stopped.is_set():
            self._dispatcher.news.clear()
            try:
                if self._leads():
                    self._step()
                self._database_full.is_over("the database has room again")
            except Superseded as error:
                logger.warning("%s: %s", self._name, error)
                self._stand_down()
            except Unavailable:  # logged by `storage.database`
                self._stopped.wait(1)
            except NoRoom as error:
                self._database_full.goes_on("trying again every second: %s", error.detail)
                self._stopped.wait(1)
            except Exception:  # nothing may end this thread
                logger.exception("the coordinator continues after an error")
                self._stopped.wait(1)
            self._dispatcher.news.wait(POLL)

    def _leads(self) -> bool:
        """Whether this coordinator holds the lease; extends or requests it when that is due."""
        now = time.monotonic()
        if now - self._beat_at < BEAT:
            return self._token is not None
        self._beat_at = now
        if self._token is None:
            with writing(self._engine) as c:
                self._token = leases.acquire(c, self._name, seize=self._settings.alone)
            if self._token is None:
                return False
            logger.info("%s runs the jobs from now on", self._name)
        without_store = [run.job for run in self._runs.values() if run.without_store]
        with self._writing() as c:
            leases.renew(c, self._token, {**self._dispatcher.cluster, "without_store": without_store})
        if now - self._deleted_at > DELETE:
            self._deleted_at = now
            self._housekeeping.submit(_logged, keep_reserve, self._engine)
            kept = self._settings.job_seconds
            self._housekeeping.submit(_logged, delete_old_jobs, self._engine, self._objects, kept)
        if now - self._swept_at > SWEEP:
            self._sweep_store()
        _logged(self._expire)
        return True

    def _expire(self) -> None:
        """Delete what has expired, apart from the renewal of the lease: it may fail or take long."""
        with self._writing() as c:
            expired = delete_expired(c)
        for path in expired:
            self._housekeeping.submit(_logged, remove, self._objects, path)

    def _sweep_store(self, before: float | None = None) -> None:
        """Sweep the store, by default of what is older than the time of grace, and count what is there."""
        self._swept_at = time.monotonic()
        self._housekeeping.submit(_logged, self._sweep, before)
        self._housekeeping.submit(_logged, count_bytes, self._engine, self._objects)

    def _sweep(self, before: float | None) -> None:
        if before is None:
            before = self._objects.clock() - GRACE_SECONDS
        sweep(self._engine, self._objects, before)

    def _stand_down(self) -> None:
        """Drop all jobs: another coordinator runs them now."""
        self._token = None
        for job in list(self._runs):
            self._drop(job)
        self._removals.clear()
        self._errors.clear()

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        """A transaction that fails if another coordinator has taken over."""
        if self._token is None:
            raise Superseded("this coordinator holds no lease")
        with writing(self._engine) as c:
            leases.require_held(c, self._token)
            yield c

    def _step(self) -> None:
        self._submit()  # first, because a thread may be idle
        now = time.monotonic()
        if now - self._read_at >= POLL:
            self._read_at = now
            self._read()
        for outcome in self._dispatcher.collect():
            if outcome.job in self._runs:
                self._runs[outcome.job].record_outcome(outcome)
        for run in self._due():
            self._guarded(run.job, self._write, run)
        self._remove_due()
        self._submit()

    def _read(self) -> None:
        """Read from the ledger which jobs to run, and which to run no longer."""
        with reading(self._engine) as c:
            active = {row.id: row for row in jobs.to_run(c)}
            cancelled = jobs.cancelled_with_leftovers(c)
        for job in self._runs.keys() - active.keys():
            self._drop(job)
        new = [row for row in active.values() if row.id not in self._runs and not row.paused]
        for job, run in list(self._runs.items()):
            self._guarded(job, run.follow, active[job])
        for row in _batch(new):
            self._guarded(row.id, self._start, row.id)
        # Of other kinds, a newer coordinator knows what is left of them.
        for row in _batch([row for row in cancelled if row.kind in JOB_KINDS]):
            self._guarded(row.id, self._undo_cancelled, row)

    def _guarded(self, job: str, act: Callable[P, object], *arguments: P.args, **more: P.kwargs) -> None:
        """Do something about a job, whose errors must not hold up other jobs."""
        try:
            with about(job):
                act(*arguments, **more)
        except (Superseded, Unavailable, NoRoom):  # of the ledger: the job is not to blame
            raise
        except EnvmatteError as error:
            self._fail(job, error)
        except Exception as error:
            # Whatever is half done in memory is dropped: the ledger has the state of the job.
            with about(job):
                logger.exception("starting the job again from the ledger")
            if job in self._runs:
                self._drop(job)
            self._errors[job] += 1
            if self._errors[job] >= self._settings.attempts:
                self._fail(
                    job,
                    GaveUp(
                        f"the coordinator failed {self._errors[job]} times on this job, last with: "
                        f"{problem_of(error)['detail']}. Retry it, or if that fails too, start a new one"
                    ),
                )

    def _start(self, job: str) -> None:
        """Start a job if what it needs is there; raises if it never will be."""
        with reading(self._engine) as c:
            row = jobs.get(c, job)
            if row.state not in jobs.ACTIVE or not JOB_KINDS[row.kind].is_due(c, row):
                return
        with self._writing() as c:
            run = JobRun.of(row, tiles.remaining(c, row.id), self._settings.limits)
            if not jobs.enter_stage(c, row.id, run.stage):
                return  # it was cancelled after it was read
            tiles.add_steps(c, row.id)
        run.start = min((other.used() for other in self._runs.values()), default=0.0)
        self._runs[row.id] = run
        logger.info("%s, from the stage %s on", row.kind, run.stage)

    def _due(self) -> list[JobRun]:
        """The jobs whose outcomes are written now.

        These are the jobs that can't continue otherwise. Of the others it is one at a time, the one that has waited
        longest.
        """
        due = []
        for run in self._runs.values():
            if run.outcomes and not run.to_do and not self._dispatcher.under_way(run.job):
                due.append(run)
        now = time.monotonic()
        if now - self._wrote_at > WRITE:
            waiting = [run for run in self._runs.values() if run.outcomes and run not in due]
            if waiting:
                due.append(min(waiting, key=lambda run: run.written_at))
                self._wrote_at = now
        return due

    def _write(self, run: JobRun) -> None:
        """Write the outcomes of a job's tiles, and advance the job."""
        under_way = self._dispatcher.under_way(run.job)
        with self._writing() as c:
            following = run.write(c, self._settings.attempts, self._dispatcher.threads, under_way)
            # Not later, since a job that has ended may be deleted.
            row = jobs.get(c, run.job) if following.ended else None
        run.advance(following)
        if row is not None:
            self._drop(run.job)
            self._remove_useless(row)

    def _drop(self, job: str) -> None:
        """Stop running a job, and cancel its tasks on the cluster."""
        del self._runs[job]
        self._dispatcher.drop(job)

    def _fail(self, job: str, error: EnvmatteError) -> None:
        """End a job that can't be run."""
        with self._writing() as c:
            row = jobs.get(c, job)
            write_failure(c, JOB_KINDS[row.kind], task_of(row, self._settings.limits), error)
            row = jobs.get(c, job)  # as it is now
            jobs.clear_leftovers(c, job)  # of a cancelled job that can't be cleaned up
        if job in self._runs:
            self._drop(job)
        self._remove_useless(row)

    def _remove_useless(self, row: Row[Any]) -> None:
        """Remove what is of no use after the end of a job: its input, or everything if it can't be retried."""
        self._errors.pop(row.id, None)  # they are not those of a retry
        if row.state == "succeeded":
            self._housekeeping.submit(_logged, JOB_KINDS[row.kind].remove_inputs, self._objects, row)
            self._housekeeping.submit(_logged, count_bytes, self._engine, self._objects)
        elif row.state == "failed" and JOB_KINDS[row.kind].removes_failed(row.problem):
            self._removals.append((time.monotonic() + DYING, row))

    def _undo_cancelled(self, row: Row[Any]) -> None:
        """Remove what a cancelled job wrote, once no worker works on it."""
        with self._writing() as c:
            JOB_KINDS[row.kind].cancelled(c, row)
            jobs.clear_leftovers(c, row.id)
        self._removals.append((time.monotonic() + DYING, row))

    def _remove_due(self) -> None:
        """Remove the files of ended jobs on which no worker works any more."""
        now = time.monotonic()
        for due in [one for one in list(self._removals) if one[0] <= now]:
            self._removals.remove(due)
            self._housekeeping.submit(self._remove_files, due[1])

    def _remove_files(self, row: Row[Any]) -> None:
        """Remove the files of a job, now or later: on a busy machine a worker may take long to end."""
        try:
            JOB_KINDS[row.kind].remove_files(self._objects, row)
        except Exception as error:
            logger.warning(
                "the files of job %s are removed in %g s: %s",
                row.id,
                AGAIN,
                error,
                exc_info=not isinstance(error, EnvmatteError),
            )
            self._removals.append((time.monotonic() + AGAIN, row))

    def _submit(self) -> None:
        """Submit tiles for all free threads, first of the job that has used the fewest worker seconds.

        A job that starts is credited with the least of the others' seconds. So it neither waits for a large one to end,
        nor takes all threads until it has caught up.
        """
        dispatcher = self._dispatcher
        under_way = {job: dispatcher.under_way(job) for job in self._runs}
        waiting = [run for run in self._runs.values() if run.to_do and not run.held]
        dispatcher.want(sum(under_way.values()) + sum(len(run.to_do) for run in waiting))
        chosen: defaultdict[str, list[list[int]]] = defaultdict(list)
        for _ in range(dispatcher.free):
            if not waiting:
                break
            run = min(waiting, key=lambda run: (run.used(under_way[run.job]), under_way[run.job]))
            some = run.next_tiles(dispatcher.threads)
            chosen[run.job].append(some)
            under_way[run.job] += len(some)
            if not run.to_do:
                waiting.remove(run)
        for job, each in chosen.items():
            run = self._runs[job]
            if not dispatcher.submit(run.kind.steps, run.task, each, run.trace):
                run.to_do.extendleft(reversed([*chain.from_iterable(each)]))


def _batch(rows: Sequence[Row[Any]]) -> Iterator[Row[Any]]:
    """The first of some rows, one at least, until `BATCH` is over."""
    begin = time.monotonic()
    for row in rows:
        yield row
        if time.monotonic() - begin > BATCH:
            return


def _logged(act: Callable[..., None], *arguments: Any) -> None:
    """Run something whose errors are logged and stop nothing else; it is tried again later."""
    try:
        act(*arguments)
    except EnvmatteError as error:
        logger.warning("housekeeping is tried again later: %s", error.detail)
    except Exception:
        logger.exception("housekeeping failed; it is tried again later")
