"""The app of the HTTP API, with the routes of all resources."""

from typing import Any

from fastapi import Depends, FastAPI
from sqlalchemy import Engine
from starlette.types import Message, Receive, Scope, Send

from services.api.captures import captures, creation, manifest_schema, reports, tus, uploads
from services.api.context import Context, authorized
from services.api.http import errors
from services.api.http.media_types import refuse_coded_body
from services.api.jobs import events, jobs
from services.api.mattes import archives, layers, links, live, mattes, transport
from services.api.mattes.composites import clips, composites
from services.api.programs import pattern_files, playback, programs
from services.api.system import cluster, health, limits, metrics, network, pages, qr_codes
from services.api.work import RequestShares, Shares
from services.decoding.pool import Decoders
from services.runtime import tracing
from services.settings import Settings
from storage.objects.store import Objects
from workflows.composite.cache import Cache

BACKDROPS = 16
"""Of the largest size, how many may be kept at once, half of them of one owner; smaller ones count by their size."""


class App(FastAPI):
    """A FastAPI app that answers HEAD wherever it answers GET, and whose OpenAPI document has capture.json's schema."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # Uploads have a HEAD of their own.
        if scope["type"] != "http" or scope["method"] != "HEAD" or scope["path"].startswith(tus.PATH):
            await super().__call__(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            # The body is left out (RFC 9110, sect. 9.3.2). A stream, which may have no end, then stops.
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body"})

        # Range is for GET alone (RFC 9110, sect. 14.2).
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]
        await super().__call__({**scope, "method": "GET", "headers": headers}, receive, send_head)

    def openapi(self) -> dict[str, Any]:
        document = super().openapi()
        document["components"]["schemas"].update(manifest_schema.components())
        return document


def build_app(settings: Settings, engine: Engine, objects: Objects) -> FastAPI:
    """Build the app. All that lasts is in the database and the store, so any number of apps may serve them.

    Each has a cache of mattes, decoders and owners' shares of its own: the bounds of memory in the settings are those
    of one app.
    """
    app = App(
        title="envmatte",
        version="1",
        description="Environment mattes of transparent objects, by compressive sensing.",
        responses=errors.RESPONSES,
        docs_url=None,
        redoc_url=None,
    )
    app.state.context = Context(
        settings,
        engine,
        objects,
        Cache(objects, settings.matte_memory),
        Decoders(settings.backdrop_bytes),
        RequestShares(
            memory=Shares(settings.request_memory, settings.request_memory // 2, "request_memory"),
            backdrops=Shares(BACKDROPS * settings.backdrop_bytes, BACKDROPS // 2 * settings.backdrop_bytes),
        ),
    )
    app.state.checks = health.checks(engine, objects)
    errors.register(app)
    app.add_middleware(tus.Protocol)
    app.add_middleware(tracing.TracingMiddleware)

    for router in (
        captures.router,
        creation.router,
        manifest_schema.router,
        reports.router,
        uploads.router,
        jobs.router,
        events.router,
        clips.router,
        mattes.router,
        composites.router,
        archives.router,
        layers.router,
        transport.router,
        live.router,
        links.router,
        programs.router,
        pattern_files.router,
        limits.router,
        playback.router,
        cluster.router,
        network.router,
    ):
        app.include_router(
            router, prefix="/v1", dependencies=[Depends(authorized), Depends(refuse_coded_body)]
        )
    app.include_router(pattern_files.page, prefix="/v1")
    app.include_router(qr_codes.page, prefix="/v1")
    app.include_router(links.page)
    app.include_router(health.router)
    app.include_router(metrics.router)
    app.include_router(pages.page)
    app.mount("/web/swagger", pages.Compressed(pages.Files(directory=pages.SWAGGER)))
    app.mount("/web", pages.Compressed(pages.MinifiedFiles(directory=pages.WEB)))
    return app
