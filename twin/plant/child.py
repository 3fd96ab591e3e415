"""A child process that shuts down in order when its parent dies, however the parent dies.

``python -m fieldtwin.twin.plant.child PARENT_PID LINGER_S MODULE [ARG...]`` runs ``python -m MODULE ARG...`` in this
way. The process of the simulated field devices lingers: the gateway needs it for a moment longer, to set its outputs to
safe values.
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
    """Raise SIGTERM in this process `linger_s` seconds after the process `parent` has ended, of which the kernel notifies this
    process (prctl).

    Linux only; on other systems this function does nothing.
    """
    if not sys.platform.startswith("linux"):
        return

    libc = ctypes.CDLL(None, use_errno=True)
    if linger_s <= 0:  # no interval timer is used here, because the PLC uses it itself
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # the parent died before the request
            os.kill(os.getpid(), signal.SIGTERM)
        return

    def parent_ended(number: int, frame: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, linger_s)

    def linger_over(number: int, frame: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGHUP, parent_ended)
    signal.signal(signal.SIGALRM, linger_over)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGHUP, 0, 0, 0)
    if os.getppid() != parent:  # the parent died before the request
        os.kill(os.getpid(), signal.SIGHUP)


def allow_open_files() -> None:
    """Raise this process's limit of open files to its maximum, at most `MOST_FILES`: 1,000 devices need 2,000 sockets.

    The usual limit of 1,024 is for programs that use select(2). This project does not use it.
    """
    try:
        import resource
    except ImportError:  # Windows, which has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def command(module: str, *args: str, linger_s: float = 0.0) -> list[str]:
    """Return the command line that runs `module` as a child of this process."""
    # -P: do not import modules from the user's working folder, such as a yaml.py of the user.
    return [sys.executable, "-P", "-m", "fieldtwin.twin.plant.child", str(os.getpid()), str(linger_s), module, *args]


def main(argv: list[str]) -> None:
    """Run the named module in this process."""
    parent, linger_s, module = int(argv[0]), float(argv[1]), argv[2]
    end_with_parent(parent, linger_s)
    allow_open_files()
    sys.argv = [module, *argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1:])
