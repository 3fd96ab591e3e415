"""Every module can be imported without Unix's own modules, in a separate process: Windows' standard library without further
modules that it lacks. Functions that need them report it when used. No module is imported under a second name."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import sys
import serial, can, mcp, distributed  # third-party libraries that choose their modules by the name of the system
HIDDEN = {"termios", "fcntl", "pty", "tty", "resource", "grp", "pwd", "crypt", "syslog", "readline", "posix_ipc"}

class Hide:
    def find_spec(self, name, path=None, target=None):
        if name in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

for name in HIDDEN:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hide())

import importlib, os, pkgutil, signal, socket
# Names of modules that Windows has, and that are not in them there.
for module, names in (
    (os, ("openpty", "getuid", "geteuid", "getgid", "getgroups", "getloadavg", "sched_setscheduler", "SCHED_FIFO")),
    (signal, ("SIGHUP", "SIGALRM", "SIGUSR1", "setitimer", "ITIMER_REAL")),
    (socket, ("AF_UNIX", "AF_CAN", "PF_CAN", "CAN_RAW")),
):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)

failed, count = [], 0
import fieldtwin
for found in pkgutil.walk_packages(fieldtwin.__path__, "fieldtwin."):
    if found.name.endswith("__main__"):
        continue
    count += 1
    try:
        importlib.import_module(found.name)
    except ImportError as e:
        if e.name in HIDDEN:
            failed.append(f"{found.name}: {e}")
        elif e.name not in OPTIONAL:
            failed.append(f"{found.name}: {e!r}")
    except AttributeError as e:
        failed.append(f"{found.name}: {e!r}")
failed += sorted({"gateway", "plc", "emulators", "twin"} & set(sys.modules))  # a second name of a module of ours
print(count, *failed, sep="\\n")
from fieldtwin.cli.main import cli
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
import pathlib
try:
    PtyEnd.open(pathlib.Path("x"), Endpoint.parse("pty:x")).send(None)  # not a loop: socketpair has lost AF_UNIX
except Unreachable as e:
    print("said:", e)
"""

OPTIONAL = {"aiomqtt", "asyncpg", "matplotlib", "pyarrow", "uvloop", "paho"}


@pytest.mark.timeout(200)
def test_everything_is_imported_without_the_modules_of_unix() -> None:
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", f"OPTIONAL = {OPTIONAL!r}\n{PROGRAM}"],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    count, *rest = done.stdout.splitlines()
    assert int(count) > 500
    assert rest == ["said: pty:x: this system has no virtual serial ports (emulate on tcp, or on a real serial port)"]
