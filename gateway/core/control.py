"""The control channel: newline-delimited JSON between a running process and the clients that watch or control it.

A request is one line ``{"v": 1, "id": 7, "command": "get", "args": {...}}``, its answer one line ``{"v": 1, "id": 7, "ok":
true, "result": ...}`` or ``{"v": 1, "id": 7, "ok": false, "error": {"kind", "message", "exit_code"}}``. Each process
registers its own commands: a plant's controller does not register a fault command, so it has none. The channel
uses a Unix socket in the instance's run directory (owner only), or TCP with a token if configured.

A line has at most `MAX_LINE` bytes. This module handles text and JSON only; it does not know the state of the process.
"""

from __future__ import annotations

import asyncio
import hmac
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fieldtwin.gateway.core.errors import (
    Bug,
    ConnectionLost,
    EndpointBusy,
    FieldtwinError,
    ReplyTimeout,
    Unreachable,
    UsageError,
    os_reason,
)

VERSION = 1
MAX_LINE = 4 * 1024 * 1024
MAX_CLIENTS = 64
LINE_WITHIN_S = 10.0
"""Time limit in seconds for a request that has begun to arrive, and for a client that has to send a token.

After it, the client is dropped. Without this limit, clients that send nothing, or one byte at a time, would occupy
all connections.
"""

S = TypeVar("S", bound=msgspec.Struct)
CommandHandler = Callable[[dict[str, Any]], Awaitable[Any]]


