"""The control channel over a real Unix socket and a real TCP port: valid requests, garbage, bounds."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import stat
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from support import eventually, run

from fieldtwin.gateway.core import control
from fieldtwin.gateway.core.control import ControlClient, ControlServer, OtherVersion, RemoteError
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    EndpointBusy,
    NotAllowed,
    ReplyTimeout,
    Unreachable,
    UsageError,
)


async def echo(args: dict[str, Any]) -> Any:
    return args


async def refuse(args: dict[str, Any]) -> Any:
    raise NotAllowed("read-only", where="ctd.period")


async def broken(args: dict[str, Any]) -> Any:
    raise KeyError("oops")


async def unspeakable(args: dict[str, Any]) -> Any:
    return {(1, 2): "a key that JSON has not"}


async def never(args: dict[str, Any]) -> Any:
    await asyncio.Event().wait()


COMMANDS = {"echo": echo, "refuse": refuse, "broken": broken, "unspeakable": unspeakable, "never": never}


class Part(msgspec.Struct):
    count: int


class Whole(msgspec.Struct):
    name: str
    parts: dict[str, Part]
    added_later: list[str] = []


async def whole(args: dict[str, Any]) -> Any:
    return Whole("w", {"a": Part(3)})


COMMANDS["whole"] = whole


@contextlib.asynccontextmanager
async def serving(path: Path, token: str = "") -> AsyncIterator[ControlServer]:
    server = ControlServer(COMMANDS, token)
    await server.listen_unix(path)
    try:
        yield server
    finally:
        await server.aclose()


@contextlib.asynccontextmanager
async def raw(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_unix_connection(str(path))
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, line: bytes) -> dict[str, Any]:
    writer.write(line + b"\n")
    answer: dict[str, Any] = json.loads(await asyncio.wait_for(reader.readline(), 5))
    return answer


def test_a_command_is_served_and_its_errors_keep_their_kind(tmp_path: Path) -> None:
    async def main() -> None:
        async with serving(tmp_path / "s"):
            client = await ControlClient.connect_unix(tmp_path / "s")
            assert await client.call("echo", tag="ctd.pressure", value=1.5) == {"tag": "ctd.pressure", "value": 1.5}
            with pytest.raises(RemoteError, match="read-only") as caught:
                await client.call("refuse")
            assert (caught.value.kind, caught.value.remote_exit_code) == ("NotAllowed", 2)
            with pytest.raises(RemoteError, match="oops") as caught:
                await client.call("broken")
            assert caught.value.kind == "Bug"
            with pytest.raises(RemoteError, match="unknown command 'fault'") as caught:
                await client.call("fault")
            assert "echo" in str(caught.value), "says which commands there are"
            with pytest.raises(RemoteError) as caught:
                await client.call("unspeakable")
            assert caught.value.kind == "Bug"
            assert await client.call("echo", still="there") == {"still": "there"}
            await client.aclose()

    run(main())


@pytest.mark.parametrize(
    "line",
    [
        b"hello",
        b"\xff\xfe\x00",
        b"[]",
        b"null",
        b'{"v": 2, "id": 1, "command": "echo"}',
        b'{"v": 1, "id": 1, "command": "echo", "args": [1]}',
        b"[" * 100_000,
        b"1" * 10_000,
        b'{"v": 1, "command": ["echo"]}',
    ],
    ids=lambda line: repr(line[:24]),
)
def test_garbage_is_answered_as_the_callers_mistake_and_the_channel_stays_open(tmp_path: Path, line: bytes) -> None:
    async def main() -> None:
        async with serving(tmp_path / "s"), raw(tmp_path / "s") as (reader, writer):
            answer = await ask(reader, writer, line)
            assert answer["ok"] is False
            assert answer["error"]["kind"] == "UsageError"
            answer = await ask(reader, writer, b'{"v": 1, "id": "x", "command": "echo", "args": {"a": 1}}')
            assert answer == {"v": 1, "id": "x", "ok": True, "result": {"a": 1}}

    run(main())


def test_an_over_long_line_drops_that_client_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "MAX_LINE", 10_000)

    async def main() -> None:
        async with serving(tmp_path / "s"):
            client = await ControlClient.connect_unix(tmp_path / "s")
            assert await client.call("echo", text="x" * 4000) == {"text": "x" * 4000}
            async with raw(tmp_path / "s") as (reader, writer):
                writer.write(b"x" * 50_000)
                with contextlib.suppress(ConnectionError):
                    assert await asyncio.wait_for(reader.read(), 5) == b""
            assert await client.call("echo", text="y") == {"text": "y"}
            await client.aclose()

    run(main())


def test_the_socket_is_the_owners_alone_and_goes_with_the_server(tmp_path: Path) -> None:
    async def main() -> None:
        async with serving(tmp_path / "s"):
            assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
        assert not (tmp_path / "s").exists()
        with pytest.raises(Unreachable, match="no control channel"):
            await ControlClient.connect_unix(tmp_path / "s")

    run(main())


def test_a_stale_socket_is_replaced_and_a_living_one_or_a_file_is_not(tmp_path: Path) -> None:
    async def main() -> None:
        with socket.socket(socket.AF_UNIX) as killed:
            killed.bind(str(tmp_path / "s"))  # as after kill -9: the file without a listener
        async with serving(tmp_path / "s"):
            with pytest.raises(EndpointBusy, match="another process"):
                await ControlServer(COMMANDS).listen_unix(tmp_path / "s")
            client = await ControlClient.connect_unix(tmp_path / "s")
            assert await client.call("echo") == {}
            await client.aclose()
        (tmp_path / "file").write_text("precious")
        with pytest.raises(Unreachable):
            await ControlServer(COMMANDS).listen_unix(tmp_path / "file")
        assert (tmp_path / "file").read_text() == "precious"
        with pytest.raises(Unreachable):
            await ControlServer(COMMANDS).listen_unix(tmp_path / ("x" * 200))

    run(main())


def test_over_tcp_the_token_is_needed(tmp_path: Path) -> None:
    async def main() -> None:
        server = ControlServer(COMMANDS, token="sesam")
        port = await server.listen_tcp("127.0.0.1", 0)
        for token in ("", "sesan", "sésame"):
            stranger = await ControlClient.connect_tcp("127.0.0.1", port, token)
            with pytest.raises(RemoteError, match="requires its token") as caught:
                await stranger.call("echo")
            assert caught.value.kind == "UsageError"
            await stranger.aclose()
        friend = await ControlClient.connect_tcp("127.0.0.1", port, "sesam")
        assert await friend.call("echo", a=1) == {"a": 1}
        await friend.aclose()
        with pytest.raises(Unreachable):
            await ControlServer(COMMANDS).listen_tcp("127.0.0.1", port)
        await server.aclose()
        with pytest.raises(UsageError, match="needs a token"):
            await ControlServer(COMMANDS).listen_tcp("0.0.0.0", 0)

    run(main())


def test_a_late_answer_is_not_taken_for_the_next_ones(tmp_path: Path) -> None:
    async def main() -> None:
        release = asyncio.Event()

        async def slow(args: dict[str, Any]) -> Any:
            await release.wait()
            return "late"

        server = ControlServer({"slow": slow, "echo": echo})
        await server.listen_unix(tmp_path / "s")
        client = await ControlClient.connect_unix(tmp_path / "s")
        with pytest.raises(ReplyTimeout, match="slow"):
            await client.call("slow", timeout_s=0.05)
        release.set()
        assert await client.call("echo", a=2) == {"a": 2}
        await client.aclose()
        await server.aclose()

    run(main())


def test_closing_the_server_ends_a_hanging_command_and_informs_its_caller(tmp_path: Path) -> None:
    async def main() -> None:
        async with serving(tmp_path / "s") as server:
            client = await ControlClient.connect_unix(tmp_path / "s")
            call = asyncio.create_task(client.call("never", timeout_s=10))
            await eventually(lambda: len(server._clients) == 1)
            await server.aclose()
            with pytest.raises(ConnectionLost):
                await call
            await client.aclose()

    run(main())


def test_a_struct_is_sent_as_a_json_object_and_read_as_a_struct(tmp_path: Path) -> None:
    async def main() -> None:
        async with serving(tmp_path / "c"):
            client = await ControlClient.connect_unix(tmp_path / "c")
            told = {"name": "w", "parts": {"a": {"count": 3}}, "added_later": []}
            assert json.dumps(await client.call("whole")) == json.dumps(told)  # in this order
            assert await client.ask("whole", Whole) == Whole("w", {"a": Part(3)})
            older: dict[str, Any] = {"name": "w", "parts": {}}
            assert await client.ask("echo", Whole, **older, unknown=1) == Whole("w", {})
            await client.aclose()

    run(main())


@pytest.mark.parametrize(
    ("args", "text"),
    [({"parts": {}}, "missing required field `name`"), ({"name": "w", "parts": {"a": {"count": "3"}}}, "parts")],
)
def test_an_answer_of_a_different_form_is_a_different_version(tmp_path: Path, args: dict[str, Any], text: str) -> None:
    async def main() -> None:
        async with serving(tmp_path / "c"):
            client = await ControlClient.connect_unix(tmp_path / "c")
            with pytest.raises(OtherVersion, match=text) as raised:
                await client.ask("echo", Whole, **args)
            assert "the same version of fieldtwin" in str(raised.value)
            assert await client.call("echo", a=1) == {"a": 1}  # the connection goes on
            await client.aclose()

    run(main())


def test_a_peer_with_a_different_protocol_is_a_lost_connection(tmp_path: Path) -> None:
    async def main() -> None:
        for reply in (b"220 mail ready\r\n", b"[1]\n", b"\xff\n", b""):
            path = tmp_path / f"s{len(reply)}"

            async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, reply: bytes = reply) -> None:
                await reader.readline()
                writer.write(reply)
                writer.close()

            server = await asyncio.start_unix_server(serve, str(path))
            client = await ControlClient.connect_unix(path)
            with pytest.raises(ConnectionLost):
                await client.call("echo")
            await client.aclose()
            server.close()
            await server.wait_closed()

    run(main())


def test_more_clients_than_allowed_are_turned_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "MAX_CLIENTS", 2)

    async def main() -> None:
        async with serving(tmp_path / "s"):
            clients = [await ControlClient.connect_unix(tmp_path / "s") for _ in range(3)]
            for client in clients[:2]:
                assert await client.call("echo") == {}
            with pytest.raises(ConnectionLost):
                await clients[2].call("echo")
            await clients[0].aclose()

            async def room() -> bool:
                late = await ControlClient.connect_unix(tmp_path / "s")
                try:
                    return bool(await late.call("echo") == {})
                except ConnectionLost:
                    return False
                finally:
                    await late.aclose()

            await eventually(room)
            for client in clients[1:]:
                await client.aclose()

    run(main())
