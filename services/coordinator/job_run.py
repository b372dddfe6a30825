"""One job under way: what is still to do, and what is written to the ledger as its tiles come back."""

import logging
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any

from sqlalchemy import Connection, Row

from services.cluster.dispatcher import Outcome
from services.coordinator.job_kinds import JOB_KINDS, JobKind
from services.runtime import tracing
from services.runtime.logs import about
from services.runtime.problems import problem_of
from storage import steps as job_steps
from storage.errors import EnvmatteError, GaveUp, StoreUnavailable, Unavailable, WrongStore
from storage.records import jobs
from storage.records import tiles as tile_records
from storage.steps import FINISH, PREPARE
from workflows.jobs import Task, order
from workflows.untrusted.limits import Limits

logger = logging.getLogger(__name__)

TASKS = 250
"""How many tasks a second a scheduler is given at most. Each takes a millisecond of its only core, or two."""
LOSSES = 8
"""How often a tile may be lost before its job fails. Most workers die of something else, such as being turned off."""
STEP = 1.0
"""Seconds by which a clock that was set, or a machine that slept, has spoilt the pace that was measured."""
HOLD = 5.0
"""Seconds until the next tiles of a job are submitted after one could not reach the store."""
REMEDY = "give workers more memory (ENVMATTE_WORKER_MEMORY) or have them use less (ENVMATTE_INGEST_MEMORY), and retry"


@dataclass(frozen=True)
class Next:
    """How a job continues, once what was written about it is committed.

    Attributes
    ----------
    stage : str
    to_do : sequence of int
        Tiles to do in addition to those that are waiting.
    task : Task
    ended : bool
        Whether the job has ended.
    without_store : bool
        Whether its tiles can't reach the store.
    held : bool
        Whether no tile is to be submitted for a while, because no worker reaches it.
    """

    stage: str
    to_do: Sequence[int]
    task: Task
    ended: bool = False
    without_store: bool = False
    held: bool = False


