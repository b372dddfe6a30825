"""What works on jobs, and what there is to do, over HTTP."""

from fastapi import APIRouter
from pydantic import BaseModel, Field

from services.api.context import AdminContext
from services.api.jobs.wait_reason import trouble_of
from storage.database.engine import reading
from storage.records import leases, statistics
from storage.records.jobs import ACTIVE
from storage.records.leases import Heartbeat

router = APIRouter(tags=["system"])


class Worker(BaseModel):
    """A worker process."""

    address: str
    name: str
    threads: int
    memory_bytes: int
    memory_limit_bytes: int | None = Field(description="It is ended short of it; none if null.")


class Queue(BaseModel):
    """What there is to do."""

    jobs_queued: int
    jobs_running: int
    tiles_to_do: int = Field(description="Of running jobs: how many a queued one will have is not known yet.")
    tiles_under_way: int = Field(description="That the cluster has, steps before and after tiles among them.")
    tiles_per_second: float | None = Field(description="Of all running jobs; null until it was measured.")


class Coordinator(BaseModel):
    """The process that drives jobs."""

    holder: str | None = Field(description="Host and process id; null once it has stopped.")
    last_sign_seconds: float | None = Field(
        description="Since its last sign of life; null if there was none."
    )


class Cluster(BaseModel):
    """Workers as the coordinator last saw them, and the queue."""

    workers: list[Worker]
    threads: int
    memory_bytes: int
    memory_limit_bytes: int | None
    queue: Queue
    coordinator: Coordinator
    problem: str | None = Field(description="Why nothing goes on, in words.")


@router.get("/cluster")
def get_cluster(context: AdminContext) -> Cluster:
    """Workers, threads, memory, the queue, and what is wrong if something is."""
    with reading(context.engine) as c:
        sign = leases.last_heartbeat(c)
        active = [row for row in statistics.job_counts(c) if row.state in ACTIVE]
        missing = sum(statistics.missing_tiles(c).values())
        pace = statistics.tiles_per_second(c)
    seen = (sign or Heartbeat(None, 0, leases.EMPTY_CLUSTER)).cluster
    workers = [Worker.model_validate(worker) for worker in seen["workers"]]
    limits = [worker.memory_limit_bytes for worker in workers if worker.memory_limit_bytes]
    return Cluster(
        workers=workers,
        threads=sum(worker.threads for worker in workers),
        memory_bytes=sum(worker.memory_bytes for worker in workers),
        memory_limit_bytes=sum(limits) if len(limits) == len(workers) > 0 else None,
        queue=Queue(
            jobs_queued=sum(row.number for row in active if row.state == "queued"),
            jobs_running=sum(row.number for row in active if row.state == "running"),
            tiles_to_do=sum(row.total - row.done - row.failed for row in active) + missing,
            tiles_under_way=seen.get("under_way", 0),
            tiles_per_second=pace,
        ),
        coordinator=Coordinator(
            holder=sign.holder if sign else None, last_sign_seconds=sign.seconds if sign else None
        ),
        problem=trouble_of(sign),
    )
