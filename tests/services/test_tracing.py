"""Traces: none unless they are asked for; then from the request on, and never in the way of the work."""

import os
import subprocess
import sys
import textwrap
import time

import pytest

from services.tracing import TRACEPARENT
from tests.services.collector import Collector, collecting

CALLER = "00-0123456789abcdef0123456789abcdef-0123456789abcdef-01"
REQUEST = f"""
    import asyncio, sys
    from services import tracing
    tracing.start("service")
    asked = []

    async def app(scope, receive, send):
        asked.append(tracing.asked_by())
        await send({{"type": "http.response.start", "status": 201, "headers": []}})

    async def send(message): pass

    async def request(**scope):
        scope = {{"type": "http", "method": "POST", "path": "/v1/jobs", "headers": []}} | scope
        await asyncio.create_task(tracing.Requests(app)(scope, None, send))

    async def main():
        await request(headers=[(b"traceparent", b"{CALLER}")])
        await request(headers=[(b"traceparent", b"00-nonsense")])
        await request(method="GET")
        await request(path="/v1/captures")

    asyncio.run(main())
"""


def run(script: str, **environment: str) -> str:
    """What a script prints, in a process of its own: traces are set up once in each."""
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


def test_nothing_is_imported_unless_it_is_asked_for() -> None:
    script = REQUEST + "    print(asked, [name for name in sys.modules if 'opentelemetry' in name])"
    # The trace of a caller goes on all the same: workers may be asked for theirs.
    assert run(script) == f"{[CALLER, None, None, None]} []\n"


def test_requests_that_make_jobs_are_spans_of_their_callers_traces() -> None:
    with collecting() as collector:
        printed = run(REQUEST + "    print(*asked)", OTEL_EXPORTER_OTLP_ENDPOINT=collector.url).split()
    first, second, third = collector.spans
    assert [span.name for span in collector.spans] == ["POST /v1/jobs"] * 2 + ["POST /v1/captures"]
    assert f"00-{first.trace.hex()}-{first.parent.hex()}-01" == CALLER
    assert second.parent == third.parent == b""
    said = [f"00-{span.trace.hex()}-{span.id.hex()}" for span in collector.spans]
    assert [one[:52] for one in printed] == [*said[:2], "None", said[2]]
    assert {span.attributes["http.response.status_code"] for span in collector.spans} == {201}


def spans(collector: Collector, parent: str | None = None, **environment: str) -> list[str]:
    run(
        f"""
        from services import tracing
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
        assert spans(collector, CALLER[:-1] + "0") == []  # whoever began the trace does not keep it
        assert spans(collector, OTEL_SERVICE_NAME="ours") == ["ours"] * 20


def test_a_collector_that_is_gone_holds_nothing_up() -> None:
    printed = run(
        f"""
        from services import tracing
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
def test_what_is_no_traceparent_is_passed_over(wrong: str) -> None:
    assert not TRACEPARENT.fullmatch(wrong)
    assert TRACEPARENT.fullmatch(CALLER)


def test_time_waited_is_a_span() -> None:
    begin = time.time() - 5
    with collecting() as collector:
        run(
            f"""
            from services import tracing
            tracing.start("service")
            tracing.waited("queue", {CALLER!r}, {begin!r}, {begin + 2!r}, job="a-job")
            """,
            OTEL_EXPORTER_OTLP_ENDPOINT=collector.url,
        )
    (span,) = collector.spans
    assert (span.name, span.attributes) == ("queue", {"envmatte.job": "a-job"})
    assert (span.begin, span.end) == (pytest.approx(begin), pytest.approx(begin + 2))
