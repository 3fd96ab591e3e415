"""The local address of a socket. Without address translation (NAT) in between, the peer sees the same address."""

from __future__ import annotations

import asyncio


def address_of(transport: asyncio.BaseTransport) -> str:
    """Return the local ``HOST:PORT`` of a socket, or an empty text if the transport has no such address."""
    name = transport.get_extra_info("sockname")
    return f"{name[0]}:{name[1]}" if isinstance(name, tuple) and len(name) >= 2 else ""
