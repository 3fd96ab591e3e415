"""The address of our end of a socket, as the peer sees it where nothing between the two translates addresses."""

from __future__ import annotations

import asyncio


def address_of(transport: asyncio.BaseTransport) -> str:
    """``HOST:PORT`` of this end; empty where the transport has no such address."""
    name = transport.get_extra_info("sockname")
    return f"{name[0]}:{name[1]}" if isinstance(name, tuple) and len(name) >= 2 else ""
