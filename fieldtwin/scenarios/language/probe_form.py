"""``probes:`` of a scenario: registers of any controller that are read over Modbus, under names for expressions.

    probes:
      crane: {endpoint: "tcp://192.0.2.7:502", unit: 1, every: 200ms, registers: {height: {at: 30001, type: float32}}}

Registers are written like the tags of a device profile (docs/reference/device-profile.md); they are read, never written.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import Key, Position, YamlFile

MIN_EVERY_S = 0.01
_VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")


class ProbeForm(BaseModel):
    """A probe. `endpoint` may contain ``${NAME}`` for an environment variable.

    `serve`, instead of `endpoint`, names a server of the system's own gateway, from which the probe reads.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    endpoint: str | None = None
    serve: str | None = None
    unit: Annotated[int, Field(ge=0, le=255)] = 1
    every: str | float | int = 0.2
    timeout: str | float | int = 1
    numbering: Literal["printed", "sent"] = "printed"
    order: str = "ABCD"
    type: str = "uint16"
    registers: dict[str, Any] = Field(min_length=1, max_length=1000)


@dataclass(frozen=True)
class ScenarioProbe:
    """A checked probe. Its registers are the tags of `profile`; expressions name them ``NAME.REGISTER``."""

    name: str
    profile: DeviceProfile
    endpoint: Endpoint | None
    serve: str
    unit: int
    every_s: float
    timeout_s: float
    written: str = ""
    """The endpoint as written, if it contains environment variables; `at` resolves it."""

    def at(self, environ: Mapping[str, str]) -> ScenarioProbe:
        """Return the probe with its endpoint resolved. Raises `UsageError` for an unset variable or an invalid endpoint."""
        if not self.written:
            return self
        where = f"the probe {self.name!r}"
        missing = [name for name in _VARIABLE.findall(self.written) if name not in environ]
        if missing:
            raise UsageError(
                f"{where} uses environment variables that are not set: {', '.join(missing)}",
                hint="`fieldtwin test --with -- CMD` and `fieldtwin with` set those of the system's buses",
            )
        text = _VARIABLE.sub(lambda found: environ[found[1]], self.written)
        return replace(self, endpoint=_modbus(Endpoint.parse(text), where), written="")

    @property
    def names(self) -> list[str]:
        return [f"{self.name}.{register}" for register in self.profile.tags]


def read_probe(file: YamlFile, name: str, form: ProbeForm, served: list[str]) -> ScenarioProbe:
    """Check a probe. Raises `FileInvalid` with the place of the error. `served` are the names of the servers of the system's
    gateway.
    """
    loc: tuple[Key, ...] = ("probes", name)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise file.error(loc, "a probe's name", expected="small letters, digits and _", got=name)
    if (form.endpoint is None) == (form.serve is None):
        raise file.error(loc, "a probe has one endpoint", expected="endpoint: tcp://HOST:PORT, or serve: NAME")
    if form.serve is not None and form.serve not in served:
        raise file.error(
            (*loc, "serve"), f"the system serves no {form.serve!r}", expected=", ".join(served) or "nothing"
        )
    written = form.endpoint if form.endpoint is not None and _VARIABLE.search(form.endpoint) else ""
    try:
        endpoint = None
        if form.endpoint is not None and not written:
            endpoint = _modbus(Endpoint.parse(form.endpoint), "")
    except UsageError as e:
        raise file.error((*loc, "endpoint"), e.message, expected=e.expected, got=e.got, hint=e.hint) from e
    try:
        every_s, timeout_s = seconds(form.every), seconds(form.timeout)
    except UsageError as e:
        raise file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint) from e
    if every_s < MIN_EVERY_S or timeout_s <= 0:
        raise file.error(loc, "too often", expected=f"every {MIN_EVERY_S:g} s at most, and a timeout above 0")
    profile = _profile(file, loc, name, form)
    return ScenarioProbe(name, profile, endpoint, form.serve or "", form.unit, every_s, timeout_s, written)


def _modbus(endpoint: Endpoint, where: str) -> Endpoint:
    if endpoint.is_can or endpoint.scheme in ("pty", "udp"):
        raise UsageError(
            "a probe uses Modbus", where=where, expected="tcp://, rtu+tcp://, rtu: or ascii:", got=str(endpoint)
        )
    return endpoint


def _profile(file: YamlFile, loc: tuple[Key, ...], name: str, form: ProbeForm) -> DeviceProfile:
    """Return the registers as a device profile. Its errors refer to positions in the scenario file."""
    data = {
        "device": f"probe/{name.replace('_', '-')}",
        "source": "a scenario",
        "protocol": "modbus",
        "numbering": form.numbering,
        "defaults": {"type": form.type, "order": form.order},
        "tags": form.registers,
    }
    registers = (*loc, "registers")
    here = file.positions.get(loc, (1, 1))
    positions: dict[tuple[Key, ...], Position] = {(): here}
    for key, position in file.positions.items():
        if key[: len(registers)] == registers:
            positions["tags", *key[len(registers) :]] = position
        elif key[:-1] == loc and key[-1] in ("type", "order"):
            positions["defaults", key[-1]] = position
    return resolve(YamlFile(file.path, data, positions))
