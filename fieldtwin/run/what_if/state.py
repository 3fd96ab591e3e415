"""The known state of a system at one instant: the values of its devices, and the variables of its programs.

It is read from a file or from a running instance; from a knowledge store by `fieldtwin.run.what_if.known`. Values that were
not good are not known. This module must never know how a fork is started from the state.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import msgspec

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus
from fieldtwin.plc.status import WholePlcStatus
from fieldtwin.twin.site.system import System

VERSION = 1
MAX_BYTES = 16 << 20
Number = float | int | str | bool
S = TypeVar("S", bound=msgspec.Struct)


class _File(msgspec.Struct, forbid_unknown_fields=True):
    fieldtwin_state: int
    system: str
    utc_ms: int = 0
    values: dict[str, Number] = {}
    programs: dict[str, dict[str, Number]] = {}


@dataclass(frozen=True)
class KnownState:
    """The known state. `values`: DEVICE.TAG -> value in engineering units; `programs`: program -> variable -> value.
    `utc_ms` is 0 if the time is unknown.

    `retained` is a PLC's file of retained variables, if there is one.
    """

    values: Mapping[str, Number] = field(default_factory=dict)
    programs: Mapping[str, Mapping[str, Number]] = field(default_factory=dict)
    utc_ms: int = 0
    source: str = "the initial state"
    retained: Path | None = None

    def dump(self, system: System) -> str:
        """Return the text of a file that `read_state` accepts."""
        values = {k: v for k, v in self.values.items() if not (isinstance(v, float) and math.isnan(v))}
        form = _File(VERSION, system.name, self.utc_ms, values, {p: dict(v) for p, v in self.programs.items()})
        return json.dumps(msgspec.to_builtins(form), indent=1) + "\n"


def read_state(path: Path, system: System) -> KnownState:
    """Read a state file. Raises `FileInvalid`, also for names that the system does not have."""
    with reading(path):
        data = read_input(path, MAX_BYTES)
    if not data:
        raise FileInvalid("not a state of a system", path=str(path), expected=f"JSON of at most {MAX_BYTES >> 20} MiB")
    try:
        form = msgspec.json.decode(data, type=_File)
    except msgspec.MsgspecError as e:
        raise FileInvalid(
            "not a state of a system", path=str(path), expected="as --save-state writes it", got=str(e)
        ) from e
    if form.fieldtwin_state != VERSION:
        raise FileInvalid(
            "a state in a different format version",
            path=str(path),
            expected=str(VERSION),
            got=str(form.fieldtwin_state),
        )
    if form.system != system.name:
        raise FileInvalid("the state of a different system", path=str(path), expected=system.name, got=form.system)
    for name in form.values:
        device, _, tag = name.partition(".")
        if device not in system.devices or tag not in system.devices[device].profile.tags:
            raise FileInvalid(f"the system has no tag {name!r}", path=str(path), expected="DEVICE.TAG")
    for program in form.programs:
        if program not in system.plc.programs:
            expected = ", ".join(system.plc.programs)
            raise FileInvalid(f"the system has no program {program!r}", path=str(path), expected=expected)
    return KnownState(form.values, form.programs, form.utc_ms, str(path))


async def of_instance(run_dir: Path, system: System) -> KnownState:
    """Return the state of a running instance of `system`, from its control channels.

    Raises `Unreachable`, and `UsageError` if the instance runs a different system.
    """
    gateway = await _asked(run_dir / "gateway.sock", GatewayStatus)
    plc = await _asked(run_dir / "plc.sock", WholePlcStatus)
    if (runs := gateway.config.system if gateway.config else "") != system.name:
        raise UsageError(f"the instance {run_dir.name!r} runs a different system", expected=system.name, got=runs)
    values = {name: tag.value for name, tag in gateway.tags.items() if tag.quality == "good" and tag.value is not None}
    programs: dict[str, dict[str, Number]] = {}
    for name, value in plc.variables.items():
        program, _, variable = name.partition(".")
        if isinstance(value, int | float | str):
            programs.setdefault(program, {})[variable] = value
    retained = run_dir / "retain"
    return KnownState(values, programs, 0, f"instance {run_dir.name}", retained if retained.is_file() else None)


async def _asked(socket: Path, kind: type[S]) -> S:
    client = await ControlClient.connect_unix(socket)
    try:
        return await client.ask("get", kind)
    finally:
        await client.aclose()
