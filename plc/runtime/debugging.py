"""A debugger that is attached to the PLC of a running prototype: the command ``debug`` of the control channel.

A debugger stops the programs inside a scan, which must not happen in a plant. The PLC does not know whether its plant is
simulated, so `fieldtwin.run.debug.relay` asks the record of the run before it attaches. While a scan is stopped, the control
channel still answers, and:

- the outputs are published as those of a stopped PLC, so that the gateway writes their safe values and publishes nothing of the
  programs as good. This lasts until a scan was executed without a stop, because the inputs of the others are old.
- the guard against endless scans does not run, and the stopped scans count as no overruns.
- the time of the plant goes on, and timers see that in the next scan.

A client that sends nothing for `LEASE_NS` has lost its session, and the programs go on.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.cycle.task import Guard
from fieldtwin.plc.runtime.runner import TaskRunner

if TYPE_CHECKING:
    from fieldtwin.plc.debug.session import Session
    from fieldtwin.plc.debug.tracer import Resume, Tracer

LEASE_NS = 5 * NS_PER_S
LOOK_S = 0.1
"""The longest time in seconds for which a stopped scan waits without checking whether it has to go on."""
MAX_MESSAGES = 1000
"""The largest number of messages that wait for the client. Further output of logpoints is counted and dropped."""


class DebugGuard:
    """The guard of each scan: that against endless scans (`inner`), and the tracer of an attached debugger."""

    def __init__(self, inner: Guard | None) -> None:
        self.inner = inner
        self.tracer: Tracer | None = None
        self.passed: Callable[[], None] = lambda: None
        """Called after each scan that was under control."""

    def arm(self) -> None:
        if self.inner is not None:
            self.inner.arm()
        if self.tracer is not None and self.tracer.needed:
            self.tracer.begin()

    def disarm(self) -> None:
        if self.tracer is not None:
            self.tracer.pass_by()
            self.passed()
        if self.inner is not None:
            self.inner.disarm()


@dataclass(frozen=True, slots=True)
class Waiting:
    """How a stopped scan waits: with the loop of the control channel, until `ending` or a command resumes it."""

    loop: asyncio.AbstractEventLoop
    now_ns: Callable[[], int]
    ending: Callable[[], bool]


class Note(Protocol):
    """Records a user's action. Raises `Unreachable` if it cannot be recorded."""

    def __call__(self, action: str, args: dict[str, Any], **details: Any) -> None: ...


