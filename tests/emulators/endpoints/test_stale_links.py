"""The link of a killed emulator leads to whichever terminal gets its number from the kernel next.

Defect: two tests in a hundred runs of the suite found their new virtual serial port locked. A gateway whose emulator had been
killed had followed its link, and would have sent its requests to a foreign terminal.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support import run

from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.twin.plant.mapping import MappedConnector, mapped_endpoint

PLANT = Endpoint.parse("rtu:/dev/ttyS0?baudrate=19200&frame=8E1")


def test_the_link_of_a_killed_emulator_is_not_followed_to_another_terminal(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", Endpoint("pty", path=str(tmp_path / "line1")))
        target = mapped_endpoint(PLANT, Endpoint("pty", path=str(end.link)))
        connector = MappedConnector(OsConnector(), {PLANT: target})
        connection = await connector.open_bytes(PLANT)
        await connection.aclose()
        device, kept = end.device, tmp_path / "kept"
        os.link(end.link, kept, follow_symlinks=False)  # kill -9 removes no link
        await end.aclose()
        os.rename(kept, tmp_path / "line1")
        with pytest.raises(Unreachable, match="there is no such serial port"):
            await connector.open_bytes(PLANT)
        others = []
        try:
            while not others or os.ttyname(others[-1][1]) != device:  # the kernel gives the lowest free number
                others.append(os.openpty())
                assert len(others) < 200
            with pytest.raises(Unreachable, match="its link points to a newer pseudo-terminal"):
                await connector.open_bytes(PLANT)
        finally:
            for pair in others:
                for descriptor in pair:
                    os.close(descriptor)

    run(main())
