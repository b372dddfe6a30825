"""A job that is being driven: what of it is to be done, and what the ledger is told of what was."""

import logging
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Connection, Row

from services.cluster.dispatcher import Outcome
from services.coordinator.job_kinds import KINDS as RECORDS
from services.runtime import tracing
from services.runtime.logs import about
from services.runtime.problems import problem_of
from storage import steps as job_steps
from storage.errors import EnvmatteError, GaveUp, Unavailable
from storage.records import job_log, jobs
from storage.records import tiles as tile_records
from storage.steps import FINISH, PREPARE
from workflows.jobs import KINDS, Task, order
from workflows.untrusted.limits import Limits

logger = logging.getLogger(__name__)

LOSSES = 8
"""How often a tile may be lost before its job fails: most workers die of something else, turned off say."""
REMEDY = "give workers more (ENVMATTE_WORKER_MEMORY) or have them hold less (ENVMATTE_INGEST_MEMORY), and retry the job"


@dataclass(frozen=True)
class Next:
    """How a job goes on, once what was written about it is committed.

    Attributes
    ----------
    stage : str
    to_do : sequence of int
        Tiles to do besides those there are.
    task : Task
    ended : bool
        Whether it does not go on.
    """

    stage: str
    to_do: Sequence[int]
    task: Task
    ended: bool = False


