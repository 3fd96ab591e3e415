"""An event loop with simulated time: it does not wait, but advances its time to the next timer.

The unmodified gateway, PLC and emulators run on it. Every operation that needs the operating system (a socket, a thread, a
process, a signal) raises `Escape` with the place of the call, because a run that depends on it could not be repeated.
Callbacks of one instant run in the order in which they were scheduled, timers by (when, sequence); no set of tasks is
ever iterated.
"""

from __future__ import annotations

import asyncio
import sys
from asyncio import events
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Generator
from contextlib import suppress
from contextvars import Context, copy_context
from heapq import heapify, heappop, heappush
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar, TypeVarTuple

from fieldtwin.emulators.virtual.cycles import CycleCall, CycleTimers, skip_runs
from fieldtwin.emulators.virtual.interrupts import Interrupts
from fieldtwin.emulators.virtual.scheduled_call import ScheduledCall
from fieldtwin.emulators.virtual.waiting import waits_at
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.cycle import Cycle
from fieldtwin.gateway.core.errors import Bug

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
Due = ScheduledCall | asyncio.Future[None]

START_NS = 1_000 * NS_PER_S
"""The start of monotonic time. It is not 0, because 0 means "never" in many places."""
STUCK_AFTER = 1_000_000
"""The number of callbacks at one instant after which the loop reports that time does not advance."""
ENDING_INSTANTS = 10_000
"""The number of instants within which a task must end after its loop is closed."""
_WAITING_SHOWN = 20
_COMPACT_AFTER = 1_000
"""The number of new timers after which the loop removes timers that are no longer needed."""


class Escape(Bug):
    """Code that runs in virtual time used a thread, a socket, a process or a wall clock."""


class Deadlock(Bug):
    """The loop can never continue: no callback is ready and no timer is set, or callbacks schedule each other endlessly at one
    instant.
    """


def _way_out(name: str) -> Callable[..., NoReturn]:
    def refuse(self: VirtualLoop, *args: Any, **kwargs: Any) -> NoReturn:
        raise escape(f"loop.{name}")

    refuse.__name__ = name
    return refuse