class ControlServer:
    """A server for the registered commands on a Unix socket and, if configured, on TCP.

    `commands` maps a name to ``async (args) -> result``: data for JSON, or a `msgspec.Struct` of such. A `FieldtwinError` from a
    command becomes an error answer. Any other exception becomes one too, reported as a bug of fieldtwin. The connection stays
    open.
    """

    def __init__(self, commands: dict[str, CommandHandler], token: str = "") -> None:
        self._commands = dict(commands)
        self._token = token
        self._servers: list[asyncio.Server] = []
        self._clients: dict[asyncio.StreamWriter, asyncio.Task[None] | None] = {}
        self._sockets: list[Path] = []

    async def listen_unix(self, path: Path) -> None:
        """Listen on `path`, replacing a stale socket; readable and writable for the owner only.

        Raises `EndpointBusy` if a running process serves there, and `Unreachable` if a socket cannot be created there.
        """
        try:
            if path.is_socket():
                await _refuse_if_alive(path)
                path.unlink()
            server = await asyncio.start_unix_server(self._serve_unix, path=str(path), limit=MAX_LINE)
        except OSError as e:
            raise Unreachable(f"cannot listen for control: {os_reason(e)}", where=str(path)) from e
        path.chmod(0o600)
        self._sockets.append(path)
        self._servers.append(server)

    async def listen_tcp(self, host: str, port: int) -> int:
        """Listen on TCP and return the port. Beyond loopback a token is required, because every client may control the
        process.
        """
        if not self._token and host not in ("127.0.0.1", "::1", "localhost"):
            raise UsageError("a control channel that is not on loopback needs a token", where=f"{host}:{port}")
        try:
            server = await asyncio.start_server(self._serve_tcp, host, port, limit=MAX_LINE)
        except OSError as e:
            raise Unreachable(
                f"cannot listen for control: {os_reason(e)}", where=f"{host}:{port}", hint="port 0 selects a free port"
            ) from e
        self._servers.append(server)
        return int(server.sockets[0].getsockname()[1])

    async def aclose(self) -> None:
        """Stop listening, disconnect every client, cancel their pending commands, and remove the sockets."""
        for server in self._servers:
            server.close()
        serving = [task for task in self._clients.values() if task is not None and task is not asyncio.current_task()]
        for task in serving:
            task.cancel()
        await asyncio.gather(*serving, return_exceptions=True)
        for server in self._servers:
            await server.wait_closed()
        self._servers.clear()
        while self._sockets:
            self._sockets.pop().unlink(missing_ok=True)

    async def serve_pipe(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve the parent process over stdin and stdout. Return when the parent is gone. The parent is trusted; no socket is
        opened.
        """
        await self._serve(reader, writer, trusted=True)

    async def _serve_unix(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._serve(reader, writer, trusted=True)

    async def _serve_tcp(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._serve(reader, writer, trusted=not self._token)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, trusted: bool) -> None:
        if len(self._clients) >= MAX_CLIENTS:
            writer.close()
            return
        self._clients[writer] = asyncio.current_task()
        try:
            until_s = asyncio.get_running_loop().time() + LINE_WITHIN_S
            while line := await _read_line(reader, None if trusted else until_s):
                answer, trusted = await self._answer(line, trusted)
                writer.write(answer)
                await writer.drain()
        except (ConnectionError, TimeoutError, asyncio.CancelledError, ValueError):
            pass  # client gone or too slow, server closing, or a line over the limit: only this client is dropped
        finally:
            self._clients.pop(writer, None)
            writer.close()

    async def _answer(self, line: bytes, trusted: bool) -> tuple[bytes, bool]:
        request_id: Any = None
        try:
            request = _parse(line)
            request_id = request.get("id")
            token = str(request.get("token", ""))
            trusted = trusted or hmac.compare_digest(token.encode(errors="replace"), self._token.encode())
            if not trusted:
                raise UsageError("this control channel requires its token")
            command = self._commands.get(str(request.get("command")))
            if command is None:
                raise UsageError(
                    f"unknown command {request.get('command')!r}", expected=", ".join(sorted(self._commands))
                )
            return _encode(request_id, {"ok": True, "result": await command(request.get("args") or {})}), trusted
        except FieldtwinError as e:
            error = e
        except Exception as e:  # a bug in a command must not end the channel; it is reported to the caller
            error = Bug(f"{type(e).__name__}: {e}")
        return _encode(request_id, {"ok": False, "error": _describe(error)}), trusted


async def _read_line(reader: asyncio.StreamReader, until_s: float | None) -> bytes:
    """Read one request line, or return b"" at the end of the stream.

    Raises `TimeoutError` if the line is incomplete `LINE_WITHIN_S` seconds after its first byte or at the loop's time `until_s`,
    and `ValueError` if it is too long.
    """
    async with asyncio.timeout_at(until_s):
        first = await reader.read(1)
        if first in (b"", b"\n"):
            return first
        async with asyncio.timeout(LINE_WITHIN_S):
            return first + await reader.readline()


def _parse(line: bytes) -> dict[str, Any]:
    """Return the parsed request. Raises `UsageError` for a malformed request, because invalid input from a client is not a bug
    of fieldtwin.
    """
    try:
        request = json.loads(line)
    except (ValueError, RecursionError) as e:
        raise UsageError(f"not JSON: {e}") from e
    if not isinstance(request, dict) or request.get("v") != VERSION:
        raise UsageError("not a control request", expected=f'a JSON object with "v": {VERSION}')
    if not isinstance(request.get("args") or {}, dict):
        raise UsageError("not a control request", expected='"args" to be a JSON object')
    return request


def _encode(request_id: Any, answer: dict[str, Any]) -> bytes:
    text = json.dumps({"v": VERSION, "id": request_id, **answer}, separators=(",", ":"), default=_jsonable)
    return text.encode() + b"\n"


def _jsonable(value: object) -> object:
    return msgspec.to_builtins(value) if isinstance(value, msgspec.Struct) else str(value)


async def _refuse_if_alive(path: Path) -> None:
    try:
        _, writer = await asyncio.open_unix_connection(str(path))
    except OSError:
        return  # no process listens: the socket was left over from a process that was killed
    writer.close()
    raise EndpointBusy(
        "another process already serves this control channel", where=str(path), hint="is this instance running already?"
    )


def _describe(e: FieldtwinError) -> dict[str, Any]:
    return {"kind": type(e).__name__, "message": str(e), "exit_code": e.exit_code}


class RemoteError(FieldtwinError):
    """An error that the other process answered with. `kind` is the name of its class in that process."""

    def __init__(self, kind: str, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.kind = kind
        self.remote_exit_code = exit_code


class OtherVersion(FieldtwinError):
    """The other process answered with data of an unexpected form: it runs a different version of fieldtwin."""


class ControlClient:
    """One connection to a control channel. It sends one request at a time."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, where: str, token: str) -> None:
        self._reader = reader
        self._writer = writer
        self._where = where
        self._token = token
        self._next_id = 0
        self._turn = asyncio.Lock()

    @classmethod
    async def connect_unix(cls, path: Path) -> ControlClient:
        """Connect to a process on this host. Raises `Unreachable` if the process does not run."""
        try:
            reader, writer = await asyncio.open_unix_connection(str(path), limit=MAX_LINE)
        except OSError as e:
            raise Unreachable(f"no control channel: {e.strerror or e}", where=str(path)) from e
        return cls(reader, writer, str(path), "")

    @classmethod
    async def connect_tcp(cls, host: str, port: int, token: str = "") -> ControlClient:
        """Connect to a process on another host. Raises `Unreachable` if it does not answer."""
        try:
            reader, writer = await asyncio.open_connection(host, port, limit=MAX_LINE)
        except OSError as e:
            raise Unreachable(f"no control channel: {os_reason(e)}", where=f"{host}:{port}") from e
        return cls(reader, writer, f"{host}:{port}", token)

    async def call(self, command: str, timeout_s: float = 5.0, **args: Any) -> Any:
        """Send the command `command` and return its result. Raises `RemoteError`, `ConnectionLost` or `ReplyTimeout`."""
        async with self._turn:
            self._next_id += 1
            request = {"v": VERSION, "id": self._next_id, "command": command, "args": args}
            if self._token:
                request["token"] = self._token
            try:
                if self._writer.is_closing():
                    raise ConnectionLost("the other process closed its control channel", where=self._where)
                async with asyncio.timeout(timeout_s):
                    self._writer.write(json.dumps(request).encode() + b"\n")
                    await self._writer.drain()
                    answer = await self._read_answer(self._next_id)
            except TimeoutError as e:
                raise ReplyTimeout(f"no answer to {command!r} within {timeout_s} s", where=self._where) from e
            except (OSError, ValueError) as e:
                raise ConnectionLost(f"control channel broke: {e}", where=self._where) from e
        if answer.get("ok"):
            return answer.get("result")
        error = answer.get("error") or {}
        raise RemoteError(error.get("kind", "?"), error.get("message", "?"), error.get("exit_code", 70))

    async def ask(self, command: str, kind: type[S], timeout_s: float = 5.0, **args: Any) -> S:
        """Send the command `command` and return its result as a `kind`.

        Raises as `call`, and `OtherVersion` if the result does not fit `kind`.
        """
        answer = await self.call(command, timeout_s, **args)
        try:
            return msgspec.convert(answer, kind)
        except msgspec.ValidationError as e:
            raise OtherVersion(
                f"the answer to {command!r} is not as expected: {e}",
                where=self._where,
                hint="both processes need the same version of fieldtwin",
            ) from e

    async def _read_answer(self, request_id: int) -> dict[str, Any]:
        while True:
            line = await self._reader.readline()
            if not line:
                raise ConnectionLost("the other process closed its control channel", where=self._where)
            answer = json.loads(line)
            if not isinstance(answer, dict):
                raise ConnectionLost("the other process does not use the control protocol", where=self._where)
            if answer.get("id") == request_id:  # an answer to a call that timed out earlier is skipped
                return answer

    async def aclose(self) -> None:
        self._writer.close()
        try:
            await self._writer.wait_closed()
        except OSError:
            pass  # the peer had already closed the connection
