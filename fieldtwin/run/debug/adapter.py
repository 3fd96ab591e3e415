"""The debug adapter: a process that an editor starts, or that waits for one, and the program that the editor debugs with it.

A launched program runs in a thread of this process, and a stop lets it wait. So this thread may then read its variables.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.plc.debug.session import Session, place
from fieldtwin.plc.debug.tracer import Resume, Tracer
from fieldtwin.run.debug.arguments import ATTACH, LAUNCH, checked
from fieldtwin.run.debug.messages import Messages
from fieldtwin.run.debug.programs import Debuggee
from fieldtwin.run.debug.relay import Relay, attach

ENDING_S = 5.0
"""How long the end of a session waits for its program, in seconds."""
Launch = Callable[[dict[str, Any]], Debuggee]
"""Reads and compiles the program for the checked arguments of a launch request. Raises `FieldtwinError`."""


class Adapter(Session):
    """The session with one editor. `serve` returns when the editor has ended it."""

    def __init__(self, messages: Messages, launch: Launch) -> None:
        self._commands: SimpleQueue[Resume] = SimpleQueue()
        super().__init__(messages.send, Tracer(self.stopped, self.logged, self._commands.get), self._commands.put)
        self._messages, self._launch = messages, launch
        self._debuggee = Debuggee([], lambda say, failed: True)
        self._thread: threading.Thread | None = None
        self._relay: Relay | None = None
        """To the PLC of a running instance, whose session answers the requests after the editor has attached to it."""
        self._ended = False

    def serve(self) -> None:
        """Answer requests until the editor disconnects."""
        while not self._ended and (request := self._messages.receive()) is not None:
            if self._relay is not None and self._relay.is_alive():
                self._relay.pass_on(request)
                self._ended = request.get("command") == "disconnect"
            else:
                self.answer(request)
        if self._relay is not None:
            self._relay.end()
        self._end_program()
        if self._thread is not None:
            self._thread.join(ENDING_S)

    def _end_program(self) -> None:
        """End the program, at once if it is stopped, else at its next line."""
        self.tracer.ending = True
        self._commands.put(Resume.CONTINUE)

    def do_launch(self, given: dict[str, Any]) -> None:
        if self._thread is not None:
            raise UsageError("the program has been launched before")
        try:
            self._debuggee = self._launch(checked("launch", given, LAUNCH))
        except FileInvalid as e:
            for one in (e, *e.others):  # an editor shows the failure of the request only for some seconds
                self.output(str(one), "stderr", **(place(one.path, one.line) if one.line else {}))
            raise
        self.show(self._debuggee.units, self._debuggee.names)
        self.started_ns = self._debuggee.started_ns
        if given.get("stopOnEntry") is True:
            self.tracer.step_first()
        if given.get("noDebug") is True:
            self.tracer.files = frozenset()

    def do_attach(self, given: dict[str, Any]) -> None:
        if self._thread is not None:
            raise UsageError("a program has been launched before")
        self._relay = attach(checked("attach", given, ATTACH).get("instance", ""), self.send)

    def do_configurationDone(self, given: dict[str, Any]) -> None:
        self._thread = threading.Thread(target=self._run, name="debugged program", daemon=True)
        self.then = self._thread.start

    def _run(self) -> None:
        well = False

        def work() -> None:
            nonlocal well
            try:
                well = self._debuggee.run(self.output, self.tracer.failed)
            except FieldtwinError as e:
                self.output(str(e), "stderr")

        self.tracer.run(work)
        self.send("event", event="exited", body={"exitCode": 0 if well else 1})
        self.send("event", event="terminated")

    def do_terminate(self, given: dict[str, Any]) -> None:
        self.then = self._end_program

    def do_disconnect(self, given: dict[str, Any]) -> None:
        self._ended = True
