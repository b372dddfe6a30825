"""Metrics, cluster status, logs and traces of real jobs."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse

from services.api.jobs.wait_reason import SILENCE
from services.client import ServiceError
from tests.end_to_end.conftest import Service, paused, serving
from tests.parts.waiting import until
from tests.services.runtime.collector import Collector, collecting
from tests.workflows.composite.video.test_steps import clip, pictures
from workflows.untrusted import confinement

pytestmark = pytest.mark.slow

CALLER = "00-0123456789abcdef0123456789abcdef-0123456789abcdef-01"


@dataclass
class Watched:
    """A service that has run some jobs, with their ids and traces."""

    service: Service
    collector: Collector
    ingest: str
    recover: str
    composite: str
    failed: str
    cancelled: str

    def lines(self) -> list[dict[str, Any]]:
        log = self.service.data.parent / f"{self.service.data.name}.log"
        return [json.loads(line) for line in log.read_text().splitlines()]


@pytest.fixture(scope="module")
def watched(capture_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    data = tmp_path_factory.mktemp("watched") / "data"
    with (
        collecting() as collector,
        serving(
            data,
            "--workers",
            "1",
            ENVMATTE_LOG="json",
            ENVMATTE_LOG_LEVEL="DEBUG",
            OTEL_EXPORTER_OTLP_ENDPOINT=collector.url,
            OTEL_BSP_SCHEDULE_DELAY="200",
        ) as service,
    ):
        uploaded = service.client.upload(capture_archive)
        service.client.wait(uploaded["job"])
        recovered = service.http.post(
            "/v1/jobs", json={"capture": uploaded["id"]}, headers={"traceparent": CALLER}
        ).json()
        service.client.wait(recovered["id"])
        composed = service.http.post(
            f"/v1/mattes/{recovered['matte']}/composite",
            content=clip(pictures(70), list(range(70))),
            headers={"Content-Type": "video/mp4", "traceparent": CALLER},
        ).json()
        service.client.wait(composed["id"])
        failing = _without_frames(service, uploaded["id"])
        with paused(service):
            cancelled = service.client.recover(uploaded["id"])["id"]
            service.client.cancel(cancelled)
        yield Watched(
            service, collector, uploaded["job"], recovered["id"], composed["id"], failing, cancelled
        )


def _without_frames(service: Service, capture: str) -> str:
    """Run a job that fails because its capture is moved away."""
    frames = service.data / "store" / "captures" / capture
    away = service.data / "away"
    frames.rename(away)
    job = str(service.client.recover(capture)["id"])
    with pytest.raises(ServiceError):
        service.client.wait(job)
    away.rename(frames)
    return job


def _figures(text: str) -> dict[tuple[str, ...], float]:
    return {
        (sample.name, *(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in parse(text)
        for sample in family.samples
    }


def test_metrics_count_the_jobs(watched: Watched) -> None:
    answer = watched.service.http.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    found = _figures(answer.text)
    http = watched.service.http
    ingest, recover = (http.get(f"/v1/jobs/{job}").json() for job in (watched.ingest, watched.recover))
    assert found["envmatte_jobs", "ingest", "succeeded"] == 1
    for state, number in {"succeeded": 1, "failed": 1, "cancelled": 1, "queued": 0, "running": 0}.items():
        assert found["envmatte_jobs", "recover", state] == number
    assert found["envmatte_tiles", "recover", "queued"] == 0
    assert found["envmatte_tile_seconds_count", "recover"] >= recover["tiles"]["total"]
    assert found["envmatte_tile_seconds_sum", "recover"] > 0
    assert found["envmatte_pixels_total", "ingest"] == ingest["pixels"]
    assert found["envmatte_captures", "ready"] == 1
    assert found["envmatte_capture_bytes", "ready"] == http.get("/v1/captures").json()["captures"][0]["bytes"]
    assert found[("envmatte_uploads",)] == 0
    assert (found[("envmatte_workers",)], found[("envmatte_threads",)]) == (1, 1)
    assert found[("envmatte_workers_memory_bytes",)] > 0
    assert found[("envmatte_trouble",)] == 0
    assert found[("envmatte_coordinator_last_sign_seconds",)] < SILENCE


def test_openmetrics_are_sent_on_request(watched: Watched) -> None:
    headers = {"accept": "application/openmetrics-text; version=1.0.0"}
    answer = watched.service.http.get("/metrics", headers=headers)
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    assert "envmatte_jobs" in {family.name for family in parse_openmetrics(answer.text)}


def test_metrics_count_uploads_and_queued_tiles(watched: Watched) -> None:
    http = watched.service.http
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "1000"}
    headers |= {"Content-Type": "application/offset+octet-stream"}
    where = http.post("/v1/uploads", headers=headers, content=b"x" * 100).headers["Location"]
    found = _figures(http.get("/metrics").text)
    assert [found[(f"envmatte_upload{name}",)] for name in ("s", "_bytes", "_length_bytes")] == [1, 100, 1000]
    http.delete(where, headers={"Tus-Resumable": "1.0.0"})
    assert _figures(http.get("/metrics").text)[("envmatte_uploads",)] == 0


def test_cluster_status_names_workers_coordinator_and_queue(watched: Watched) -> None:
    http = watched.service.http
    until(lambda: http.get("/v1/cluster").json()["queue"]["tiles_under_way"] == 0)
    found = http.get("/v1/cluster").json()
    (worker,) = found["workers"]
    assert worker["address"].startswith("tls://127.0.0.1:")
    assert 0 < worker["memory_bytes"] < worker["memory_limit_bytes"] == found["memory_limit_bytes"]
    assert found["threads"] == 1
    assert found["unconfined_decoders"] == worker["unconfined_decoders"] == confinement.missing()
    assert found["problem"] is None
    assert found["coordinator"]["holder"].endswith(f":{watched.service.process.pid}")
    assert found["coordinator"]["last_sign_seconds"] < 15
    queue = {"jobs_queued": 0, "jobs_running": 0, "tiles_to_do": 0, "tiles_under_way": 0}
    assert found["queue"] == queue | {"tiles_per_second": None}


def test_every_log_line_is_a_json_object_with_a_time(watched: Watched) -> None:
    lines = watched.lines()
    assert {line["process"] for line in lines} == {"service", "worker"}
    for line in lines:
        assert line.keys() >= {"time", "level", "logger", "message", "pid"}
        assert datetime.fromisoformat(line["time"]).utcoffset() is not None


def test_log_lines_name_job_and_tile(watched: Watched) -> None:
    total = watched.service.client.job(watched.recover)["tiles"]["total"]
    lines = [line for line in watched.lines() if line.get("job") == watched.recover]
    done = [line for line in lines if line["process"] == "worker" and line["message"].startswith("done in")]
    assert {line["tile"] for line in done if "tile" in line} == set(range(total))
    assert {line["step"] for line in done if "step" in line} == {"preparing", "finishing"}
    assert any(line["process"] == "service" and line["message"] == "succeeded" for line in lines)


def test_failed_tile_is_logged_with_its_traceback(watched: Watched) -> None:
    lines = [line for line in watched.lines() if line.get("job") == watched.failed]
    raised = [line for line in lines if "exception" in line]
    assert raised
    for line in raised:
        assert (line["process"], line["level"] in ("WARNING", "ERROR")) == ("worker", True)
        assert "Traceback" in line["exception"]
        assert "tile" in line or "step" in line
    assert any(line["process"] == "service" and line["level"] == "WARNING" for line in lines)


@pytest.mark.parametrize(
    ("kind", "asked_by"), [("recover", "POST /v1/jobs"), ("composite", "POST /v1/mattes/{id}/composite")]
)
def test_trace_links_the_request_to_every_tile(watched: Watched, kind: str, asked_by: str) -> None:
    collector, job = watched.collector, getattr(watched, kind)
    until(lambda: any(s.name == f"{kind} finish" for s in _of(collector, job)))
    total = watched.service.client.job(job)["tiles"]["total"]
    assert total > 1
    spans = _of(collector, job)
    _, trace, caller, _ = CALLER.split("-")
    (request,) = [s for s in collector.spans if s.name == asked_by and s.trace.hex() == trace]
    assert (request.parent.hex(), request.service) == (caller, "envmatte-service")
    assert request.attributes["http.response.status_code"] == 202
    assert all((s.trace, s.parent) == (request.trace, request.id) for s in spans)
    tiles = [s for s in spans if s.name == f"{kind} tile"]
    assert {s.attributes["envmatte.tile"] for s in tiles} == set(range(total))
    assert {(s.service, s.attributes["envmatte.kind"]) for s in tiles} == {("envmatte-worker", kind)}
    (queue,), (prepare,) = ([s for s in spans if s.name == name] for name in ("queue", f"{kind} prepare"))
    assert request.begin <= queue.begin <= queue.end <= prepare.begin


def test_request_without_traceparent_starts_a_trace(watched: Watched) -> None:
    until(lambda: any(s.name == "ingest finish" for s in _of(watched.collector, watched.ingest)))
    spans = _of(watched.collector, watched.ingest)
    (request,) = [s for s in watched.collector.spans if s.name == "POST /v1/captures"]
    assert request.parent == b""
    assert {s.name for s in spans} == {"queue", "ingest prepare", "ingest tile", "ingest finish"}
    assert {s.parent for s in spans} == {request.id}


def test_trace_shows_failures(watched: Watched) -> None:
    until(lambda: any(span.failed for span in _of(watched.collector, watched.failed)))
    assert not any(span.failed for span in _of(watched.collector, watched.recover))


def _of(collector: Collector, job: str) -> list[Any]:
    return [span for span in list(collector.spans) if span.attributes.get("envmatte.job") == job]
