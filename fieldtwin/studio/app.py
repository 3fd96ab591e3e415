"""The web application: the interface, the pages, and who may use them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.studio.access import Access
from fieldtwin.studio.alarms import api as alarms
from fieldtwin.studio.api import commissioning, faults, frames, instances, plc, scenarios, tags, traces, twin
from fieldtwin.studio.api.operation import PREFIX, Operation
from fieldtwin.studio.api_application import api_application
from fieldtwin.studio.campaigns import api as campaigns
from fieldtwin.studio.campaigns.ledgers import Ledgers
from fieldtwin.studio.commissioning.jobs import Jobs
from fieldtwin.studio.commissioning.work_folder import WorkFolder
from fieldtwin.studio.live.gallery import Gallery
from fieldtwin.studio.live.launching import Launcher
from fieldtwin.studio.replay.traces import Traces
from fieldtwin.studio.scenarios.recordings import Recordings
from fieldtwin.studio.scenarios.runner import ScenarioRunner
from fieldtwin.studio.twin.forecast import Forecaster
from fieldtwin.studio.variables import api as variables

STATIC = Path(__file__).parent / "static"
OPERATIONS: tuple[Operation, ...] = (
    *instances.OBSERVING,
    *instances.LAUNCHING,
    *tags.OPERATIONS,
    *frames.OPERATIONS,
    *plc.OPERATIONS,
    *faults.OPERATIONS,
    *alarms.OPERATIONS,
    *variables.OPERATIONS,
    *scenarios.OPERATIONS,
    *traces.OPERATIONS,
    *campaigns.OPERATIONS,
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
            app.state.ledgers = Ledgers(folder, clock)
            app.state.forecaster = forecaster
            yield

    return api_application(
        access,
        clock,
        OPERATIONS,
        lifespan,
        title="fieldtwin Studio",
        audited_as="studio",
        routes=[
            WebSocketRoute(f"{PREFIX}{commissioning.GUIDE}/stream", commissioning.stream_jobs),
            Mount("/static", StaticFiles(directory=STATIC)),
            Route("/", _page),
        ],
    )


async def _page(request: Request) -> Response:
    return FileResponse(STATIC / "index.html", media_type="text/html; charset=utf-8")
