"""Traces: off by default; from request to tile when on; and never in the way of the work."""

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import Engine

from services.api.app import build_app
from services.runtime.tracing import TRACED, TRACEPARENT
from services.settings import Settings
from storage.database.engine import reading, writing
from storage.objects.store import Objects
from storage.records import jobs, mattes
from tests.services.runtime.collector import Collector, collecting

CALLER = "00-0123456789abcdef0123456789abcdef-0123456789abcdef-01"
REQUEST = f"""
    import asyncio, sys
    from services.runtime import tracing
    tracing.start("service")
    traceparents = []

    async def app(scope, receive, send):
        traceparents.append(tracing.current_traceparent())
        await send({{"type": "http.response.start", "status": 201, "headers": []}})

    async def send(message): pass

    async def request(**scope):
        scope = {{"type": "http", "method": "POST", "path": "/v1/jobs", "headers": []}} | scope
        await asyncio.create_task(tracing.TracingMiddleware(app)(scope, None, send))

    async def main():
        await request(headers=[(b"traceparent", b"{CALLER}")])
        await request(headers=[(b"traceparent", b"00-nonsense")])
        await request(method="GET")
        await request(path="/v1/captures")
        await request(path="/v1/jobs/a-job/cancel")
        await request(path="/v1/jobs/a-job/retry/")
        await request(path="/v1/jobs/a-job/retry")
        await request(path="/v1/mattes/a-matte/composite", headers=[(b"traceparent", b"{CALLER}")])
        await request(path="/v1/mattes/a-matte/composite", method="GET")

    asyncio.run(main())
"""


def run(script: str, **environment: str) -> str:
    """What a script prints, in a new process: tracing is set up once per process."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(script)],
        env=clean | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_opentelemetry_is_not_imported_without_an_endpoint() -> None:
    script = REQUEST + "    print(traceparents, [name for name in sys.modules if 'opentelemetry' in name])"
    # The caller's trace is passed on all the same: workers may trace.
    assert run(script) == f"{[CALLER, *[None] * 6, CALLER, None]} []\n"


def test_requests_that_make_jobs_are_spans_in_the_callers_trace() -> None:
    with collecting() as collector:
        printed = run(REQUEST + "    print(*traceparents)", OTEL_EXPORTER_OTLP_ENDPOINT=collector.url).split()
    first, *others, last = collector.spans
    names = ["/v1/jobs", "/v1/jobs", "/v1/captures", "/v1/jobs/{id}/retry", "/v1/mattes/{id}/composite"]
    assert [span.name for span in collector.spans] == [f"POST {name}" for name in names]
    for span in (first, last):
        assert f"00-{span.trace.hex()}-{span.parent.hex()}-01" == CALLER
    assert {span.parent for span in others} == {b""}
    expected = [f"00-{span.trace.hex()}-{span.id.hex()}" for span in collector.spans]
    assert [one[:52] for one in printed] == [
        *expected[:2],
        "None",
        expected[2],
        "None",
        "None",
        *expected[3:],
        "None",
    ]
    assert {span.attributes["http.response.status_code"] for span in collector.spans} == {201}


def test_every_request_that_makes_a_job_is_traced(engine: Engine, objects: Objects, tmp_path: Path) -> None:
    app = build_app(Settings(data=tmp_path), engine, objects)
    posts = {path: item["post"] for path, item in app.openapi()["paths"].items() if "post" in item}
    queued = {path for path, post in posts.items() if "202" in post["responses"]}
    assert TRACED.keys() == queued | {"/v1/captures"}


def test_a_retried_job_continues_in_the_trace_of_the_retry(
    engine: Engine, objects: Objects, tmp_path: Path
) -> None:
    client = TestClient(build_app(Settings(data=tmp_path), engine, objects), "http://localhost")
    again = CALLER.replace("0123", "4567")
    with writing(engine) as c:
        mattes.add_imported(c, "m", {}, {})
        job = jobs.add(c, "composite", "", {}, "m", trace=CALLER)
    for sent in (again, None):  # a retry without a trace keeps the one before
        with writing(engine) as c:
            jobs.end(c, job, "failed", {"detail": "", "status": 500})
        headers = {} if sent is None else {"traceparent": sent}
        assert client.post(f"/v1/jobs/{job}/retry", headers=headers).status_code == 202
        with reading(engine) as c:
            assert jobs.get(c, job).trace == again


def spans(collector: Collector, parent: str | None = None, **environment: str) -> list[str]:
    run(
        f"""
        from services.runtime import tracing
        tracing.start("worker")
        for tile in range(20):
            with tracing.span("recover tile", {parent!r}, job="a-job", tile=tile):
                pass
        """,
        OTEL_EXPORTER_OTLP_ENDPOINT=collector.url,
        **environment,
    )
    return [span.service for span in collector.spans]


def test_a_sampler_is_honoured() -> None:
    with collecting() as collector:
        assert spans(collector, OTEL_TRACES_SAMPLER="always_off") == []
        assert spans(collector, CALLER[:-1] + "0") == []  # the caller does not sample this trace
        assert spans(collector, OTEL_SERVICE_NAME="ours") == ["ours"] * 20


@pytest.mark.slow
def test_an_unreachable_collector_does_not_slow_the_work() -> None:
    printed = run(
        f"""
        from services.runtime import tracing
        tracing.start("worker")
        for tile in range(5000):
            with tracing.span("recover tile", {CALLER!r}, tile=tile):
                pass
        print("done")
        """,
        OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:9",
    )
    assert printed == "done\n"


@pytest.mark.parametrize(
    "wrong", ["", "00-0123", CALLER.upper(), CALLER + "0", CALLER.replace("0123456789abcdef", "0" * 16)]
)
def test_malformed_traceparents_are_ignored(wrong: str) -> None:
    assert not TRACEPARENT.fullmatch(wrong)
    assert TRACEPARENT.fullmatch(CALLER)


def test_past_span_has_the_given_times() -> None:
    begin = time.time() - 5
    with collecting() as collector:
        run(
            f"""
            from services.runtime import tracing
            tracing.start("service")
            tracing.past_span("queue", {CALLER!r}, {begin!r}, {begin + 2!r}, job="a-job")
            """,
            OTEL_EXPORTER_OTLP_ENDPOINT=collector.url,
        )
    (span,) = collector.spans
    assert (span.name, span.attributes) == ("queue", {"envmatte.job": "a-job"})
    assert (span.begin, span.end) == (pytest.approx(begin), pytest.approx(begin + 2))
