"""The description of a trace: its system, the programs of the PLC, and the results of the checks.

A trace holds events only. The run writes the description into a second file (`about_path`) when it begins, and again with
the results when it ends. A reader does not need the programs of the system, and executes none.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input

SUFFIX = ".about.json"
VERSION = 1
MOST_BYTES = 8 << 20
"""Largest size of a description that is read. The source texts of programs are the largest part, and have at most 1 MiB."""


class CheckAbout(msgspec.Struct, frozen=True, kw_only=True):
    """A check of the run (`fieldtwin.results.model.CheckResult`). `t_ns` is None for a check that was not reached."""

    number: str
    text: str
    verdict: str
    t_ns: int | None = None
    since_ns: int | None = None
    expected: str = ""
    got: str = ""
    reason: str = ""
    where: str = ""
    names: list[str] = []


class VariableAbout(msgspec.Struct, frozen=True, kw_only=True):
    """A variable of a program. `words` are the names of its values, `tag` is the name under which it is published, and `type` its
    IEC type, empty for a program in Python."""

    tag: str
    role: str
    kind: str
    unit: str
    words: dict[str, str] = {}
    type: str = ""


class TransitionAbout(msgspec.Struct, frozen=True, kw_only=True):
    """A transition of a program. `source` is empty if it leaves any state."""

    source: str
    target: str
    label: str


class MachineAbout(msgspec.Struct, frozen=True, kw_only=True):
    """The states of a program. `declared`: whether the program declares its transitions."""

    states: list[str]
    initial: str
    transitions: list[TransitionAbout]
    declared: bool


class SourceAbout(msgspec.Struct, frozen=True, kw_only=True):
    """The source text of a program; if it is empty, `reason` says why."""

    language: str
    file: str
    text: str
    reason: str


class ProgramAbout(msgspec.Struct, frozen=True, kw_only=True):
    """A program, as `fieldtwin.plc.runtime.about` describes it."""

    variables: dict[str, VariableAbout]
    machine: MachineAbout | None
    source: SourceAbout


class TraceAbout(msgspec.Struct, frozen=True, kw_only=True):
    """The description. `finished` is false while the run continues; `checks`, `verdict` and `reason` are then empty."""

    version: int
    run: str = ""
    """A random ID of the run. It shows whether another run has written a file of the same name."""
    system: str
    """The name of the system."""
    system_path: str
    """The system file as the run read it."""
    system_hash: str
    profiles: list[str] = []
    """Further folders of profiles."""
    title: str = ""
    """The name of the scenario; empty if the run is not a scenario."""
    target: str = ""
    seed: int | None = None
    programs: dict[str, ProgramAbout] = {}
    stale_after_ms: dict[str, int | None] = {}
    """The time for which the value of each tag is good without being read again; None: forever."""
    finished: bool = False
    verdict: str = ""
    reason: str = ""
    checks: list[CheckAbout] = []
    report: str = ""
    """The HTML report of the run, as a path from the folder of the trace; empty without a report."""


def about_path(trace: Path) -> Path:
    """Return the file with the description of a trace."""
    return trace.with_name(trace.name + SUFFIX)


def write_results(
    trace: Path, about: TraceAbout | None, *, verdict: str, reason: str, checks: list[CheckAbout]
) -> None:
    """Write the description of a finished run. Does nothing for a run that has none. Raises `FileInvalid`."""
    if about is not None:
        write_about(trace, msgspec.structs.replace(about, finished=True, verdict=verdict, reason=reason, checks=checks))


def note_report(trace: Path, report: Path) -> None:
    """Name the report of a finished run in the description of its trace. Raises `FileInvalid`."""
    about = read_about(trace)
    if about is not None:
        way = os.path.relpath(report.absolute(), trace.absolute().parent)
        write_about(trace, msgspec.structs.replace(about, report=way))


def write_about(trace: Path, about: TraceAbout) -> None:
    """Write the description of a trace, in place of an older one. Raises `FileInvalid`."""
    path = about_path(trace)
    new = path.with_name(path.name + ".new")
    try:
        new.write_bytes(msgspec.json.encode(about) + b"\n")
        new.replace(path)
    except OSError as e:
        raise FileInvalid(f"cannot write the description of the trace: {e.strerror or e}", path=str(path)) from e


def read_about(trace: Path) -> TraceAbout | None:
    """Return the description of a trace, None if it does not exist. Raises `FileInvalid` for an invalid description."""
    path = about_path(trace)
    try:
        about = msgspec.json.decode(read_input(path, MOST_BYTES), type=TraceAbout)
    except FileNotFoundError:
        return None
    except OSError as e:
        raise FileInvalid(f"cannot read the description of the trace: {e.strerror or e}", path=str(path)) from e
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as e:
        raise FileInvalid(
            f"not the description of a trace: {e}",
            path=str(path),
            hint="delete it, and name the system of the trace with --system",
        ) from e
    if about.version != VERSION:
        raise FileInvalid(
            "the description of the trace has another version",
            path=str(path),
            expected=str(VERSION),
            got=str(about.version),
        )
    return about
