"""The process that runs the prototype of an exported FMU: ``python -m fieldtwin.run.fmu_export.child_process FOLDER``.

FOLDER has the resources of the FMU. The tool's process writes requests to the standard input and reads answers from the standard
output, one JSON object a line (`fieldtwin.run.fmu_export.slave`). The process ends with the tool's process, whose end closes
the standard input.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import BinaryIO

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.run.fmu_export.packing import INTERFACE, TEMPLATE, Description
from fieldtwin.run.fmu_export.stepped_run import Advance, Shown, SteppedRun
from fieldtwin.run.template import system_file
from fieldtwin.run.virtual.run import VirtualOptions

MAX_LINE = 1 << 20
"""The largest request, in bytes."""


class Begin(msgspec.Struct, frozen=True):
    """The first request: the parameters of the FMU. `trace` is a file for every event, or empty."""

    seed: int
    trace: str = ""


class Request(msgspec.Struct, frozen=True):
    """A further request: a step, or the end of the run."""

    end: bool = False
    until_ns: int = 0
    set: dict[str, float | None] = {}


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    """The outputs after a step, the result at the end of the run, or an error."""

    values: list[float | int | bool | str | None] = []
    good: list[bool] = []
    version: str = ""
    result: str = ""
    error: str = ""


def main(argv: list[str]) -> None:
    """Run the prototype until the tool ends it. Errors are answers: the tool shows them as a message of the FMU."""
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a program of the system may print
    try:
        result = _run(Path(argv[0]), requests, answers)
    except FieldtwinError as e:
        _send(answers, Answer(error=str(e)))
    except Exception as e:  # a bug of fieldtwin must reach the tool as a message, not as a lost process
        _send(answers, Answer(error=f"internal error, please report it: {type(e).__name__}: {e}"))
    else:
        _send(answers, Answer(result=result))


def _run(folder: Path, requests: BinaryIO, answers: BinaryIO) -> str:
    description = msgspec.json.decode((folder / INTERFACE).read_bytes(), type=Description)
    begin = msgspec.json.decode(requests.readline(MAX_LINE) or b"{}", type=Begin)
    sources = {port.name: port.source for port in description.interface.inputs}

    def next_step(shown: Shown) -> Advance | None:
        _send(answers, Answer(shown.values, shown.good, __version__))
        line = requests.readline(MAX_LINE)
        request = msgspec.json.decode(line, type=Request) if line else Request(end=True)
        if request.end:
            return None
        return Advance(request.until_ns, {sources[name]: value for name, value in request.set.items()})

    system = system_file(str(folder / TEMPLATE), lambda parts: True, virtual=True)
    options = VirtualOptions(system, 0.0, begin.seed, trace=Path(begin.trace) if begin.trace else None)
    run = SteppedRun(options, description.interface.outputs, next_step)
    run.run_steps()
    return _result(run)


def _result(run: SteppedRun) -> str:
    """Return the result of a run in one line. Raises `UsageError` with the errors that ended it."""
    if run.errors:
        raise UsageError("; ".join(run.errors)[:2000])
    summary = run.summary()
    verdict = "ok" if summary["ok"] else "not ok: a check of the run failed, see fieldtwin simulate"
    return (
        f"{run.elapsed_s:g} s of virtual time, seed {run.seed}, {summary['trace']['events']} events, "
        f"SHA-256 {summary['trace']['sha256']}: {verdict}"
    )


def _send(to: BinaryIO, answer: Answer) -> None:
    to.write(msgspec.json.encode(answer) + b"\n")
    to.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
