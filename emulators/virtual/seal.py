"""Prevent a virtual run from using the computer's clocks, sleep, sockets, threads and processes.

The loop itself refuses asyncio's operations; this module covers the operations that bypass the loop. Clocks are
attributes of ``time`` and ``datetime``, which are replaced, also in modules that imported them by name
(`taken_clocks`). The rest is detected by audit events of the interpreter (PEP 578), which cannot be evaded. Only
threads inside `sealed` are checked.
"""

from __future__ import annotations

import datetime
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from fieldtwin.emulators.virtual.loop import escape
from fieldtwin.emulators.virtual.taken_clocks import guarded_date, replaced

_CLOCKS = (
    *("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "sleep"),
    *("process_time", "process_time_ns", "thread_time", "thread_time_ns", "clock_gettime", "clock_gettime_ns"),
)
_NOW_BY_DEFAULT = {"localtime": 1, "gmtime": 1, "ctime": 1, "asctime": 1, "strftime": 2}
"""Functions that take a time, or use the present time without that argument. For each: the number of arguments if the time is
given.
"""
_LOGGING = "logging"
"""The module that may read clocks: it stamps log records with the wall clock, and nothing in a run depends on these times."""
_EVENTS = {
    "socket.__new__": "a socket",
    "socket.connect": "a connection",
    "socket.bind": "a socket",
    "_thread.start_new_thread": "a thread",
    "_thread.start_joinable_thread": "a thread",  # Python has these two events since 3.12 and 3.13
    "subprocess.Popen": "a process",
    "os.fork": "a process",
    "os.posix_spawn": "a process",
    "os.system": "a process",
}
_sealed: set[int] = set()
"""Identities of the threads in which a virtual run is in progress."""
_hooked = False
_guards: list[tuple[Any, str, Any, Any]] = []
"""The result of `_made`, which is created once."""


def _audit(event: str, args: tuple[Any, ...]) -> None:
    if _sealed and event in _EVENTS and threading.get_ident() in _sealed:
        raise escape(_EVENTS[event])


def _guarded(real: Callable[..., Any], time_argument: int = 1 << 30) -> Callable[..., Any]:
    name = f"time.{real.__name__}"

    def guard(*args: Any) -> Any:
        if threading.get_ident() in _sealed and (len(args) < time_argument or args[time_argument - 1] is None):
            _refuse(name)
        return real(*args)

    return guard


def _refuse(name: str) -> None:
    if threading.get_ident() in _sealed and sys._getframe(2).f_globals.get("__name__") != _LOGGING:
        raise escape(name)


def _made() -> list[tuple[Any, str, Any, Any]]:
    """Return the attributes to replace: the module, the name in it, the original and its replacement."""
    clocks = [(name, 1 << 30) for name in _CLOCKS] + list(_NOW_BY_DEFAULT.items())
    made = [(time, name, getattr(time, name), time_argument) for name, time_argument in clocks if hasattr(time, name)]
    return [(module, name, real, _guarded(real, time_argument)) for module, name, real, time_argument in made] + [
        (datetime, kind.__name__, kind, guarded_date(kind, _refuse)) for kind in (datetime.datetime, datetime.date)
    ]


def _unstartable(real: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    def start(self: threading.Thread) -> None:
        if threading.get_ident() in _sealed:
            raise escape("a thread")
        real(self)

    return start


@contextmanager
def sealed() -> Iterator[None]:
    """Make any use of a real clock, sleep, socket, thread or process raise `Escape`, in this thread, until the end of the
    context.

    Contexts may not be nested.
    """
    global _hooked
    if not _hooked:  # an audit hook cannot be removed: it stays and checks a set
        sys.addaudithook(_audit)
        _hooked = True
    if not _guards:
        _guards.extend(_made())
    kept = [(module, name, getattr(module, name)) for module, name, _, _ in _guards]
    for module, name, _, guard in _guards:
        setattr(module, name, guard)
    start = threading.Thread.start
    threading.Thread.start = _unstartable(start)  # type: ignore[method-assign, assignment]
    _sealed.add(threading.get_ident())
    try:
        with replaced({id(real): (real, guard) for _, _, real, guard in _guards}):
            yield
    finally:
        _sealed.discard(threading.get_ident())
        threading.Thread.start = start  # type: ignore[method-assign]
        for module, name, was in kept:
            setattr(module, name, was)


@contextmanager
def unsealed() -> Iterator[None]:
    """Permit this thread what `sealed` refuses, until the end of the context, also if it is not sealed.

    It is for a part of a simulated device that has a separate process, such as an FMU. The caller must wait for each of its
    answers: then the run does not depend on the computer.
    """
    thread = threading.get_ident()
    was_sealed = thread in _sealed
    _sealed.discard(thread)
    try:
        yield
    finally:
        if was_sealed:
            _sealed.add(thread)
