"""The link of a killed emulator leads to whichever terminal gets its number from the kernel next.

Defect: after kill -9 of `fieldtwin emulate`, `fieldtwin read` and every other command sent requests of Modbus to the terminal
of another program. Only the gateway of a prototype noticed it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support import run

from fieldtwin.emulators.endpoints.link_ends import TtyEnd
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.twin.plant.instance import Instance

FIELDTWIN = (sys.executable, "-m", "fieldtwin")
GONE = "the program that made this virtual serial port has ended"
MAKE_PORT = """
import asyncio, sys
from pathlib import Path
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.core.endpoint import Endpoint
async def main():
    end = await PtyEnd.open(Path(sys.argv[1]), Endpoint("pty", path=sys.argv[1]))
    print(end.device, flush=True)
    await asyncio.sleep(60)
asyncio.run(main())
"""


def killed_port(link: Path) -> str:
    """Return the pseudo-terminal of a port whose program was killed; its link and its marker are left."""
    with subprocess.Popen([sys.executable, "-c", MAKE_PORT, str(link)], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        device = program.stdout.readline().strip()
        program.kill()
    return device


@contextmanager
def terminal_of_another_program(device: str) -> Iterator[int]:
    """Open pseudo-terminals until one is `device`; yield the end at which its program reads."""
    with ExitStack() as stack:
        for _ in range(200):  # the kernel gives the lowest free number
            master, slave = os.openpty()
            stack.callback(os.close, master)
            stack.callback(os.close, slave)
            if os.ttyname(slave) == device:
                os.set_blocking(master, False)
                yield master
                return
        raise AssertionError(f"no new pseudo-terminal is {device}")


def received(master: int) -> bytes:
    try:
        return os.read(master, 4096)
    except BlockingIOError:
        return b""


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [
        ("read", "{}", "holding:0", "--unit", "1"),
        ("write", "{}", "holding:0=1", "--unit", "1", "--yes"),
        ("scan", "{}", "--units", "1-2"),
        ("check", "modbus", "{}", "--unit", "1", "--read", "holding:0"),
    ],
    ids=lambda command: command[0],
)
def test_a_command_sends_nothing_to_the_terminal_that_has_the_number_of_a_killed_emulators_port(
    tmp_path: Path, command: tuple[str, ...]
) -> None:
    link = tmp_path / "ctd"
    emulate = [*FIELDTWIN, "emulate", "ctd-reference", "--on", f"pty:{link}"]

    with subprocess.Popen(emulate, stderr=subprocess.PIPE, text=True) as emulator:
        assert emulator.stderr is not None
        assert any("units 1 on" in line for line in emulator.stderr)
        device = os.readlink(link)
        emulator.kill()
    with terminal_of_another_program(device) as master:
        asked = [word.format(f"rtu:{link}") for word in command]
        done = subprocess.run([*FIELDTWIN, *asked], capture_output=True, text=True, timeout=120)
        assert received(master) == b""
        assert GONE in done.stderr, done.stdout + done.stderr
        assert done.returncode != 0


def test_links_to_a_dead_port_are_refused_at_each_end_that_opens_serial_ports(tmp_path: Path) -> None:
    link, alias = tmp_path / "line1", tmp_path / "alias"
    device = killed_port(link)
    alias.symlink_to("line1")

    async def main() -> None:
        for path in (link, alias):
            with pytest.raises(Unreachable, match=GONE):
                await OsConnector().open_bytes(Endpoint("rtu", path=str(path)))
            with pytest.raises(Unreachable, match=GONE):
                TtyEnd.open(Endpoint("rtu", path=str(path)))

    with terminal_of_another_program(device):
        run(main())


def test_the_next_emulator_replaces_the_dead_port_and_removes_its_own_at_the_end(tmp_path: Path) -> None:
    link = tmp_path / "line1"
    killed_port(link)

    async def main() -> None:
        end = await PtyEnd.open(link, Endpoint("pty", path=str(link)))
        connection = await OsConnector().open_bytes(Endpoint("rtu", path=str(link)))
        await connection.aclose()
        await end.aclose()

    run(main())
    assert list(tmp_path.iterdir()) == []


def test_a_run_removes_the_dead_ports_in_its_directory(tmp_path: Path) -> None:
    with Instance("tank", tmp_path) as instance:
        killed_port(instance.path("line1"))
    with Instance("tank", tmp_path) as instance:
        assert [path.name for path in instance.dir.iterdir()] == ["lock"]


def test_a_live_port_and_the_users_own_links_stay_usable_after_chmod(tmp_path: Path) -> None:
    link, own, replaced = tmp_path / "line1", tmp_path / "own", tmp_path / "replaced"
    killed_port(replaced)
    replaced.unlink()

    async def main() -> None:
        end = await PtyEnd.open(link, Endpoint("pty", path=str(link)))
        own.symlink_to(end.device)
        replaced.symlink_to(link)  # the dead port has left its marker
        os.chmod(end.device, 0o666)
        for path in (link, own, replaced):
            connection = await OsConnector().open_bytes(Endpoint("rtu", path=str(path)))
            await connection.aclose()
        await end.aclose()

    run(main())
