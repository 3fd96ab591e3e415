"""Start one process of fieldtwin repeatedly without a new import each time: ``python many_kills.py MODULE ARG...``.

Each line on standard input forks a process that runs the module as ``python -m MODULE ARG...`` does, with its output in the
file named by the line, and prints its process id. The test kills the process.
"""

from __future__ import annotations

import importlib
import os
import runpy
import signal
import sys
import warnings
from pathlib import Path


def become(module: str, args: list[str], log: str) -> None:
    """Run the module to its end; this never returns."""
    code = 70
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.argv = [module, *args]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # the module was imported before
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        code = 0
    except SystemExit as e:
        code = e.code if isinstance(e.code, int) else int(e.code is not None)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def main() -> None:
    module, args = sys.argv[1], sys.argv[2:]
    for name in (module, *filter(None, os.environ.get("MANY_KILLS_IMPORT", "").split(","))):
        importlib.import_module(name)
    Path(os.environ["MANY_KILLS_READY"]).touch()
    for line in sys.stdin:
        child = os.fork()
        if not child:
            become(module, args, line.strip())
        print(child, flush=True)
        os.waitpid(child, 0)
        print("ended", flush=True)


if __name__ == "__main__":
    main()