class VirtualLoop(asyncio.AbstractEventLoop):
    """An event loop in virtual time; `now_ns` is its time. It is not thread-safe: a call from a different thread raises
    `Escape`.
    """

    def __init__(self, start_ns: int = START_NS) -> None:
        self.now_ns = start_ns
        self.callbacks = 0
        """The number of callbacks that have run."""
        self._ready: deque[ScheduledCall | CycleCall] = deque()
        self._timers: list[tuple[int, int, Any]] = []
        """The timers as (when in ns, sequence, call or future)."""
        self._cycles: CycleTimers = []
        """The timers of cycles. Their sequence numbers are of one series with those of `_timers`."""
        self._sequence = 0
        self._compact_at = _COMPACT_AFTER
        self._tasks = 0
        self._running = self._stopping = self._stopped = self._closed = False
        self._handler: Callable[[asyncio.AbstractEventLoop, dict[str, Any]], object] | None = None
        self.unhandled: list[dict[str, Any]] = []
        """Unhandled errors in order, reported when the loop's run ends."""

    # -- time and callbacks -------------------------------------------------------------------------------------------

    def time(self) -> float:
        return self.now_ns / NS_PER_S

    def call_soon(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        call = ScheduledCall(callback, args, copy_context() if context is None else context)
        self._ready.append(call)
        return call  # type: ignore[return-value]  # it has the methods of a handle

    def call_later(
        self, delay: float, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        return self.call_at_ns(self.now_ns + round(delay * NS_PER_S), callback, *args, context=context)

    def call_at(
        self, when: float, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        return self.call_at_ns(round(when * NS_PER_S), callback, *args, context=context)

    def call_at_ns(
        self, when_ns: int, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Schedule a callback as `call_at` does, with a time in ns. A time in the past is due now, after the ready callbacks."""
        call = ScheduledCall(callback, args, copy_context() if context is None else context, when_ns / NS_PER_S)
        self.set_timer(when_ns, call)
        return call  # type: ignore[return-value]  # it has the methods of a timer handle

    def sleeper(self, when_ns: int) -> asyncio.Future[None]:
        """Return a future that is done at `when_ns`, for a clock's sleep.

        With `call_at_ns` instead of a future among the timers, a virtual run takes 2 to 6 % longer.
        """
        future: asyncio.Future[None] = asyncio.Future(loop=self)
        self.set_timer(when_ns, future)
        return future

    async def run_cycle(self, cycle: Cycle) -> None:
        """Run `cycle` at its deadlines until it no longer runs, and skip runs that would change nothing. The errors of a run are
        raised.
        """
        ended: asyncio.Future[None] = asyncio.Future(loop=self)
        call = CycleCall(self, cycle, ended)
        if cycle.deadline_ns > self.now_ns:
            self.set_cycle_timer(cycle.deadline_ns, call)
        else:
            call.run()
        await ended

    def timer(self, delay_s: float) -> asyncio.Future[None]:
        """Return a future that is done after a delay in seconds, see `fieldtwin.gateway.core.concurrency.timeout`.

        The caller may set the future earlier.
        """
        return self.sleeper(self.now_ns + round(delay_s * NS_PER_S))

    def set_timer(self, when_ns: int, due: Due) -> None:
        """Set the timer of a call or a future."""
        self._sequence += 1
        heappush(self._timers, (when_ns if when_ns > self.now_ns else self.now_ns, self._sequence, due))
        if self._sequence >= self._compact_at:
            self._compact()

    def set_cycle_timer(self, when_ns: int, call: CycleCall) -> None:
        """Set the timer of the next run of a cycle."""
        self._sequence += 1
        heappush(self._cycles, (when_ns if when_ns > self.now_ns else self.now_ns, self._sequence, call))

    def _compact(self) -> None:
        """Remove the timers that are no longer needed.

        The next removal is due after half as many new timers as now remain.
        """
        self._timers = [entry for entry in self._timers if not _is_over(entry[2])]
        heapify(self._timers)
        self._compact_at = self._sequence + max(_COMPACT_AFTER, len(self._timers) // 2)

    # -- futures and tasks --------------------------------------------------------------------------------------------

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)

    def create_task(  # Python 3.14 passes more keyword arguments, all for Task
        self, coro: Generator[Any, None, T] | Coroutine[Any, Any, T], *, name: object = None, **more: Any
    ) -> asyncio.Task[T]:
        self._tasks += 1
        more.pop("eager_start", None)
        return asyncio.Task(coro, loop=self, name=str(name) if name else f"task {self._tasks}", **more)

    def set_task_factory(self, factory: Any) -> None:
        """Raise `Bug`: a virtual loop has only one way of creating tasks."""
        raise Bug("a task factory on a virtual loop")

    def get_task_factory(self) -> None:
        return None

    get_debug: Any = bool
    """A function that returns False without a call of Python code, because each new future and handle calls it."""

    def set_debug(self, enabled: bool) -> None:
        """Do nothing: debug mode is not supported, because asyncio's debug mode measures with the wall clock."""

    # -- running ------------------------------------------------------------------------------------------------------

    def run_until_complete(self, future: Generator[Any, None, T] | Awaitable[T]) -> T:
        """Run until `future` is done. Raises `Deadlock` if it never will be."""
        main: asyncio.Future[T] = asyncio.ensure_future(future, loop=self)  # type: ignore[arg-type]  # a generator too
        main.add_done_callback(self._on_done)
        try:
            self.run_forever()
        finally:
            main.remove_done_callback(self._on_done)
        if not main.done():
            raise Bug("the virtual loop was stopped before its main task was done")
        return main.result()

    def _on_done(self, future: asyncio.Future[Any]) -> None:
        self.stop()

    def run_forever(self) -> None:
        """Run until `stop` is called. Raises `Deadlock` if no callback is ready and no timer is set."""
        if self._running or events._get_running_loop() is not None:
            raise Bug("a virtual loop inside another loop")
        self._running = True
        events._set_running_loop(self)
        try:
            with Interrupts(self._pause) as interrupts:
                while not self._stopped:
                    self._stopping = False
                    interrupts.deliver()
                    while not self._stopping:
                        self._run_instant()
        finally:
            self._stopping = self._stopped = self._running = False
            events._set_running_loop(None)

    def _run_instant(self) -> None:
        """Run all ready callbacks and those that they schedule, then advance to the next timer's instant."""
        ready, pop, run = self._ready, self._ready.popleft, 0
        while ready and not self._stopping:
            call = pop()
            if call.is_cancelled:
                continue
            try:
                call.context.run(call.callback, *call.args)
            except (SystemExit, KeyboardInterrupt):
                raise
            except BaseException as e:  # an unhandled error, as in every loop of asyncio
                self.call_exception_handler(
                    {"message": f"Exception in callback {call}", "exception": e, "handle": call}
                )
            run += 1
            if run == STUCK_AFTER:
                raise Deadlock("virtual time stands still: callbacks schedule each other without end", got=str(call))
        self.callbacks += run
        if not self._stopping:
            self._advance()

    def _advance(self) -> None:
        timers, cycles, ready = self._timers, self._cycles, self._ready
        if cycles and timers and cycles[0][0] < timers[0][0]:
            self._sequence = skip_runs(cycles, timers[0][0], self._sequence)
        now_ns = None
        while timers or cycles:
            first: list[Any] = cycles if cycles and (not timers or cycles[0] < timers[0]) else timers
            when_ns = first[0][0]
            if now_ns is not None and when_ns != now_ns:
                break
            due = heappop(first)[2]
            if isinstance(due, asyncio.Future):
                if due.done():
                    continue
                due.set_result(None)
            elif due.is_cancelled:
                continue
            else:
                ready.append(due)
            self.now_ns = now_ns = when_ns
        if now_ns is None:
            raise Deadlock("a deadlock: nothing is ready and no timer is set", got=self._who_waits())

    def _who_waits(self) -> str:
        tasks = sorted(asyncio.all_tasks(self), key=lambda task: task.get_name())
        shown = [f"{task.get_name()} at {waits_at(task, _is_plumbing)}" for task in tasks[:_WAITING_SHOWN]]
        more = len(tasks) - len(shown)
        return "; ".join(shown) + (f"; and {more} more" if more > 0 else "")

    def stop(self) -> None:
        self._stopping = self._stopped = True

    def _pause(self) -> None:
        """Stop after the current callback, so that a signal can be delivered."""
        self._stopping = True

    def is_running(self) -> bool:
        return self._running

    def is_closed(self) -> bool:
        return self._closed

    def close(self) -> None:
        """End the tasks that an error or Ctrl-C left, and drop all scheduled callbacks."""
        if self._running:
            raise Bug("a running loop cannot be closed")
        self._end_tasks()
        self._closed = True
        self._ready.clear()
        self._timers.clear()
        self._cycles.clear()

    def _end_tasks(self) -> None:
        """End the remaining tasks, as `asyncio.run` does. Their errors, and a task that does not end, are ignored."""
        tasks = sorted(asyncio.all_tasks(self), key=lambda task: task.get_name())
        if not tasks or events._get_running_loop() is not None:
            return
        for task in tasks:
            task.cancel()
        self._running = True
        events._set_running_loop(self)
        try:
            with suppress(KeyboardInterrupt, SystemExit, Deadlock), Interrupts(self._pause):
                for _ in range(ENDING_INSTANTS):
                    if all(task.done() for task in tasks):
                        break
                    self._stopping = False
                    with suppress(
                        KeyboardInterrupt, SystemExit
                    ):  # the exception that ended the run also ends each task that receives it
                        self._run_instant()
        finally:
            self._stopping = self._stopped = self._running = False
            events._set_running_loop(None)

    async def shutdown_asyncgens(self) -> None:
        """Do nothing: asynchronous generators are not tracked."""

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:
        """Do nothing: the loop has no executor."""

    # -- unhandled errors ---------------------------------------------------------------------------------------------

    def get_exception_handler(self) -> Callable[[asyncio.AbstractEventLoop, dict[str, Any]], object] | None:
        return self._handler

    def set_exception_handler(
        self, handler: Callable[[asyncio.AbstractEventLoop, dict[str, Any]], object] | None
    ) -> None:
        self._handler = handler

    def default_exception_handler(self, context: dict[str, Any]) -> None:
        self.unhandled.append(context)

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        (self._handler or type(self).default_exception_handler)(self, context)

    # -- ways out -----------------------------------------------------------------------------------------------------

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        raise escape("a call from another thread")

    run_in_executor: Any = _way_out("run_in_executor")
    set_default_executor: Any = _way_out("set_default_executor")
    getaddrinfo: Any = _way_out("getaddrinfo")
    getnameinfo: Any = _way_out("getnameinfo")
    create_connection: Any = _way_out("create_connection")
    create_server: Any = _way_out("create_server")
    create_datagram_endpoint: Any = _way_out("create_datagram_endpoint")
    create_unix_connection: Any = _way_out("create_unix_connection")
    create_unix_server: Any = _way_out("create_unix_server")
    connect_accepted_socket: Any = _way_out("connect_accepted_socket")
    start_tls: Any = _way_out("start_tls")
    sendfile: Any = _way_out("sendfile")
    sock_sendfile: Any = _way_out("sock_sendfile")
    sock_recv: Any = _way_out("sock_recv")
    sock_recv_into: Any = _way_out("sock_recv_into")
    sock_recvfrom: Any = _way_out("sock_recvfrom")
    sock_recvfrom_into: Any = _way_out("sock_recvfrom_into")
    sock_sendall: Any = _way_out("sock_sendall")
    sock_sendto: Any = _way_out("sock_sendto")
    sock_connect: Any = _way_out("sock_connect")
    sock_accept: Any = _way_out("sock_accept")
    connect_read_pipe: Any = _way_out("connect_read_pipe")
    connect_write_pipe: Any = _way_out("connect_write_pipe")
    subprocess_shell: Any = _way_out("subprocess_shell")
    subprocess_exec: Any = _way_out("subprocess_exec")
    add_reader: Any = _way_out("add_reader")
    remove_reader: Any = _way_out("remove_reader")
    add_writer: Any = _way_out("add_writer")
    remove_writer: Any = _way_out("remove_writer")
    add_signal_handler: Any = _way_out("add_signal_handler")
    remove_signal_handler: Any = _way_out("remove_signal_handler")


def _is_over(due: Due) -> bool:
    """Return whether the timer is no longer needed."""
    return due.done() if isinstance(due, asyncio.Future) else due.is_cancelled


def culprit() -> str:
    """Describe the code that caused a call: the innermost frame outside of this package and the standard library, and its
    task.
    """
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and _is_plumbing(frame):
        frame = frame.f_back
    try:
        task = asyncio.current_task()
    except RuntimeError:
        task = None
    place = f"{frame.f_code.co_filename}:{frame.f_lineno} ({frame.f_code.co_qualname})" if frame is not None else "?"
    return f"{place}, task {task.get_name()}" if task is not None else place


_STANDARD_LIBRARY = str(Path(asyncio.__file__).parent.parent)
_HERE = str(Path(__file__).parent)


def _is_plumbing(frame: FrameType) -> bool:
    name = frame.f_code.co_filename
    ours = name.startswith(_HERE)
    return ours or (name.startswith(_STANDARD_LIBRARY) and "site-packages" not in name) or name.startswith("<")


def escape(what: str) -> Escape:
    """Return the error for the use of `what` (a socket, a thread, a clock...) in virtual time, with the place of the call."""
    return Escape(
        f"{what} under virtual time", where=culprit(), hint="time and wires come from the clock and the connector"
    )