class Debugging:
    """The debugger of one PLC process, whose tasks have `guard`."""

    def __init__(self, runner: TaskRunner, guard: DebugGuard, waiting: Waiting, note: Note) -> None:
        self._runner, self._guard, self._waiting, self._note = runner, guard, waiting, note
        self._number = 0
        self._session: Session | None = None
        self._by: dict[str, Any] = {}
        self._seen_ns = 0
        """When the client of the session last sent something."""
        self._messages: list[dict[str, Any]] = []
        self._dropped = 0
        self._place = ""
        """Where the scan is stopped; empty while it is not."""
        self._resumed: Resume | None = None
        self._was_stopped = False
        """Whether the present scan was stopped."""

    @property
    def status(self) -> str:
        withheld = "; the outputs are safe until a scan without a stop" if self._runner.outputs.withheld else ""
        if self._session is None:
            return f"detached{withheld}" if withheld else ""
        by = str(self._by.get("by") or "unknown")
        return f"attached by {by}" + (f", stopped at {self._place}; the outputs are safe" if self._place else withheld)

    def refuse_in_a_scan(self, what: str) -> None:
        """Raise `UsageError` if a scan is stopped."""
        if self._place:
            raise UsageError(f"{what} while a debugger has stopped a scan", hint="continue in the debugger first")

    async def command(self, args: dict[str, Any]) -> dict[str, Any]:
        """Begin a session (``attach``), or answer the ``requests`` of session ``number``; return its number and messages."""
        if args.get("attach") is True:
            self._attach(args)
        elif self._session is None or args.get("number") != self._number:
            raise UsageError(
                "there is no such debugging session", hint=f"it ends after {LEASE_NS // NS_PER_S} s without contact"
            )
        self._seen_ns = self._waiting.now_ns()
        requests = args.get("requests", [])
        for request in requests if isinstance(requests, list) else ():
            if isinstance(request, dict) and self._session is not None:
                self._answer(request)
        messages, self._messages = self._messages, []
        if self._dropped:
            text = f"{self._dropped} messages were dropped, because they came too fast\n"
            body = {"category": "important", "output": text}
            messages.append({"kind": "event", "event": "output", "body": body})
            self._dropped = 0
        return {"number": self._number, "messages": messages}

    def _answer(self, request: dict[str, Any]) -> None:
        assert self._session is not None
        if request.get("command") in ("setVariable", "setExpression"):
            given = request.get("arguments")
            shown = given if isinstance(given, dict) else {}
            tag = str(shown.get("name") or shown.get("expression", ""))[:200]
            self._note("debug_set", self._by, tag=tag, new=str(shown.get("value", ""))[:200])
        self._session.answer(request)
        if request.get("command") in ("disconnect", "terminate"):
            self._detach()

    def _attach(self, args: dict[str, Any]) -> None:
        if self._session is not None and self._waiting.now_ns() - self._seen_ns <= LEASE_NS:
            raise UsageError("another debugger is attached", got=str(self._by.get("by") or "unknown"))
        from fieldtwin.plc.debug.session import Session
        from fieldtwin.plc.debug.tracer import Tracer

        self._note("debug", args)
        self._number += 1
        self._by = {"by": args.get("by", "")}
        tracer = Tracer(self._stopped, self._logged, self._wait)
        tracer.stop_on_errors = False
        self._session = Session(self._send, tracer, self._resume)
        self.programs_changed()
        self._runner.execute_every_scan()
        self._guard.tracer, self._guard.passed = tracer, self._scan_ended

    def programs_changed(self) -> None:
        """Use the programs that run now, after they were created again or replaced."""
        if self._session is not None:
            units = {id(unit): unit for b in self._runner.programs if (unit := getattr(b.program, "st_unit", None))}
            self._session.show(list(units.values()), {})

    def _detach(self) -> None:
        """End the session; a stopped scan goes on."""
        session, self._session = self._session, None
        if session is None:
            return
        session.tracer.release()
        self._runner.execute_every_scan(always=False)
        if self._place:
            from fieldtwin.plc.debug.tracer import Resume

            self._resume(Resume.CONTINUE)
        elif not self._runner.outputs.withheld:  # else the next scan publishes them, also a step of a paused PLC
            self._guard.tracer = None

    def _send(self, kind: str, **more: Any) -> None:
        if len(self._messages) >= MAX_MESSAGES and more.get("event") == "output":
            self._dropped += 1
        else:
            self._messages.append({"kind": kind, **more})

    # -- in a scan ----------------------------------------------------------------------------------------------------------

    def _logged(self, frame: FrameType, text: str) -> None:
        if self._session is not None:
            self._session.logged(frame, text)

    def _stopped(self, reason: str, text: str) -> None:
        if self._session is not None:
            frame = self._session.tracer.frames[0].frame
            self._place = f"{frame.f_code.co_filename}:{frame.f_lineno}"
            self._session.stopped(reason, text)

    def _resume(self, how: Resume) -> None:
        self._resumed = how
        self._waiting.loop.call_soon(self._waiting.loop.stop)

    def _wait(self) -> Resume:
        """Serve the control channel until the scan may go on. This is called inside the scan, while the loop does not run."""
        from fieldtwin.plc.debug.tracer import Resume

        guard, waiting, outputs = self._guard, self._waiting, self._runner.outputs
        if guard.inner is not None:
            guard.inner.disarm()
        self._was_stopped = outputs.withheld = True
        outputs.stop(waiting.now_ns())
        self._resumed = None
        while self._resumed is None and self._session is not None:
            if waiting.ending() or waiting.now_ns() - self._seen_ns > LEASE_NS:
                self._detach()
                break
            timer = waiting.loop.call_later(LOOK_S, waiting.loop.stop)
            waiting.loop.run_forever()
            timer.cancel()
        self._place = ""
        self._runner.excuse()
        if guard.inner is not None:
            guard.inner.arm()
        return self._resumed or Resume.CONTINUE

    def _scan_ended(self) -> None:
        """Publish the outputs again after a scan without a stop. Forget a client that has gone."""
        if not self._was_stopped:
            self._runner.outputs.withheld = False
        self._was_stopped = False
        if self._session is not None and self._waiting.now_ns() - self._seen_ns > LEASE_NS:
            self._detach()
        if self._session is None and not self._runner.outputs.withheld:
            self._guard.tracer = None