@dataclass
class JobRun:
    """A job that this coordinator runs.

    Attributes
    ----------
    to_do : deque of int
        Tiles that have not been submitted to the cluster, `PREPARE` and `FINISH` among them.
    outcomes : list of Outcome
        Outcomes of tiles that are not written to the ledger yet.
    written_at : float
        When outcomes were last written.
    paced : int
        Number of threads of the cluster when the pace of its tiles was last measured; 0 until it was.
    clock : float
        How far the clock was ahead of the time since this machine started, then.
    trace : str, optional
        The ``traceparent`` of the request that asked for the job.
    paused : bool
        Whether none of its tiles are to be submitted until it is continued.
    region : list of int, optional
        x, y, width and height of the part of the frame whose tiles are done first.
    start, spent : float
        Worker seconds that the job is credited with at its start, and those it has used since.
    counted : int
        Tiles that used the latter.
    without_store : bool
        Whether a tile could not reach the store, and none has been done since.
    hold_until : float
        When the next tiles may be submitted.
    blind : bool
        Whether some worker did not see the store, which the job's log tells once.
    """

    job: str
    kind: JobKind
    stage: str
    task: Task
    to_do: deque[int]
    outcomes: list[Outcome] = field(default_factory=list)
    written_at: float = 0.0
    paced: int = 0
    clock: float = 0.0
    trace: str | None = None
    paused: bool = False
    region: list[int] | None = None
    start: float = 0.0
    spent: float = 0.0
    counted: int = 0
    without_store: bool = False
    hold_until: float = 0.0
    blind: bool = False

    @classmethod
    def of(cls, row: Row[Any], tiles: Sequence[int], limits: Limits) -> "JobRun":
        """Continue a job from where the ledger says it is.

        Parameters
        ----------
        row : sqlalchemy.Row
            Of the job.
        tiles : sequence of int
            Its tiles that are still to do.
        limits : Limits
        """
        kind, task = JOB_KINDS[row.kind], task_of(row, limits)
        if row.plan is None:
            stage, to_do = "preparing", [PREPARE]
        elif tiles:
            stage, to_do = kind.steps.stage, _ordered(kind, task, row.region, tiles)
        else:
            stage, to_do = "finishing", [FINISH]
        return cls(
            row.id, kind, stage, task, deque(to_do), trace=row.trace, paused=row.paused, region=row.region
        )

    @property
    def held(self) -> bool:
        """Whether none of its tiles are to be submitted now."""
        return self.paused or time.monotonic() < self.hold_until

    def follow(self, row: Row[Any]) -> None:
        """Do what was asked for since the job was last read: pause or continue, or do a region first."""
        if self.paused and not row.paused:
            self.paced = 0
        self.paused = row.paused
        if row.region != self.region:
            self.region = row.region
            if self.stage == self.kind.steps.stage:
                self.to_do = deque(_ordered(self.kind, self.task, self.region, self.to_do))

    def record_outcome(self, outcome: Outcome) -> None:
        """Keep the outcome of a tile until `write` writes it to the ledger."""
        self.outcomes.append(outcome)
        if outcome.done is not None:
            self.spent += outcome.done[0]
            self.counted += 1

    def next_tiles(self, threads: int) -> list[int]:
        """Take the next tiles for a task.

        It is one tile, or several where all ``threads`` of the cluster would end more than `TASKS` a second otherwise;
        but towards the end of a job few enough that all threads have some.
        """
        count = 1
        if self.spent:
            mean = self.spent / self.counted
            count = max(1, min(ceil(threads / (TASKS * mean)), len(self.to_do) // (2 * threads + 1)))
        return [self.to_do.popleft() for _ in range(count)]

    def used(self, under_way: int = 0) -> float:
        """Worker seconds that the job will have used once the tiles under way are done."""
        return self.start + self.spent * (1 + under_way / max(self.counted, 1))

    def write(self, connection: Connection, attempts: int, threads: int, under_way: int) -> Next:
        """Write the outcomes recorded so far to the ledger. Once that is committed, call `advance`.

        Parameters
        ----------
        attempts : int
            How often a tile may fail.
        threads : int
            Number of threads of the cluster now.
        under_way : int
            Tiles that the cluster still works on.
        """
        again: list[int] = []
        error: EnvmatteError | None = None
        results = self._write_results(connection, threads)
        without_store, held = self.without_store and not results, False
        for outcome in self.outcomes:
            if outcome.done is not None:
                continue
            if isinstance(outcome.error, StoreUnavailable):  # no fault of the tile, so it is no attempt
                self._log_store(connection, outcome.tile, outcome.error, known=without_store)
                held |= not isinstance(outcome.error, WrongStore)  # other workers may see it
                without_store = True
                again.append(outcome.tile)
                continue
            try:
                self._record_attempt(connection, outcome, attempts)
                again.append(outcome.tile)
            except EnvmatteError as found:
                error = error or found
        if error is not None:
            write_failure(connection, self.kind, self.task, error)
            return Next(self.stage, (), self.task, ended=True)
        if PREPARE in results:
            return self._prepared(connection, results[PREPARE][1])
        if FINISH in results:
            return self._finished(connection, results[FINISH][1])
        if self.stage == self.kind.steps.stage and not (again or self.to_do or under_way):
            return self._enter(connection, "finishing", [FINISH])
        return Next(self.stage, again, self.task, without_store=without_store, held=held)

    def advance(self, following: Next) -> None:
        """Continue as `write` returned; call it after that is committed."""
        if following.stage != self.stage or following.without_store:
            self.paced = 0
        self.without_store = following.without_store
        if following.held:
            self.hold_until = time.monotonic() + HOLD
        elif not self.without_store:
            self.hold_until = 0.0
        self.stage, self.task = following.stage, following.task
        self.to_do.extend(following.to_do)
        self.outcomes.clear()
        self.written_at = time.monotonic()

    def _write_results(self, connection: Connection, threads: int) -> dict[int, tuple[float, Any]]:
        """Write which tiles and steps are done; returns what they took and gave."""
        results = {outcome.tile: outcome.done for outcome in self.outcomes if outcome.done is not None}
        tiles = [(tile, seconds, pixels) for tile, (seconds, pixels) in results.items() if tile >= 0]
        steps = [
            (tile, seconds, 0)
            for tile, (seconds, result) in results.items()
            if tile < 0 and "missing" not in result
        ]
        tile_records.mark_done(connection, self.job, tiles + steps)
        clock = time.time() - time.monotonic()
        if tiles and (self.paced != threads or abs(clock - self.clock) > STEP):
            self.clock = clock
            # Not from the first tiles: their workers load what later ones find loaded.
            self.paced = threads if tile_records.start_pace(connection, self.job, after=threads) else 0
        return results

    def _log_store(self, connection: Connection, tile: int, error: StoreUnavailable, *, known: bool) -> None:
        """Tell the job's log that a tile could not reach the store, unless it is known."""
        blind = isinstance(error, WrongStore)
        if blind:
            with about(self.job, tile):
                logger.warning("%s", error.detail)
        if not (known or (blind and self.blind)):
            jobs.log(connection, self.job, f"waiting for the store: {error.detail}")
        self.blind |= blind

    def _record_attempt(self, connection: Connection, outcome: Outcome, attempts: int) -> None:
        """Record why a tile has no result, for it to be done again.

        Raises
        ------
        EnvmatteError
            If the job fails because of it.
        """
        tile, error, name = outcome.tile, outcome.error, job_steps.step_name(outcome.tile)
        if outcome.died is not None:  # and can't log it
            with about(self.job, tile):
                logger.warning("its worker %s died", outcome.died)
        if isinstance(error, EnvmatteError) and not isinstance(error, Unavailable):
            raise error  # the next attempt would fail in the same way
        if error is not None:
            with about(self.job, tile):
                logger.warning("failed: %r", error)
            reason = problem_of(error)["detail"]  # the job shows no more of an unexpected error
            record, allowed = tile_records.record_failure, attempts
            gave_up = f"{name} failed {attempts} times, last with: {reason}"
        elif outcome.starved:  # because of its tile, and it would be again
            reason = f"its worker {outcome.died} ran out of memory"
            record, allowed = tile_records.record_failure, attempts
            gave_up = f"{name} ran out of its worker's memory {attempts} times: {REMEDY}"
        elif outcome.died is not None:
            reason = f"its worker {outcome.died} died"
            record, allowed = tile_records.record_loss, LOSSES
            gave_up = (
                f"{name}: {LOSSES} workers died while doing it. Either a file makes a decoder hang or crash, or their "
                f"machines ran out of memory; their logs may say. Send other files, or {REMEDY}"
            )
        else:
            return
        if not record(connection, self.job, tile, reason, allowed):
            raise GaveUp(gave_up) from error

    def _enter(
        self, connection: Connection, stage: str, to_do: Sequence[int], task: Task | None = None
    ) -> Next:
        jobs.enter_stage(connection, self.job, stage)
        return Next(stage, to_do, task or self.task)

    def _prepared(self, connection: Connection, plan: dict[str, Any]) -> Next:
        tile_records.add_plan(connection, self.job, plan)
        row = jobs.get(connection, self.job)
        queued_at = row.queued_at or row.created_at
        tracing.past_span("queue", row.trace, queued_at, row.started_at, job=self.job, kind=row.kind)
        self.kind.prepared(connection, self.task, plan)
        for line in plan.get("notes", ()):
            jobs.log(connection, self.job, line)
        task = replace(self.task, plan=plan)
        tiles = _ordered(self.kind, task, self.region, range(plan["tiles"]))
        return self._enter(connection, self.kind.steps.stage, tiles, task)

    def _finished(self, connection: Connection, figures: dict[str, Any]) -> Next:
        if missing := figures.get("missing"):
            again = tile_records.requeue_missing(connection, self.job, missing, LOSSES)
            if len(again) == len(missing):
                return self._enter(connection, self.kind.steps.stage, again)
            error = GaveUp(
                f"the store loses what is written to it: {len(missing)} tiles are missing however often they are done"
            )
            write_failure(connection, self.kind, self.task, error)
        # Unless it was cancelled at the last moment.
        elif jobs.end(connection, self.job, "succeeded"):
            logger.info("succeeded")
            self.kind.succeeded(connection, self.task, figures)
        return Next(self.stage, (), self.task, ended=True)


def task_of(row: Row[Any], limits: Limits) -> Task:
    """What the steps of a job need to know, from its row."""
    return Task(
        job=row.id,
        capture=row.capture,
        matte=row.matte or "",
        options=row.options,
        limits=limits,
        plan=row.plan or {},
    )


def _ordered(kind: JobKind, task: Task, region: list[int] | None, tiles: Iterable[int]) -> list[int]:
    steps = kind.steps
    # A plan made by an earlier version lacks the figures.
    if region is None or steps.inside is None or "figures" not in task.plan:
        return order(steps, tiles)
    return order(steps, tiles, steps.inside(task.plan, task.options, region))


def write_failure(connection: Connection, kind: JobKind, task: Task, error: EnvmatteError) -> None:
    """Write to the ledger that a job failed."""
    problem = problem_of(error)
    with about(task.job):
        logger.warning("failed: %s", problem["detail"])
    if jobs.end(connection, task.job, "failed", problem):
        kind.failed(connection, task, problem)
