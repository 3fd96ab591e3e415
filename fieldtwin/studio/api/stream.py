"""Updates over a WebSocket: the present state first, then each change.

A client that reads too slowly loses updates, and a message gives their number. Messages are JSON objects with a ``type``:
``hello``, ``status``, ``tags`` (changes: name, time in ns, value, quality, reason), ``frames`` (the number of frames so far),
``dropped`` (how many updates this client has lost), ``end``.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.studio.api.common import attached
from fieldtwin.studio.live.subscription import Subscription

FULL = 4503
"""The WebSocket close code for a client that is refused because too many are connected."""
SENT_WITHIN_S = 10.0
"""A client that takes no data for this many seconds is disconnected."""


async def stream(socket: WebSocket) -> None:
    """Serve one client until it disconnects or the instance ends."""
    await socket.accept()
    try:
        attachment = await attached(socket)
    except FieldtwinError as e:
        await socket.close(4404, str(e)[:120])
        return
    if attachment.updates.is_full:
        await socket.close(FULL, "too many pages are open")
        return
    subscription = attachment.updates.subscribe()
    try:
        await socket.send_json(
            {"type": "hello", "started_ns": attachment.record.started_ns, "status": attachment.status()}
        )
        await _serve(socket, subscription)
    except (WebSocketDisconnect, TimeoutError, RuntimeError):
        pass  # the client is gone, or does not read
    finally:
        attachment.updates.unsubscribe(subscription)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close()


async def _serve(socket: WebSocket, subscription: Subscription) -> None:
    told = 0
    leaving = asyncio.ensure_future(until_left(socket))
    try:
        while not leaving.done():
            waiting = asyncio.ensure_future(subscription.next())
            await asyncio.wait([waiting, leaving], return_when=asyncio.FIRST_COMPLETED)
            if not waiting.done():
                waiting.cancel()
                return
            updates: list[dict[str, Any]] = waiting.result()
            if subscription.dropped != told:
                told = subscription.dropped
                updates.append({"type": "dropped", "count": told})
            if subscription.ended and not updates:
                updates = [{"type": "end"}]
            async with asyncio.timeout(SENT_WITHIN_S):
                for update in updates:
                    await socket.send_json(update)
            if subscription.ended:
                return
    finally:
        leaving.cancel()


async def until_left(socket: WebSocket) -> None:
    """Return when the client has disconnected. Messages from the client are ignored."""
    with contextlib.suppress(WebSocketDisconnect):
        while True:
            await socket.receive_text()
