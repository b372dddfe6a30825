"""OpenTelemetry traces, from the request that asks for a job to each of its tiles.

A process traces, and imports OpenTelemetry, only if OTEL_EXPORTER_OTLP_ENDPOINT is set in its environment. The other
variables of the OpenTelemetry specification set the sampler, batches and so on. Spans are sent by a background thread,
and dropped if the collector does not accept them. A trace passes between processes as its ``traceparent``
(https://www.w3.org/TR/trace-context), in the ledger and with every tile.
"""

import atexit
import logging
import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from starlette.datastructures import Headers
from starlette.routing import compile_path
from starlette.types import ASGIApp, Message, Receive, Scope, Send

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.trace import Span, Tracer

logger = logging.getLogger(__name__)

ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
TRACEPARENT = re.compile("00-(?!0{32})[0-9a-f]{32}-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")
TRACED = {
    path: compile_path(path)[0]
    for path in ("/v1/captures", "/v1/jobs", "/v1/jobs/{id}/retry", "/v1/mattes/{id}/composite")
}
"""Paths where a POST makes or retries a job. A composite of a still makes no job, but takes long enough for a span."""

LAST = 2.0
"""Seconds that a process spends at exit on sending the remaining spans."""

_tracer: "Tracer | None" = None
_current: ContextVar[str | None] = ContextVar("traceparent", default=None)


def start(role: str) -> None:
    """Start tracing in this process, if its environment asks for it."""
    global _tracer
    if not any(os.environ.get(name) for name in ENDPOINTS):
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import OTELResourceDetector, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        logger.warning(
            "%s is set, but traces need another package: pip install 'envmatte[otel]'", ENDPOINTS[0]
        )
        return
    resource = Resource({"service.name": f"envmatte-{role}"}).merge(OTELResourceDetector().detect())
    provider, exporter = TracerProvider(resource=resource, shutdown_on_exit=False), OTLPSpanExporter()
    provider.add_span_processor(BatchSpanProcessor(exporter))
    ending = threading.Event()

    def cut_off() -> None:
        ending.wait()
        time.sleep(LAST)
        exporter.shutdown()  # type: ignore[no-untyped-call]

    def end() -> None:
        ending.set()
        provider.shutdown()

    threading.Thread(target=cut_off, name="last spans", daemon=True).start()
    atexit.register(end)
    _tracer = provider.get_tracer("envmatte")


@contextmanager
def span(name: str, parent: str | None, **attributes: str | int) -> Iterator["Span | None"]:
    """Trace what is done inside as a span.

    Parameters
    ----------
    parent : str, optional
        The ``traceparent`` that another process passed on; without one a new trace begins.
    **attributes
        Attributes of the span, with the prefix ``envmatte.``.
    """
    if _tracer is None:
        yield None
        return
    with _tracer.start_as_current_span(name, _context(parent), attributes=_named(attributes)) as made:
        yield made


def past_span(name: str, parent: str | None, begin: float, end: float, **attributes: str | int) -> None:
    """Add a span from one time to another, both in seconds since the epoch."""
    if _tracer is not None:
        began, ended = int(begin * 1e9), int(end * 1e9)
        _tracer.start_span(name, _context(parent), attributes=_named(attributes), start_time=began).end(ended)


def current_traceparent() -> str | None:
    """The ``traceparent`` for a job that the current request makes."""
    return _current.get()


class TracingMiddleware:
    """A request that makes a job continues the trace of its caller, or begins one."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        route = None
        if scope["type"] == "http" and scope["method"] == "POST":
            route = next((path for path, here in TRACED.items() if here.match(scope["path"])), None)
        if route is None:
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("traceparent", "")
        parent = given if TRACEPARENT.fullmatch(given) else None
        with span(f"POST {route}", parent) as made:

            async def send_and_record(message: Message) -> None:
                if made is not None and message["type"] == "http.response.start":
                    made.set_attribute("http.response.status_code", message["status"])
                await send(message)

            _current.set(parent if made is None else _traceparent())
            await self.app(scope, receive, send_and_record)


def _named(attributes: dict[str, str | int]) -> dict[str, Any]:
    return {f"envmatte.{name}": value for name, value in attributes.items()}


def _context(parent: str | None) -> "Context":
    from opentelemetry.context import Context
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    return TraceContextTextMapPropagator().extract({"traceparent": parent or ""}, Context())


def _traceparent() -> str | None:
    """The ``traceparent`` of the current span."""
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent")
