"""Jobs over HTTP: start, list, read, cancel, retry and delete them."""

from datetime import UTC, datetime
from functools import partial
from typing import Annotated, Any

from fastapi import Depends, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection

from services.api.context import Context, ListContext, OwnerContext
from services.api.http.bodies import json_body, read_json
from services.api.http.idempotency import IdempotencyKey, find_earlier, idempotent
from services.api.http.responses import json_response
from services.api.http.router import Router, in_turn
from services.api.http.types import After, PageSize
from services.api.jobs.job import Job, Region
from services.api.limits.quotas import NewData, admit
from services.coordinator.job_kinds import JOB_KINDS
from services.runtime import tracing
from services.webhooks.sender import check_webhook
from storage.database.engine import reading, writing
from storage.database.rows import new_id, page
from storage.database.tables import jobs as table
from storage.errors import Conflict, OptionError
from storage.layout import composites
from storage.records import captures, jobs, mattes
from workflows.mattes.options import describe_options, parse_options
from workflows.programs.program import Program

router = Router(tags=["jobs"])
CALL = "POST /v1/jobs"
REQUEST_BYTES = 64 << 10


class JobRequest(BaseModel):
    """The capture to recover a matte from, and the options."""

    model_config = ConfigDict(extra="forbid")
    capture: str
    options: dict[str, Any] = Field(default_factory=dict, description="GET /v1/options lists them.")
    webhook: str | None = Field(None, description="URL, https, that is notified when the job has ended.")
    region: Region | None = Field(None, description="The part of the frame that is recovered first.")


class JobChange(BaseModel):
    """What to change of a job that has not ended."""

    model_config = ConfigDict(extra="forbid")
    paused: bool | None = Field(
        None,
        description="Whether it pauses: what is under way is done, the rest waits until it is continued.",
    )
    region: Region | None = Field(
        None, description="The part of the frame that is recovered first, from now on. For recoveries only."
    )


async def _job_request(request: Request) -> JobRequest:
    return await read_json(request, JobRequest, REQUEST_BYTES)


async def _job_change(request: Request) -> JobChange:
    return await read_json(request, JobChange, REQUEST_BYTES)


class Jobs(BaseModel):
    """A page of jobs, newest first."""

    jobs: list[Job]


class Option(BaseModel):
    """An option of recovery; `method` is null if every method has it."""

    name: str
    method: str | None
    type: str
    default: str | int | float | bool | None
    values: list[str] | None
    minimum: float | None
    maximum: float | None
    description: str


class Options(BaseModel):
    """All options of recovery."""

    options: list[Option]


class Line(BaseModel):
    """A line of a job's log."""

    line: int
    at: datetime
    text: str


class Log(BaseModel):
    """Lines of a job's log, oldest first."""

    lines: list[Line]


@router.get("/options")
def list_options(context: OwnerContext) -> Options:
    """All options of recovery."""
    return Options.model_validate({"options": describe_options()})


