"""Metrics for Prometheus, from the database, so that every process of the service reports the same."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, get_args

from fastapi import Request, Response
from prometheus_client import CollectorRegistry, Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, SummaryMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from sqlalchemy import Connection

from services.api.context import AdminContext
from services.api.http.router import Router
from services.api.jobs.wait_reason import trouble_of
from storage import statistics
from storage.cluster_state import EMPTY_CLUSTER
from storage.database.engine import reading
from storage.records import captures, jobs, leases, mattes
from storage.records.leases import Heartbeat

router = Router(tags=["system"])
KINDS: tuple[str, ...] = get_args(jobs.Kind)
MEDIA_TYPES = ("text/plain", "application/openmetrics-text")
Labelled = Iterable[tuple[tuple[str, ...], float]]


class _Fixed(Collector):
    """A collector of metrics that exist already."""

    def __init__(self, metrics: list[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> list[Metric]:
        return self._metrics


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "content": {kind: {} for kind in MEDIA_TYPES},
            "description": "The metrics, in the form of `Accept`",
        }
    },
)
def get_metrics(context: AdminContext, request: Request) -> Response:
    """Metrics of the whole service for Prometheus."""
    with reading(context.engine) as c:
        found = _Fixed([*_of_the_queue(c), *_of_work(c), *_of_data(c), *_of_the_cluster(c)])
    registry = CollectorRegistry()
    registry.register(found)
    encode, media_type = choose_encoder(request.headers.get("accept", ""))
    return Response(encode(registry), headers={"Content-Type": media_type})


def _of_the_queue(connection: Connection) -> Iterator[Metric]:
    """Jobs, and the tiles of active jobs."""
    rows = {(row.kind, row.state): row for row in statistics.job_counts(connection)}
    numbers = {(kind, state): 0 for kind in KINDS for state in get_args(jobs.State)}
    numbers |= {labels: row.number for labels, row in rows.items()}
    yield _gauge("jobs", "Jobs by kind and state.", ("kind", "state"), numbers.items())
    missing = statistics.missing_tiles(connection)
    states: dict[tuple[str, ...], int] = {}
    for kind in KINDS:
        active = [row for (one, state), row in rows.items() if one == kind and state in jobs.ACTIVE]
        total, done, failed = (
            sum(getattr(row, name) for row in active) for name in ("total", "done", "failed")
        )
        again = missing.get(kind, 0)  # elsewhere they count as done, so that progress never goes back
        by_state = {"queued": total - done - failed, "done": done - again, "failed": failed, "missing": again}
        states |= {(kind, state): number for state, number in by_state.items()}
    yield _gauge(
        "tiles",
        "Tiles of queued and running jobs. Missing: were done, but are not in the store and are done again.",
        ("kind", "state"),
        states.items(),
    )


def _of_work(connection: Connection) -> Iterator[Metric]:
    """Work done so far."""
    rows = {row.kind: row for row in statistics.work_totals(connection)}
    kinds = dict.fromkeys((*KINDS, *rows))  # a newer service may know others
    steps = SummaryMetricFamily(
        "envmatte_tile_seconds", "Seconds that workers spent on finished tiles.", labels=["kind"]
    )
    for kind in kinds:
        row = rows.get(kind)
        steps.add_metric((kind,), getattr(row, "tiles", 0), getattr(row, "seconds", 0))
    yield steps
    for name, column, text in (
        ("pixels", "pixels", "Pixels done: of frames ingested, mattes recovered and frames composited."),
        ("tile_failures", "misses", "Failed attempts at a tile or a step."),
        ("tile_losses", "losses", "Tiles and steps lost with their worker or in the store."),
    ):
        yield _counter(name, text, ("kind",), _of_each(kinds, rows, column))


def _of_data(connection: Connection) -> Iterator[Metric]:
    """Captures, mattes and uploads."""
    rows = {row.state: row for row in statistics.capture_counts(connection)}
    for name, column, text in (
        ("captures", "number", "Captures by state."),
        ("capture_bytes", "bytes", "Bytes of the uploaded archives of captures."),
    ):
        yield _gauge(name, text, ("state",), _of_each(get_args(captures.State), rows, column))
    found = statistics.matte_counts(connection)
    values = [((state,), found.get(state, 0)) for state in get_args(mattes.State)]
    yield _gauge("mattes", "Mattes by state.", ("state",), values)
    uploads = statistics.upload_counts(connection)
    yield _one("uploads", "Resumable uploads under way.", uploads.number)
    yield _one("upload_bytes", "Bytes that have been uploaded so far.", uploads.come)
    yield _one("upload_length_bytes", "Bytes that these uploads will have.", uploads.length)


def _of_the_cluster(connection: Connection) -> Iterator[Metric]:
    """The cluster as its coordinator last saw it."""
    heartbeat = leases.last_heartbeat(connection)
    yield _one("trouble", "1 if jobs can't progress; GET /v1/cluster says why.", bool(trouble_of(heartbeat)))
    cluster = (heartbeat or Heartbeat(None, 0, EMPTY_CLUSTER)).cluster
    workers = cluster["workers"]
    yield _one("workers", "Worker processes.", len(workers))
    yield _one("threads", "Threads of all workers.", sum(worker["threads"] for worker in workers))
    memory = sum(worker["memory_bytes"] for worker in workers)
    yield _one("workers_memory_bytes", "Memory of all workers.", memory)
    text = "Memory limit of all workers together; 0 if there is none."
    limits = sum(worker["memory_limit_bytes"] or 0 for worker in workers)
    yield _one("workers_memory_limit_bytes", text, limits)
    yield _one(
        "tiles_under_way", "Tiles and steps that the cluster is working on.", cluster.get("under_way", 0)
    )
    if heartbeat is not None:
        text = "Seconds since the last sign of life of a coordinator."
        yield _one("coordinator_last_sign_seconds", text, heartbeat.seconds)


def _of_each(keys: Iterable[str], rows: Mapping[str, Any], column: str) -> Labelled:
    """A column of the rows of some keys; 0 without a row: Prometheus does not see a counter begin with an event."""
    return [((key,), getattr(rows.get(key), column, 0)) for key in keys]


def _gauge(name: str, text: str, labels: tuple[str, ...], found: Labelled) -> Metric:
    return _filled(GaugeMetricFamily(f"envmatte_{name}", text, labels=labels), found)


def _counter(name: str, text: str, labels: tuple[str, ...], found: Labelled) -> Metric:
    return _filled(CounterMetricFamily(f"envmatte_{name}", text, labels=labels), found)


def _filled(family: Any, found: Labelled) -> Metric:
    for labels, value in found:
        family.add_metric(labels, value)
    metric: Metric = family
    return metric


def _one(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(f"envmatte_{name}", text, value=value)
