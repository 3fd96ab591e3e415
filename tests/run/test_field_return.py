"""A remote field simulator that disappears and returns: the run reconnects, reports it, and treats lost facts as unknown."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import pytest
from support import eventually, run

from fieldtwin.gateway.core.control import ControlClient, ControlServer
from fieldtwin.run.live.oracle import Oracle
from fieldtwin.run.processes.field_contact import FieldContact, connect_control
from fieldtwin.run.processes.field_return import FieldReturn
from fieldtwin.twin.site.system import System, load_system


@pytest.fixture(scope="module")
def system() -> System:
    return load_system("observatory")


class Field:
    """The control channel of a field simulator that can be stopped and restarted."""

    def __init__(self, system: System, life: str, far: str = "tcp://127.0.0.1:5") -> None:
        self.status = {
            "life": life, "system": system.name, "system_hash": system.hash, "devices": {}, "listening": {}, "far": {"modem": far}
        }  # fmt: skip
        self.held: dict[str, list[Any]] = {}
        self.server = ControlServer({"get": self._get, "held": self._held})

    async def _get(self, args: dict[str, Any]) -> dict[str, Any]:
        return self.status

    async def _held(self, args: dict[str, Any]) -> dict[str, Any]:
        return {n: [e for e in held if e[0] > args["since"].get(n, 0)] for n, held in self.held.items()}


async def met(system: System, port: int, returns: list[bool]) -> FieldReturn:
    client, _ = await connect_control(f"127.0.0.1:{port}", "")
    contact = FieldContact(client, {}, {})
    contact.life, contact.reported_endpoints = "first", {"modem": "tcp://127.0.0.1:5"}

    async def returned(another: bool) -> None:
        returns.append(another)

    return FieldReturn(contact, system, f"127.0.0.1:{port}", "", returned)


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.mark.parametrize(
    ("life", "far", "another", "moved"),
    [
        ("first", "tcp://127.0.0.1:5", False, ""),
        ("second", "tcp://127.0.0.1:5", True, ""),
        (
            "second",
            "tcp://127.0.0.1:6",
            True,
            "with different endpoints: topside end of modem at tcp://127.0.0.1:6, not",
        ),
    ],
)
def test_it_is_found_again(system: System, life: str, far: str, another: bool, moved: str) -> None:
    async def main() -> None:
        port, returns = free_port(), list[bool]()
        first, second = Field(system, "first"), Field(system, life, far)
        await first.server.listen_tcp("127.0.0.1", port)
        back = await met(system, port, returns)
        watching = asyncio.ensure_future(back.run())
        assert back.client is not None
        assert not back.trouble
        await first.server.aclose()
        back.lost()
        back.lost()  # each failed request reports it
        assert back.client is None
        assert "was lost: the values of its devices are not known" in back.trouble
        await second.server.listen_tcp("127.0.0.1", port)
        await eventually(lambda: back.client is not None)
        assert returns == [another]
        assert moved in back.trouble
        assert bool(back.trouble) == bool(moved)
        assert back.describe()["losses"] == 1
        assert "is back after" in back.news
        assert (await back.client.call("get"))["life"] == life
        watching.cancel()
        await back.client.aclose()
        await second.server.aclose()

    run(main())


def test_one_with_another_system_file_is_not_taken(system: System) -> None:
    async def main() -> None:
        port, returns = free_port(), list[bool]()
        first, other = Field(system, "first"), Field(system, "second")
        other.status["system_hash"] = "another"
        await first.server.listen_tcp("127.0.0.1", port)
        back = await met(system, port, returns)
        watching = asyncio.ensure_future(back.run())
        await first.server.aclose()
        back.lost()
        await other.server.listen_tcp("127.0.0.1", port)
        await eventually(lambda: "a different version" in back.trouble)
        assert back.client is None
        assert not returns
        other.status["devices"] = 5
        await eventually(lambda: "the same version of fieldtwin" in back.trouble)
        other.status |= {"system_hash": system.hash, "devices": {}}
        await eventually(lambda: returns == [True])
        assert not back.trouble
        watching.cancel()
        await back.client.aclose()
        await other.server.aclose()

    run(main())


def test_values_of_the_gap_are_neither_right_nor_wrong(system: System, tmp_path: Any) -> None:
    published: list[Any] = [[1, "ctd.t", "0001", 0, 1], [2, "ctd.t", "0002", 0, 2]]

    async def entries(args: dict[str, Any]) -> dict[str, Any]:
        return {"entries": [e for e in published if e[0] > args["since"]]}

    async def main() -> None:
        gateway, field, after = ControlServer({"published": entries}), Field(system, "a"), Field(system, "b")
        await gateway.listen_unix(tmp_path / "g")
        await field.server.listen_unix(tmp_path / "f")
        ask, held = await ControlClient.connect_unix(tmp_path / "g"), await ControlClient.connect_unix(tmp_path / "f")
        oracle = Oracle()
        field.held = {"ctd": [[1, "t", "0001", 0], [2, "t", "0002", 0]]}
        await oracle.update(ask, held)
        assert (oracle.checked, oracle.wrong_count, oracle.unknown) == (2, 0, 0)
        published.append([3, "ctd.t", "0003", 0, 3])  # held by the first one just before it died: no request saw that
        await field.server.aclose()
        await held.aclose()
        await after.server.listen_unix(tmp_path / "f2")
        held = await ControlClient.connect_unix(tmp_path / "f2")
        after.held = {"ctd": [[1, "t", "0004", 0]]}  # it counts from the beginning
        published.append([4, "ctd.t", "0004", 0, 4])
        oracle.begin_again()
        await oracle.update(ask, held)
        assert (oracle.checked, oracle.wrong_count, oracle.unknown) == (3, 0, 1)
        published.append([5, "ctd.t", "0009", 0, 9])
        await oracle.update(ask, held)
        assert (oracle.checked, oracle.wrong_count, oracle.unknown) == (4, 1, 1)
        for one in (ask, held):
            await one.aclose()
        for server in (gateway, after.server):
            await server.aclose()

    run(main())