@dataclass
class Drive:
    """A job that is being driven.

    Attributes
    ----------
    to_do : deque of int
        Tiles that the cluster has not got, `PREPARE` and `FINISH` among them.
    news : list of Outcome
        What became of those it had, and is not written down yet.
    settled_at : float
        When something last was.
    paced : int
        Threads of the cluster for which the pace of its tiles is measured; 0 until there is a pace.
    trace : str, optional
        The ``traceparent`` of the request that asked for it.
    start, spent : float
        Seconds of workers that it is taken to have had when it began, and that it has had since.
    counted : int
        Tiles that took the latter.
    """

    job: str
    kind: str
    stage: str
    task: Task
    to_do: deque[int]
    news: list[Outcome] = field(default_factory=list)
    settled_at: float = 0.0
    paced: int = 0
    trace: str | None = None
    start: float = 0.0
    spent: float = 0.0
    counted: int = 0

    @classmethod
    def of(cls, row: Row[Any], tiles: Sequence[int], store: str, limits: Limits) -> "Drive":
        """Take up a job where the ledger says that it stands: ``tiles`` are still to do."""
        task = Task(
            job=row.id,
            store=store,
            capture=row.capture,
            matte=row.matte or "",
            options=row.options,
            limits=limits,
            plan=row.plan or {},
        )
        if row.plan is None:
            stage, to_do = "preparing", [PREPARE]
        elif tiles:
            stage, to_do = KINDS[row.kind].stage, order(row.kind, tiles)
        else:
            stage, to_do = "finishing", [FINISH]
        return cls(row.id, row.kind, stage, task, deque(to_do), trace=row.trace)

    def hear(self, outcome: Outcome) -> None:
        """Take in what became of a tile."""
        self.news.append(outcome)
        if outcome.done is not None:
            self.spent += outcome.done[0]
            self.counted += 1

    def used(self, under_way: int = 0) -> float:
        """Seconds of workers that it will have had once the tiles under way are done."""
        return self.start + self.spent * (1 + under_way / max(self.counted, 1))

    def settle(self, connection: Connection, attempts: int, threads: int, under_way: int) -> Next:
        """Write down the news of a job.

        Parameters
        ----------
        attempts : int
            How often a tile may fail.
        threads : int
            Of the cluster, now.
        under_way : int
            Tiles that the cluster still has.
        """
        again: list[int] = []
        error: EnvmatteError | None = None
        results = {outcome.tile: outcome.done for outcome in self.news if outcome.done is not None}
        tiles = [(tile, seconds, pixels) for tile, (seconds, pixels) in results.items() if tile >= 0]
        steps = [
            (tile, seconds, 0)
            for tile, (seconds, result) in results.items()
            if tile < 0 and "missing" not in result
        ]
        tile_records.finish(connection, self.job, tiles + steps)
        if tiles and self.paced != threads:
            # Not the first tiles: their workers load what the others find loaded.
            self.paced = threads if tile_records.pace(connection, self.job, after=threads) else 0
        for outcome in self.news:
            if outcome.done is not None:
                continue
            try:
                if self._may_go_on(connection, outcome, attempts):
                    again.append(outcome.tile)
            except EnvmatteError as found:
                error = error or found
        if error is not None:
            end_badly(connection, self.kind, self.task, error)
            return Next(self.stage, (), self.task, ended=True)
        if PREPARE in results:
            return self._prepared(connection, results[PREPARE][1])
        if FINISH in results:
            return self._finished(connection, results[FINISH][1])
        if self.stage == KINDS[self.kind].stage and not (again or self.to_do or under_way):
            return self._enter(connection, "finishing", [FINISH])
        return Next(self.stage, again, self.task)

    def go_on(self, following: Next) -> None:
        """Go on with a job as `settle` said; call it once that is committed."""
        if following.stage != self.stage:
            self.paced = 0
        self.stage, self.task = following.stage, following.task
        self.to_do.extend(following.to_do)
        self.news.clear()
        self.settled_at = time.monotonic()

    def _may_go_on(self, connection: Connection, outcome: Outcome, attempts: int) -> bool:
        """Whether a tile that came to nothing is to be done again.

        Raises
        ------
        EnvmatteError
            If the job can't go on without it.
        """
        tile, error, name = outcome.tile, outcome.error, job_steps.name_of(outcome.tile)
        if outcome.died is not None:  # which says nothing any more
            with about(self.job, tile):
                logger.warning("its worker %s died", outcome.died)
        if isinstance(error, EnvmatteError) and not isinstance(error, Unavailable):
            raise error  # it would be the same the next time
        if error is not None:
            if tile_records.miss(connection, self.job, tile, repr(error), attempts):
                return True
            raise GaveUp(f"{name} failed {attempts} times, last with {error!r}") from error
        if outcome.starved:  # which its tile did, and would do again
            if tile_records.miss(
                connection, self.job, tile, f"its worker {outcome.died} ran out of memory", attempts
            ):
                return True
            raise GaveUp(f"{name} ran out of its worker's memory {attempts} times: {REMEDY}")
        if outcome.died is not None:
            if tile_records.lose(connection, self.job, tile, f"its worker {outcome.died} died", LOSSES):
                return True
            raise GaveUp(
                f"{name}: {LOSSES} workers that did it died, of a file that a decoder hangs or crashes at, or for want "
                f"of memory of their machines, as their logs may tell: send other files, or {REMEDY}"
            )
        return True

    def _enter(
        self, connection: Connection, stage: str, to_do: Sequence[int], task: Task | None = None
    ) -> Next:
        jobs.enter(connection, self.job, stage)
        return Next(stage, to_do, task or self.task)

    def _prepared(self, connection: Connection, plan: dict[str, Any]) -> Next:
        tile_records.lay_down(connection, self.job, plan)
        row = jobs.get(connection, self.job)
        tracing.waited("queue", row.trace, row.created_at, row.started_at, job=self.job, kind=self.kind)
        RECORDS[self.kind].prepared(connection, self.task, plan)
        for line in plan.get("notes", ()):
            job_log.note(connection, self.job, line)
        tiles = order(self.kind, range(plan["tiles"]))
        return self._enter(connection, KINDS[self.kind].stage, tiles, replace(self.task, plan=plan))

    def _finished(self, connection: Connection, figures: dict[str, Any]) -> Next:
        if missing := figures.get("missing"):
            again = tile_records.reopen(connection, self.job, missing, LOSSES)
            if len(again) == len(missing):
                return self._enter(connection, KINDS[self.kind].stage, again)
            error = GaveUp(
                f"{len(missing)} tiles are missing in the store, however often they are done: it loses what it is given"
            )
            end_badly(connection, self.kind, self.task, error)
        # Unless it was cancelled at the last moment, and is wound up next.
        elif jobs.end(connection, self.job, "succeeded"):
            logger.info("succeeded")
            RECORDS[self.kind].succeeded(connection, self.task, figures)
        return Next(self.stage, (), self.task, ended=True)


def end_badly(connection: Connection, kind: str, task: Task, error: EnvmatteError) -> None:
    """Write down that a job failed."""
    problem = problem_of(error)
    with about(task.job):
        logger.warning("failed: %s", problem["detail"])
    if jobs.end(connection, task.job, "failed", problem):
        RECORDS[kind].failed(connection, task, problem)
