"""Passes the requests of an editor to the PLC of a running instance, whose process has the session, and its messages back."""

from __future__ import annotations

import asyncio
import getpass
import threading
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.plc.debug.session import Send
from fieldtwin.run.processes.plc_client import choose, talk_to
from fieldtwin.run.processes.run_record import read_record

ASK_S = 0.05
"""The longest time in seconds between two queries for messages."""
ENDING_S = 5.0
"""How long the end waits for the thread, in seconds."""


def attach(instance: str, send: Send) -> Relay:
    """Begin a session with the PLC of an instance, which may be empty for the only one. `send` sends messages to the editor.

    Raises `UsageError` if the programs of the instance must not be stopped, because it can write to real devices. Raises
    `UsageError` or `Unreachable` if the instance does not run, and `RemoteError` if its PLC refuses.
    """
    path = choose(instance)
    record = read_record(path.parent)
    if record is None or not record.writes_only_simulated:
        raise UsageError(
            "a debugger stops the programs of this PLC, and its plant is not simulated",
            expected="a prototype whose devices are all emulated, or that writes to no real device",
            hint="fieldtwin plc trace and fieldtwin plc watch do not stop a program",
        )
    begun = talk_to(instance, lambda client: client.call("debug", attach=True, by=getpass.getuser()))
    relay = Relay(path, int(begun["number"]), send)
    relay.start()
    return relay


class Relay(threading.Thread):
    """The thread that talks to the PLC. It ends when the session has ended, or when the PLC does not answer any more."""

    def __init__(self, path: Path, number: int, send: Send) -> None:
        super().__init__(name="attached PLC", daemon=True)
        self._path, self._number, self._send = path, number, send
        self._requests: SimpleQueue[dict[str, Any] | None] = SimpleQueue()

    def pass_on(self, request: dict[str, Any]) -> None:
        """Send a request to the PLC, whose answer follows."""
        self._requests.put(request)

    def end(self) -> None:
        """End the session, and wait for its last messages."""
        self._requests.put(None)
        self.join(ENDING_S)

    def run(self) -> None:
        try:
            asyncio.run(self._relay())
        except FieldtwinError as e:
            self._send("event", event="output", body={"category": "stderr", "output": f"{e}\n"})
            self._send("event", event="terminated")

    async def _relay(self) -> None:
        client = await ControlClient.connect_unix(self._path)
        try:
            while True:
                request = self._next()
                requests = [] if request == {} else [request or {"seq": 0, "command": "disconnect"}]
                answer = await client.call("debug", number=self._number, requests=requests)
                for message in answer["messages"]:
                    ours = message["kind"] == "response" and message["request_seq"] == 0
                    if not ours:
                        self._send(**message)
                if request is None or request.get("command") in ("disconnect", "terminate"):
                    break
            if request is not None:
                self._send("event", event="terminated")
        finally:
            await client.aclose()

    def _next(self) -> dict[str, Any] | None:
        """Return the next request; empty without one, and None at the end of the session."""
        try:
            return self._requests.get(timeout=ASK_S)
        except Empty:
            return {}
