"""The HTTP API: `build_app`, and one file a resource."""

from fastapi import Depends, FastAPI
from sqlalchemy import Engine

from services import tracing
from services.api import (
    archives,
    captures,
    clips,
    cluster,
    composites,
    errors,
    events,
    jobs,
    layers,
    limits,
    live,
    mattes,
    metrics,
    network,
    programs,
    reports,
    showings,
    system,
    tus,
    uploads,
    web,
)
from services.api.context import WEB, Context, authorized
from services.api.errors import PROBLEM
from services.decoding import Decoders
from services.settings import Settings
from storage.objects import Objects
from workflows.composite.cache import Cache


def build_app(settings: Settings, engine: Engine, objects: Objects) -> FastAPI:
    """Build the app: it holds no state of its own, so any number of them may serve one database and store."""
    app = FastAPI(
        title="envmatte",
        version="1",
        description="Environment mattes of transparent objects, by compressive sensing.",
        responses=PROBLEM,
        docs_url=None,
        redoc_url=None,
    )
    app.state.context = Context(
        settings,
        engine,
        objects,
        Cache(objects, settings.matte_memory),
        Decoders(settings.backdrop_bytes),
    )
    errors.register(app)
    app.add_middleware(tus.Protocol)
    app.add_middleware(tracing.Requests)

    for router in (
        captures.router,
        reports.router,
        uploads.router,
        jobs.router,
        events.router,
        clips.router,
        mattes.router,
        composites.router,
        archives.router,
        layers.router,
        live.router,
        programs.router,
        limits.router,
        showings.router,
        cluster.router,
        network.router,
    ):
        app.include_router(router, prefix="/v1", dependencies=[Depends(authorized)])
    app.include_router(programs.page, prefix="/v1")
    app.include_router(system.router)
    app.include_router(metrics.router)
    app.include_router(web.page)
    app.mount("/web/swagger", web.Files(directory=web.SWAGGER))
    app.mount("/web", web.Files(directory=WEB))
    return app
