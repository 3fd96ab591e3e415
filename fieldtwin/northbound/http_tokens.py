"""The tokens of a server of kind `http`."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.northbound.token_file import read_token
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig


def tokens_of(server: HttpServeConfig) -> tuple[str, str]:
    """Return the tokens of the roles view and operate, "" for one that the server does not have.

    Raises `FileInvalid` for an unusable file, and `UsageError` for equal tokens.
    """
    view = read_token(server.view_token) if server.view_token is not None else ""
    operate = read_token(server.operate_token) if server.operate_token is not None else ""
    if view and view == operate:
        raise UsageError(
            f"both tokens of the server {server.name!r} in `serve` are equal",
            expected="a different token for each role",
        )
    return view, operate
