"""The registry of job kinds: the steps of each, and what its jobs change in the database and the store."""

from typing import Any

from sqlalchemy import Connection, Row

from services.runtime.problems import problem_of
from storage.errors import Conflict, GaveUp
from storage.layout import captures as stored_captures
from storage.layout import composites, uploads
from storage.layout import mattes as stored_mattes
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
from storage.records.jobs import is_retryable
from workflows.composite.video import steps as video_steps
from workflows.ingest import steps as ingest_steps
from workflows.jobs import Steps, Task
from workflows.mattes import steps as matte_steps

Problem = dict[str, Any]


class JobKind:
    """A kind of job: its steps, what is recorded of it, and what is removed.

    Methods that take a connection are part of a transaction. Methods that take the store run after it, and may be
    repeated.

    Attributes
    ----------
    steps : Steps
        What workers run.
    """

    steps: Steps

    def is_due(self, connection: Connection, row: Row[Any]) -> bool:
        """Whether a queued job may start now.

        Raises
        ------
        EnvmatteError
            If it can never start.
        """
        return True

    def prepared(self, connection: Connection, task: Task, plan: dict[str, Any]) -> None:
        """Record that a job has its plan."""

    def succeeded(self, connection: Connection, task: Task, figures: dict[str, Any]) -> None:
        """Record that a job succeeded."""

    def failed(self, connection: Connection, task: Task, problem: Problem) -> None:
        """Record that a job failed."""

    def cancelled(self, connection: Connection, row: Row[Any]) -> None:
        """Record that what a cancelled job made is removed."""

    def retried(self, connection: Connection, row: Row[Any]) -> None:
        """Record that a failed job is queued again.

        Raises
        ------
        EnvmatteError
            If it can't be retried.
        """

    def remove_inputs(self, objects: Objects, row: Row[Any]) -> None:
        """Remove what a job that succeeded no longer needs."""

    def remove_files(self, objects: Objects, row: Row[Any]) -> None:
        """Remove the input of a job, and everything it wrote."""

    def removes_failed(self, problem: Problem) -> bool:
        """Whether a job that failed with this problem is of no further use, and its files are removed."""
        return False


class Ingest(JobKind):
    """Makes a capture of a capture archive."""

    steps = ingest_steps.STEPS

    def prepared(self, connection: Connection, task: Task, plan: dict[str, Any]) -> None:
        found = {name: plan[name] for name in ("width", "height", "frames")}
        captures.change(connection, task.capture, **found)

    def succeeded(self, connection: Connection, task: Task, figures: dict[str, Any]) -> None:
        captures.change(connection, task.capture, state="ready")
        jobs.change(connection, task.job, plan=task.plan | figures)

    def failed(self, connection: Connection, task: Task, problem: Problem) -> None:
        captures.change(
            connection,
            task.capture,
            state="failed",
            problem=problem,
            stored=0 if self.removes_failed(problem) else None,
        )

    def cancelled(self, connection: Connection, row: Row[Any]) -> None:
        problem = problem_of(Conflict("the ingest was cancelled; upload the capture again"))
        captures.change(connection, row.capture, state="failed", problem=problem, stored=0)

    def retried(self, connection: Connection, row: Row[Any]) -> None:
        capture = captures.get(connection, row.capture)
        if not is_retryable(capture.problem):
            raise Conflict(f"capture {capture.id} can't be used and was not kept; upload it again")
        captures.change(connection, capture.id, state="ingesting", problem=None, stored=None)

    def remove_inputs(self, objects: Objects, row: Row[Any]) -> None:
        uploads.remove(objects, row.capture)

    def remove_files(self, objects: Objects, row: Row[Any]) -> None:
        objects.delete(stored_captures.path(row.capture))
        uploads.remove(objects, row.capture)

    def removes_failed(self, problem: Problem) -> bool:
        return not is_retryable(problem)


class Recovery(JobKind):
    """Makes a matte of a capture, once that is ingested."""

    steps = matte_steps.STEPS

    def is_due(self, connection: Connection, row: Row[Any]) -> bool:
        capture = captures.get(connection, row.capture)
        if capture.state == "failed":
            raise Conflict(f"capture {capture.id} could not be ingested: {capture.problem['detail']}")
        return bool(capture.state == "ready")

    def prepared(self, connection: Connection, task: Task, plan: dict[str, Any]) -> None:
        mattes.change(connection, task.matte, figures=plan.get("figures"))

    def succeeded(self, connection: Connection, task: Task, figures: dict[str, Any]) -> None:
        mattes.change(connection, task.matte, state="ready", figures=figures)

    def failed(self, connection: Connection, task: Task, problem: Problem) -> None:
        mattes.change(connection, task.matte, state="failed")

    def cancelled(self, connection: Connection, row: Row[Any]) -> None:
        mattes.delete(connection, row.matte)

    def retried(self, connection: Connection, row: Row[Any]) -> None:
        capture = captures.get(connection, row.capture)
        if capture.state == "failed":
            raise Conflict(f"capture {capture.id} failed: {capture.problem['detail']}")
        mattes.get(connection, row.matte)  # raises if it has expired or been deleted
        mattes.change(connection, row.matte, state="recovering", stored=None)

    def remove_files(self, objects: Objects, row: Row[Any]) -> None:
        objects.delete(stored_mattes.path(row.matte))


class Composite(JobKind):
    """Makes a video of a clip and a matte. Its only record is the job's."""

    steps = video_steps.STEPS

    def succeeded(self, connection: Connection, task: Task, figures: dict[str, Any]) -> None:
        jobs.change(connection, task.job, stored=None)

    def failed(self, connection: Connection, task: Task, problem: Problem) -> None:
        if self.removes_failed(problem):
            jobs.change(connection, task.job, stored=0)

    def cancelled(self, connection: Connection, row: Row[Any]) -> None:
        jobs.change(connection, row.id, stored=0)

    def retried(self, connection: Connection, row: Row[Any]) -> None:
        if self.removes_failed(row.problem):
            raise Conflict(f"the clip of job {row.id} can't be used and was not kept; send another one")
        mattes.get(connection, row.matte)

    def remove_inputs(self, objects: Objects, row: Row[Any]) -> None:
        composites.remove_inputs(objects, row.id)

    def remove_files(self, objects: Objects, row: Row[Any]) -> None:
        objects.delete(composites.path(row.id))

    def removes_failed(self, problem: Problem) -> bool:
        return not is_retryable(problem)


class Unknown(JobKind):
    """A kind that this coordinator is too old to know."""

    def is_due(self, connection: Connection, row: Row[Any]) -> bool:
        raise GaveUp(
            f"this coordinator does not know jobs of the kind {row.kind!r}: it is older than the service that queued "
            "the job. Upgrade it, and retry the job"
        )


class _JobKinds(dict[str, JobKind]):
    def __missing__(self, name: str) -> JobKind:
        return Unknown()


JOB_KINDS = _JobKinds((kind.steps.kind, kind) for kind in (Ingest(), Recovery(), Composite()))
