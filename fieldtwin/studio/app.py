"""The web application: the interface, the pages, and who may use them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import Bug, FieldtwinError
from fieldtwin.studio.access import Access, AccessMiddleware
from fieldtwin.studio.api import commissioning, faults, frames, instances, plc, scenarios, tags, traces, twin
from fieldtwin.studio.api.common import INSTANCE
from fieldtwin.studio.api.errors import on_error
from fieldtwin.studio.api.openapi import describe
from fieldtwin.studio.api.operation import PREFIX, Operation
from fieldtwin.studio.api.stream import stream
from fieldtwin.studio.commissioning.jobs import Jobs
from fieldtwin.studio.commissioning.work_folder import WorkFolder
from fieldtwin.studio.live.gallery import Gallery
from fieldtwin.studio.live.launching import Launcher
from fieldtwin.studio.replay.traces import Traces
from fieldtwin.studio.scenarios.recordings import Recordings
from fieldtwin.studio.scenarios.runner import ScenarioRunner
from fieldtwin.studio.twin.forecast import Forecaster

STATIC = Path(__file__).parent / "static"
OPERATIONS: tuple[Operation, ...] = (
    *instances.OPERATIONS,
    *tags.OPERATIONS,
    *frames.OPERATIONS,
    *plc.OPERATIONS,
    *faults.OPERATIONS,
    *scenarios.OPERATIONS,
    *traces.OPERATIONS,
    *commissioning.OPERATIONS,
    *twin.OPERATIONS,
)


def application(access: Access, clock: Clock, folder: Path, known: Traces | None = None) -> Starlette:
    """Return the application for one server. `folder` is searched for systems that can be started, and for traces unless `known`
    gives the traces to show.
    """

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        async with (
            Launcher() as launcher,
            Gallery(clock) as gallery,
            Recordings() as recordings,
            ScenarioRunner() as runner,
            known or Traces(folder) as shown,
            Forecaster() as forecaster,
            Jobs(WorkFolder(folder)) as jobs,
        ):
            app.state.launcher, app.state.gallery, app.state.folder = launcher, gallery, folder
            app.state.recordings, app.state.runner, app.state.jobs = recordings, runner, jobs
            app.state.traces = shown
            app.state.forecaster = forecaster
            yield

    return Starlette(
        routes=_routes(),
        middleware=[Middleware(AccessMiddleware, access=access, now_s=lambda: clock.monotonic_ns() / 1e9)],
        exception_handlers={FieldtwinError: on_error, 404: _not_found},
        lifespan=lifespan,
    )


def _routes() -> list[BaseRoute]:
    by_path: dict[str, dict[str, Operation]] = {}
    for operation in OPERATIONS:
        by_path.setdefault(PREFIX + operation.path, {})[operation.method] = operation
    api: list[BaseRoute] = [
        Route(path, _dispatch(operations), methods=list(operations)) for path, operations in by_path.items()
    ]
    return [
        *api,
        WebSocketRoute(f"{PREFIX}{INSTANCE}/stream", stream),
        WebSocketRoute(f"{PREFIX}{commissioning.GUIDE}/stream", commissioning.stream_jobs),
        Route(f"{PREFIX}/openapi.json", _openapi),
        Mount("/static", StaticFiles(directory=STATIC)),
        Route("/", _page),
    ]


def _dispatch(operations: dict[str, Operation]) -> Any:
    async def handle(request: Request) -> Response:
        try:
            return await operations["GET" if request.method == "HEAD" else request.method](request)
        except FieldtwinError:
            raise
        except Exception as e:  # a bug in one operation must not end the others, and the user sees no traceback
            raise Bug(f"{request.method} {request.url.path}: {type(e).__name__}: {e}") from e

    return handle


async def _page(request: Request) -> Response:
    return FileResponse(STATIC / "index.html", media_type="text/html; charset=utf-8")


async def _openapi(request: Request) -> Response:
    return JSONResponse(describe(OPERATIONS))


async def _not_found(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": {"kind": "NotFound", "message": f"nothing at {request.url.path}"}}, 404)
