"""Ends a scan that does not end under virtual time, by real time: a thread raises `ScanStuck` in the logic.

Virtual time stands still during a scan, and a timer signal would take SIGALRM from the program around it, such as pytest. So
a thread counts its own waits while one scan lasts. A process that stood still meanwhile (SIGSTOP, a suspended host) loses one
wait and not the whole limit. The thread cannot end logic that never returns to the interpreter (a C function that never ends).
"""

from __future__ import annotations

import ctypes
import threading

from fieldtwin.plc.program import ScanStuck

LIMIT_S = 10.0
"""The limit in seconds of real time for each scan under virtual time, if `stuck_ms` in the system file is not longer."""
WAITS = 10
"""The waits into which the limit is divided."""


class ScanWatchdog:
    """A guard of a task, for the thread that creates it. `close` ends its own thread."""

    def __init__(self, limit_s: float = LIMIT_S) -> None:
        message = f"{limit_s:g} s of real time and no end"

        class Endless(ScanStuck):
            def __init__(self) -> None:
                super().__init__(message)

        self._error = Endless
        self._wait_s = limit_s / WAITS
        self._logic = threading.get_ident()
        self._lock = threading.Lock()
        self._scan = 0
        self._armed = self._fired = False
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="scan watchdog", daemon=True)
        self._thread.start()

    def arm(self) -> None:
        """Begin to watch a scan."""
        self._scan += 1
        self._armed = True

    def disarm(self) -> None:
        """The scan has ended. Nothing is raised after this."""
        with self._lock:
            self._armed = False
            if self._fired:  # it may not have been raised yet
                self._fired = False
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._logic), None)

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _watch(self) -> None:
        seen, waits = 0, 0
        while not self._closed.wait(self._wait_s):
            with self._lock:
                waits = waits + 1 if self._armed and self._scan == seen else 0
                seen = self._scan
                if waits >= WAITS:  # again at each wait: logic may catch everything once
                    self._fired = True
                    error = ctypes.py_object(self._error)
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._logic), error)
