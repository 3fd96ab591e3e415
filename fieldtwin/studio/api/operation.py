"""An operation of the interface: its path, who may call it, and its description for OpenAPI."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from fieldtwin.gateway.core.errors import NotAllowed, UsageError
from fieldtwin.studio.access import OPERATE

PREFIX = "/api/v1"
MOST_BODY_BYTES = 1 << 20

_encoder = msgspec.json.Encoder()
Handler = Callable[[Request], Awaitable[Any]]
S = TypeVar("S", bound=msgspec.Struct)


@dataclass(frozen=True)
class Parameter:
    """A parameter of the query, with its type for OpenAPI: string, integer or boolean."""

    name: str
    kind: str
    text: str


@dataclass(frozen=True)
class Operation:
    """An operation of the interface. `path` begins after /api/v1. `body` is the form of a request with content. `changes`: the
    role operate is required.

    `handler` returns data for JSON, or a complete response.
    """

    method: str
    path: str
    handler: Handler
    summary: str
    parameters: tuple[Parameter, ...] = ()
    body: type[msgspec.Struct] | None = None
    changes: bool = False

    async def __call__(self, request: Request) -> Response:
        """Check the role, call the handler, and encode its result."""
        if self.changes and request.scope["role"] != OPERATE:
            raise NotAllowed("this needs the role operate", got=f"the role {request.scope['role']}")
        result = await self.handler(request)
        return (
            result if isinstance(result, Response) else Response(_encoder.encode(result), media_type="application/json")
        )


async def body_of(request: Request, form: type[S]) -> S:
    """Return the content of a request. Raises `UsageError` if it is too long, not JSON, or not of this form."""
    content = bytearray()
    async for piece in request.stream():
        content += piece
        if len(content) > MOST_BODY_BYTES:
            raise UsageError("the content of the request is too long", expected=f"at most {MOST_BODY_BYTES} bytes")
    try:
        return msgspec.json.decode(bytes(content), type=form)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as e:
        raise UsageError(f"the content of the request: {e}") from e


def whole(request: Request, name: str, default: int, least: int = 0, most: int = 1 << 62) -> int:
    """Return an integer parameter of the query, from `least` to `most`. Raises `UsageError`."""
    text = request.query_params.get(name)
    if text is None:
        return default
    try:
        number = int(text)
    except ValueError as e:
        raise UsageError(f"the parameter {name}", expected="a whole number", got=repr(text[:40])) from e
    if not least <= number <= most:
        raise UsageError(f"the parameter {name}", expected=f"{least} to {most}", got=str(number))
    return number


def yes(request: Request, name: str) -> bool:
    """Return a boolean parameter of the query; it is false if it is missing. Raises `UsageError`."""
    text = request.query_params.get(name, "false").lower()
    if text not in ("true", "false", "1", "0"):
        raise UsageError(f"the parameter {name}", expected="true or false", got=repr(text[:40]))
    return text in ("true", "1")
