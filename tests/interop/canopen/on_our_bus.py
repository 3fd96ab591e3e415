"""A pytest plugin that runs the tests of other packages on the software CAN bus (`scripts/test-third-party-can`).

It replaces python-can's interface `virtual` by the interface `fieldtwin`: each channel name is a separate bus at 500
kbit/s, in this process. The file named by FIELDTWIN_EXPECTED lists the tests that are expected to fail, with reasons. A
listed test that passes is a failure, unless the entry says `sometimes`; an entry that matches no test is also a
failure.
"""

from __future__ import annotations

import asyncio
import os
import threading
import tomllib
from pathlib import Path
from typing import Any

import can.interfaces
import pytest
from canopen.sdo.client import SdoClient

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.endpoint import Endpoint

BITRATE = 500_000
PATIENCE_S = 1.0
"""Timeouts of python-can's back-to-back tests for a message and of canopen's SDO client for a reply. Their defaults of
0.1 s and 0.3 s are too short on a loaded computer."""

_loop = asyncio.new_event_loop()
_servers: dict[Any, SoftBusServer] = {}
_opening = threading.Lock()
threading.Thread(target=_loop.run_forever, daemon=True).start()


class OnOurBus(SoftBus):
    """The bus for programs that request the interface `virtual`."""

    def __init__(self, channel: Any = None, can_filters: Any = None, **options: Any) -> None:
        with _opening:
            if channel not in _servers:
                opening = SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), BITRATE)
                _servers[channel] = asyncio.run_coroutine_threadsafe(opening, _loop).result(30)
        host, port = _servers[channel].bound.address
        super().__init__(f"{host}:{port}", can_filters, **options)
        self._channel = channel  # the name in messages


SdoClient.RESPONSE_TIMEOUT = PATIENCE_S
can.interfaces.BACKENDS["virtual"] = (__name__, OnOurBus.__name__)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the expected failures, and extend the timeout of the back-to-back tests."""
    expected = tomllib.loads(Path(os.environ["FIELDTWIN_EXPECTED"]).read_text())
    suite = os.environ["FIELDTWIN_SUITE"]
    left = {entry["test"]: entry for entry in expected.get(suite, [])}
    for item in items:
        name = item.nodeid.rsplit("/", 1)[-1]
        if (entry := left.pop(name, None)) is not None:
            item.add_marker(pytest.mark.xfail(reason=entry["reason"], strict=not entry.get("sometimes", False)))
        if (case := getattr(item, "cls", None)) is not None and hasattr(case, "INTERFACE_1"):
            case.TIMEOUT = PATIENCE_S
    if left:
        raise pytest.UsageError(f"expected failures that fit no test of {suite}: {', '.join(left)}")
