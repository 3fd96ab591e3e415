"""A process that belongs to another: it ends in order when the one that started it dies, however that dies.

``python -m fieldtwin.twin.plant.child PARENT_PID LINGER_S MODULE [ARG...]`` runs ``python -m MODULE ARG...`` like this. What
stands for the plant lingers: the gateway needs it for a moment more, to make its outputs safe.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

_PR_SET_PDEATHSIG = 1  # linux/prctl.h

MOST_FILES = 65_536


def end_with_parent(parent: int, linger_s: float = 0.0) -> None:
    """Let the kernel tell us when the process `parent` ends, and take it as SIGTERM `linger_s` seconds later.

    Linux only; elsewhere nothing happens.
    """
    if not sys.platform.startswith("linux"):
        return

    libc = ctypes.CDLL(None, use_errno=True)
    if linger_s <= 0:  # no timer: the PLC's own use of it would be lost
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # it died before we asked
            os.kill(os.getpid(), signal.SIGTERM)
        return

    def parent_ended(number: int, frame: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, linger_s)

    def linger_over(number: int, frame: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGHUP, parent_ended)
    signal.signal(signal.SIGALRM, linger_over)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGHUP, 0, 0, 0)
    if os.getppid() != parent:  # it died before we asked
        os.kill(os.getpid(), signal.SIGHUP)


def allow_open_files() -> None:
    """Let this process open as many files as it may, `MOST_FILES` at most: 1,000 devices are 2,000 sockets, and where a
    process begins with 1,024 it is for programs that use select(2), which we do not."""
    try:
        import resource
    except ImportError:  # Windows, which has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def command(module: str, *args: str, linger_s: float = 0.0) -> list[str]:
    """The command line that runs `module` as a child of this process."""
    # -P: a module in the folder in which the user works, such as their own yaml.py, is none of ours.
    return [sys.executable, "-P", "-m", "fieldtwin.twin.plant.child", str(os.getpid()), str(linger_s), module, *args]


def main(argv: list[str]) -> None:
    """Become the module that is named."""
    parent, linger_s, module = int(argv[0]), float(argv[1]), argv[2]
    end_with_parent(parent, linger_s)
    allow_open_files()
    sys.argv = [module, *argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1:])
