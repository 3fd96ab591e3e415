"""The application of a server of kind `http`: the operations of Studio's interface that concern one run."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from starlette.applications import Starlette

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.northbound.http_tokens import tokens_of
from fieldtwin.studio.access import VIEW, Access, allowed_hosts
from fieldtwin.studio.alarms import api as alarms
from fieldtwin.studio.api import faults, frames, instances, plc, tags
from fieldtwin.studio.api_application import api_application
from fieldtwin.studio.live.gallery import Gallery
from fieldtwin.studio.scenarios.recordings import Recordings
from fieldtwin.studio.variables import api as variables
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig

OPERATIONS = (
    *instances.OBSERVING,
    *tags.OPERATIONS,
    *frames.OPERATIONS,
    *plc.OPERATIONS,
    *faults.OPERATIONS,
    *alarms.OPERATIONS,
    *variables.OPERATIONS,
)
TITLE = "fieldtwin run"


def access_to(server: HttpServeConfig, port: int) -> Access:
    """Return the rules of access to a server that listens at a port. Raises as `tokens_of`.

    Without a token every client has the role view: other users of this computer can connect to a loopback address as well.
    """
    view, operate = tokens_of(server)
    return Access(allowed_hosts(server.host, server.names, port), operate, view, open_role=VIEW)


def run_application(access: Access, clock: Clock, instance: str, server: str) -> Starlette:
    """Return the application that serves `instance` only. `server` is the name of the server in the system file."""

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        async with Gallery(clock, only=instance) as gallery, Recordings() as recordings:
            app.state.gallery, app.state.recordings = gallery, recordings
            yield

    return api_application(access, clock, OPERATIONS, lifespan, title=TITLE, audited_as=f"http {server}")
