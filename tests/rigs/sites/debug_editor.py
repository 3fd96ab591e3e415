"""Clients of the Debug Adapter Protocol, in the place of an editor: on the pipes of `fieldtwin plc debug`, and on a socket."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from debug_protocol_schema import validate

from fieldtwin.run.debug.adapter import Adapter, Launch
from fieldtwin.run.debug.messages import Messages


class Editor:
    """A client of the protocol on a pair of byte streams. It validates the messages of both directions."""

    def __init__(self, reading: BinaryIO, writing: BinaryIO) -> None:
        self.reading, self.writing = reading, writing
        self.sequence = self.read_sequence = 0
        self.events: list[dict[str, Any]] = []

    def read(self) -> dict[str, Any]:
        length = 0
        while line := self.reading.readline().strip():
            name, _, value = line.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
        assert length, self.complaint()
        found: dict[str, Any] = json.loads(self.reading.read(length))
        validate(found)
        self.read_sequence += 1
        assert found["seq"] == self.read_sequence
        return found

    def complaint(self) -> str:
        """Return the reason for the end of the stream."""
        return "the adapter ended"

    def send(self, data: bytes) -> None:
        self.writing.write(b"Content-Length: %d\r\n\r\n" % len(data) + data)
        self.writing.flush()

    def request(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Return the response. Events that come before it are kept."""
        validate({"seq": 1, "type": "request", "command": command, "arguments": arguments})
        return self.bad_request(command, **arguments)

    def bad_request(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Return the response to a request that may violate the protocol."""
        self.sequence += 1
        self.send(
            json.dumps({"seq": self.sequence, "type": "request", "command": command, "arguments": arguments}).encode()
        )
        while (message := self.read())["type"] == "event":
            self.events.append(message)
        assert (message["request_seq"], message["command"]) == (self.sequence, command)
        return message

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Return the body of a response to a request that succeeds."""
        answer = self.request(command, **arguments)
        assert answer["success"], answer
        body: dict[str, Any] = answer.get("body", {})
        return body

    def event(self) -> dict[str, Any]:
        """Return the next event."""
        message = self.events.pop(0) if self.events else self.read()
        assert message["type"] == "event"
        return message

    def wait(self, event: str) -> dict[str, Any]:
        """Return the body of the next event of this kind; those before it are dropped."""
        while True:
            message = self.event()
            if message["event"] == event:
                body: dict[str, Any] = message.get("body", {})
                return body

    def begin(
        self,
        lines: Mapping[Path, Sequence[int | dict[str, Any]]],
        request: str = "launch",
        filters: Sequence[str] = ("errors",),
        **arguments: Any,
    ) -> list[dict[str, Any]]:
        """Launch or attach with breakpoints, each a line or the arguments of the protocol, and return the answers for them."""
        self.ask("initialize", adapterID="fieldtwin")
        self.ask(request, **arguments)
        self.wait("initialized")
        placed = [answer for path, wanted in lines.items() for answer in self.breakpoints(path, *wanted)]
        self.ask("setExceptionBreakpoints", filters=list(filters))
        self.ask("configurationDone")
        return placed

    def breakpoints(self, path: Path, *wanted: int | dict[str, Any]) -> list[dict[str, Any]]:
        lines = [{"line": one} if isinstance(one, int) else one for one in wanted]
        found: list[dict[str, Any]] = self.ask("setBreakpoints", source={"path": str(path)}, breakpoints=lines)[
            "breakpoints"
        ]
        return found

    def goes_on(self, command: str = "continue") -> dict[str, Any]:
        """Let the program go on, and return the body of the event of its next stop."""
        self.ask(command, threadId=1)
        return self.wait("stopped")

    def logged(self) -> str:
        """Return the next text that the program sends to the console, without its end of line."""
        return str(self.wait("output")["output"]).removesuffix("\n")

    def place(self) -> tuple[str, int]:
        frame = self.ask("stackTrace", threadId=1)["stackFrames"][0]
        return frame["name"], frame["line"]

    def value(self, path: str) -> str:
        return str(self.ask("evaluate", expression=path, frameId=1)["result"])


class ProcessEditor(Editor):
    """An editor that has started the command as a process."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "fieldtwin", "plc", "debug", *arguments]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        super().__init__(self.process.stdout, self.process.stdin)  # type: ignore[arg-type]

    def complaint(self) -> str:
        assert self.process.stderr is not None
        return self.process.stderr.read().decode()

    def ends(self) -> int:
        self.ask("disconnect")
        return self.process.wait(20)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


@contextmanager
def editor_on_socket(launch: Launch) -> Iterator[Editor]:
    """Serve one editor by an adapter in a thread of this process, over a TCP socket, which is faster than a new process."""

    def serve() -> None:
        connection, _ = server.accept()
        with connection, connection.makefile("rb") as reading, connection.makefile("wb") as writing:
            Adapter(Messages(reading, writing), launch).serve()

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        with (
            socket.create_connection(server.getsockname()) as client,
            client.makefile("rb") as reading,
            client.makefile("wb") as writing,
        ):
            editor = Editor(reading, writing)
            yield editor
            if thread.is_alive():
                editor.ask("disconnect")
            thread.join(20)
            assert not thread.is_alive()


Open = Callable[..., ProcessEditor]
"""Starts an editor with the arguments of the command, and closes it after the test."""
