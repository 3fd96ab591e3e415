"""Errors of fieldtwin as HTTP answers."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from fieldtwin.gateway.core.control import RemoteError
from fieldtwin.gateway.core.errors import (
    Bug,
    CheckFailed,
    DeviceRefused,
    EndpointBusy,
    FieldtwinError,
    NotAllowed,
    OutOfLimits,
    Unreachable,
    UsageError,
    WireError,
)
from fieldtwin.studio.live.gallery import NoInstance
from fieldtwin.studio.replay.traces import NoTrace


class NotFound(UsageError):
    """Raised when a request names an object (a tag, frame or scenario, for example) that does not exist."""


STATUS: tuple[tuple[type[FieldtwinError], int], ...] = (
    (NotFound, 404),
    (NoInstance, 404),
    (NoTrace, 404),
    (CheckFailed, 409),
    (NotAllowed, 403),
    (OutOfLimits, 403),  # named, because the error of another process has only its class's name
    (UsageError, 400),
    (EndpointBusy, 503),
    (Unreachable, 503),
    (WireError, 504),
    (DeviceRefused, 502),
)
"""HTTP status by class of error; the first class that matches counts. All other errors give 422, and a bug gives 500."""

_BY_NAME = {kind.__name__: status for kind, status in STATUS}


def status_of(error: FieldtwinError) -> int:
    """Return the HTTP status of an error."""
    if isinstance(error, RemoteError):
        return _BY_NAME.get(error.kind, 400 if error.remote_exit_code == UsageError.exit_code else 502)
    if isinstance(error, Bug):
        return 500
    return next((status for kind, status in STATUS if isinstance(error, kind)), 422)


def described(error: FieldtwinError) -> dict[str, object]:
    """Return an error as data for JSON."""
    kind = error.kind if isinstance(error, RemoteError) else type(error).__name__
    return {"error": {"kind": kind, "message": str(error)}}


async def on_error(request: Request, error: Exception) -> Response:
    """Answer a request that raised an error of fieldtwin."""
    assert isinstance(error, FieldtwinError)
    return JSONResponse(described(error), status_of(error))
