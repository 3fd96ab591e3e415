"""What lies outside a virtual run is sealed off while it runs: clocks, sleep, sockets, threads, processes.

The loop itself refuses what asyncio offers; here is what any code can reach past it. Clocks are attributes of ``time``, which
are replaced; the rest are audit events of the interpreter (PEP 578), which cannot be evaded. Only the sealed thread is watched.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from emulators.virtual.loop import escape

_CLOCKS = ("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "sleep")
_LOGGING = "logging"
"""A log record is stamped with the wall clock; nothing of a run depends on it."""
_EVENTS = {
    "socket.__new__": "a socket",
    "socket.connect": "a connection",
    "socket.bind": "a socket",
    "_thread.start_new_thread": "a thread",
    "_thread.start_joinable_thread": "a thread",  # these two from Python 3.12 and 3.13 on
    "subprocess.Popen": "a process",
    "os.fork": "a process",
    "os.posix_spawn": "a process",
    "os.system": "a process",
}
_sealed: set[int] = set()
"""Identities of the threads in which a virtual run is under way."""
_hooked = False


def _audit(event: str, args: tuple[Any, ...]) -> None:
    if _sealed and event in _EVENTS and threading.get_ident() in _sealed:
        raise escape(_EVENTS[event])


def _guarded(real: Callable[..., Any]) -> Callable[..., Any]:
    name = f"time.{real.__name__}"

    def guard(*args: Any) -> Any:
        if threading.get_ident() in _sealed and sys._getframe(1).f_globals.get("__name__") != _LOGGING:
            raise escape(name)
        return real(*args)

    return guard


def _unstartable(real: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    def start(self: threading.Thread) -> None:
        if threading.get_ident() in _sealed:
            raise escape("a thread")
        real(self)

    return start


@contextmanager
def sealed() -> Iterator[None]:
    """In this thread, until the end: any escape raises `Escape`. May not be nested."""
    global _hooked
    if not _hooked:  # an audit hook cannot be taken away: it stays, and looks at a set
        sys.addaudithook(_audit)
        _hooked = True
    kept = {name: getattr(time, name) for name in _CLOCKS}
    for name, real in kept.items():
        setattr(time, name, _guarded(real))
    start = threading.Thread.start
    threading.Thread.start = _unstartable(start)  # type: ignore[method-assign, assignment]
    _sealed.add(threading.get_ident())
    try:
        yield
    finally:
        _sealed.discard(threading.get_ident())
        threading.Thread.start = start  # type: ignore[method-assign]
        for name, real in kept.items():
            setattr(time, name, real)
