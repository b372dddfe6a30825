"""Workers, the queue and the coordinator over HTTP."""

from pydantic import BaseModel, Field

from services.api.context import AdminContext
from services.api.http.router import Router
from services.api.jobs.wait_reason import trouble_of
from storage import statistics
from storage.cluster_state import EMPTY_CLUSTER
from storage.database.engine import reading
from storage.records import leases
from storage.records.jobs import ACTIVE
from storage.records.leases import Heartbeat
from workflows.untrusted import confinement

router = Router(tags=["system"])


class Worker(BaseModel):
    """A worker process."""

    address: str
    name: str
    threads: int
    memory_bytes: int
    memory_limit_bytes: int | None = Field(
        description="The worker is ended before it takes more; null if there is no limit."
    )
    unconfined_decoders: str | None = Field(
        None,
        description="Why the worker's machine can't confine decoders of untrusted files; null if it can.",
    )


class Queue(BaseModel):
    """Jobs and tiles that are queued or running."""

    jobs_queued: int
    jobs_running: int
    tiles_to_do: int = Field(description="Of running jobs only: a queued job has no tiles yet.")
    tiles_under_way: int = Field(description="Tiles that the cluster has, and steps before and after tiles.")
    tiles_per_second: float | None = Field(description="Of all running jobs together; null until measured.")


class Coordinator(BaseModel):
    """The process that runs jobs on the cluster."""

    holder: str | None = Field(description="Its host and process id; null if it has stopped.")
    last_sign_seconds: float | None = Field(
        description="Seconds since its last sign of life; null if there was none."
    )


class Cluster(BaseModel):
    """Workers as the coordinator last saw them, and the queue."""

    workers: list[Worker]
    threads: int
    memory_bytes: int
    memory_limit_bytes: int | None
    queue: Queue
    coordinator: Coordinator
    unconfined_decoders: str | None = Field(
        description="Why the service's own machine can't confine decoders of pictures; null if it can."
    )
    problem: str | None = Field(description="Why jobs do not progress, in words; null if they do.")


@router.get("/cluster")
def get_cluster(context: AdminContext) -> Cluster:
    """Workers, threads, memory, the queue, and what is wrong, if anything."""
    with reading(context.engine) as c:
        heartbeat = leases.last_heartbeat(c)
        active = [row for row in statistics.job_counts(c) if row.state in ACTIVE]
        missing = sum(statistics.missing_tiles(c).values())
        pace = statistics.tiles_per_second(c)
    seen = (heartbeat or Heartbeat(None, 0, EMPTY_CLUSTER)).cluster
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
            holder=heartbeat.holder if heartbeat else None,
            last_sign_seconds=heartbeat.seconds if heartbeat else None,
        ),
        unconfined_decoders=confinement.missing(),
        problem=trouble_of(heartbeat),
    )
