"""The web application around a list of operations: routes, access, errors, and the OpenAPI description."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import Bug, FieldtwinError
from fieldtwin.studio.access import Access, AccessMiddleware
from fieldtwin.studio.api.common import INSTANCE
from fieldtwin.studio.api.errors import on_error
from fieldtwin.studio.api.openapi import describe
from fieldtwin.studio.api.operation import PREFIX, Operation
from fieldtwin.studio.api.stream import stream

Lifespan = Callable[[Starlette], AbstractAsyncContextManager[None]]


def api_application(
    access: Access,
    clock: Clock,
    operations: Iterable[Operation],
    lifespan: Lifespan,
    *,
    title: str,
    audited_as: str,
    routes: Sequence[BaseRoute] = (),
) -> Starlette:
    """Return an application with the operations, the updates of instances, the OpenAPI description, and further `routes`.

    `lifespan` puts the parts that the handlers use into the state of the application. Audit logs record clients as
    `audited_as` with their address.
    """
    operations = tuple(operations)
    app = Starlette(
        routes=[*_routes(operations, title), *routes],
        middleware=[Middleware(AccessMiddleware, access=access, now_s=lambda: clock.monotonic_ns() / 1e9)],
        exception_handlers={FieldtwinError: on_error, 404: _not_found},
        lifespan=lifespan,
    )
    app.state.audited_as = audited_as
    return app


def _routes(operations: tuple[Operation, ...], title: str) -> list[BaseRoute]:
    by_path: dict[str, dict[str, Operation]] = {}
    for operation in operations:
        by_path.setdefault(PREFIX + operation.path, {})[operation.method] = operation

    async def openapi(request: Request) -> Response:
        return JSONResponse(describe(operations, title))

    return [
        *(Route(path, _dispatch(each), methods=list(each)) for path, each in by_path.items()),
        WebSocketRoute(f"{PREFIX}{INSTANCE}/stream", stream),
        Route(f"{PREFIX}/openapi.json", openapi),
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


async def _not_found(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": {"kind": "NotFound", "message": f"nothing at {request.url.path}"}}, 404)