@router.post(
    "/jobs",
    status_code=202,
    openapi_extra=json_body(JobRequest),
)
async def post_job(
    context: OwnerContext,
    given: Annotated[JobRequest, Depends(_job_request)],
    request: Request,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Queue the recovery of a matte; the capture may still be ingesting."""
    # A program may take as long to read as those in lists.
    queue = partial(_queue, context, given, idempotency_key)
    job = await context.compute(request, context.shares.lists, queue)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


def _queue(context: Context, request: JobRequest, key: str | None) -> Job:
    """Add the job of a recovery, and its matte; a repeated request is answered with the first's job."""
    options = parse_options(request.options)
    check_webhook(request.webhook, context.settings)
    earlier = find_earlier(context.engine, key, CALL, Job.read)
    if earlier is not None:
        return earlier
    with reading(context.engine) as c:
        # Again below, where it is certain; to read a program takes longer.
        admit(c, context.settings, NewData(jobs=1))
        captures.get(c, request.capture)
        program = captures.program_json(c, request.capture)
    # Grids that do not nest are refused here, not by the job; and before the transaction, for which others wait.
    Program.model_validate_json(program).bands()

    def create(c: Connection) -> str:
        capture = captures.get(c, request.capture)
        if capture.state == "failed":
            raise Conflict(f"capture {capture.id} failed: {capture.problem['detail']}")
        admit(c, context.settings, NewData(jobs=1))
        matte = new_id()
        chosen = options.model_dump(mode="json")
        job = jobs.add(
            c,
            "recover",
            capture.id,
            chosen,
            matte,
            trace=tracing.current_traceparent(),
            webhook=request.webhook,
            region=request.region.stored if request.region else None,
        )
        mattes.add(c, matte, capture.id, job, chosen, context.settings.matte_seconds, capture.name)
        return job

    return idempotent(context.engine, key, CALL, Job.read, create)


@router.get("/jobs", response_model=Jobs)
async def list_jobs(
    context: ListContext,
    request: Request,
    limit: PageSize = 100,
    after: After = None,
    state: jobs.State | None = None,
) -> Response:
    """Jobs, newest first."""

    def make() -> Response:
        with reading(context.engine) as c:
            rows = page(c, table, limit, after, state=state)
            return json_response(Jobs(jobs=list(Job.of(c, rows))))

    return await context.compute(request, context.shares.lists, make)


@router.get("/jobs/{id}")
def get_job(context: OwnerContext, id: str) -> Job:
    """A job."""
    with reading(context.engine) as c:
        return Job.read(c, id)


@router.get("/jobs/{id}/log")
def get_log(
    context: OwnerContext, id: str, limit: PageSize = 1000, after: Annotated[int, Query(ge=0, lt=1 << 63)] = 0
) -> Log:
    """The log of a job, line by line."""
    with reading(context.engine) as c:
        jobs.get(c, id)
        rows = jobs.log_lines(c, id, after, limit)
    return Log(lines=[Line(line=r.line, at=datetime.fromtimestamp(r.at, UTC), text=r.text) for r in rows])


@router.patch(
    "/jobs/{id}",
    dependencies=[Depends(in_turn(get_job))],  # an unknown job is reported before a bad body
    openapi_extra=json_body(JobChange),
)
def change_job(context: OwnerContext, id: str, change: Annotated[JobChange, Depends(_job_change)]) -> Job:
    """Pause a job or continue it, or recover a part of the frame first."""
    with writing(context.engine) as c:
        row = jobs.require_active(c, id)
        if change.region is not None:
            if row.kind != "recover":
                raise OptionError(
                    f"job {id} is no recovery, so no part of a frame comes first", field="region"
                )
            jobs.change(c, id, region=change.region.stored)
        if change.paused is not None:
            if change.paused and not row.paused:
                admit(c, context.settings)  # its log grows; to continue is never refused
            jobs.pause(c, id, change.paused)
        return Job.read(c, id)


@router.post("/jobs/{id}/cancel")
def cancel_job(context: OwnerContext, id: str) -> Job:
    """Cancel a job. What it has written is removed as soon as its running tasks have ended."""
    with writing(context.engine) as c:
        jobs.cancel(c, id)
        return Job.read(c, id)


@router.post("/jobs/{id}/retry", status_code=202)
def retry_job(context: OwnerContext, id: str) -> Job:
    """Queue a failed job again. Finished tiles are kept, unless `ENVMATTE_INGEST_MEMORY` has changed."""
    with writing(context.engine) as c:
        row = jobs.get(c, id)
        # The memory determines the size of an ingest's slabs. If it was too much, new slabs must be smaller.
        memory = (row.plan or {}).get("memory", context.settings.ingest_memory)
        if row.state == "failed":
            admit(c, context.settings, NewData(jobs=1))
        jobs.retry(
            c, id, replan=memory != context.settings.ingest_memory, trace=tracing.current_traceparent()
        )
        JOB_KINDS[row.kind].retried(c, row)
        return Job.read(c, id)


@router.delete("/jobs/{id}", status_code=204)
def delete_job(context: OwnerContext, id: str) -> None:
    """Delete a job that has ended, with its log and the video of a composite. Its matte stays."""
    with writing(context.engine) as c:
        row = jobs.get(c, id)
        jobs.delete(c, id)
    if row.kind == "composite":
        context.objects.delete(composites.path(id))
