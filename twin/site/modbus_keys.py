"""The timing keys of a system file, resolved: of a Modbus bus and of each device, including what profiles request."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of, make_framer
from fieldtwin.twin.site.schema import BusForm, DeviceForm, SystemForm

MODBUS_BUS_KEYS = ("spacing_ms", "turnaround_ms", "connect_pause_ms", "echo", "strict", "probe_percent")
MODBUS_KEYS = ("spacing_ms",)


def modbus_bus(file: YamlFile, name: str, form: BusForm, endpoint: Endpoint) -> BusConfig:
    """Return a bus with its timing. The keys are refused on CAN, and with framings to which they do not apply."""
    loc: tuple[Key, ...] = ("buses", name)
    bus = BusConfig(name, endpoint, form.timeout_ms / 1000, form.retries, form.bitrate)
    if endpoint.is_can:
        _refuse(file, loc, form.model_fields_set.intersection(MODBUS_BUS_KEYS))
        return bus
    try:
        char_time_ns = round(endpoint.serial.char_time_s * NS_PER_S) if endpoint.is_serial else 0
        make_framer(
            framing_of(endpoint), char_time_ns=char_time_ns, echo=form.echo, strict=form.strict, accepts_zero_id=False
        )
    except UsageError as e:
        raise file.error((*loc, "echo" if form.echo else "strict"), e.message, expected=e.expected, got=e.got) from e
    return replace(
        bus,
        spacing_s=form.spacing_ms / 1000,
        turnaround_s=form.turnaround_ms / 1000,
        connect_pause_s=(form.connect_pause_ms or 0) / 1000,
        echo=form.echo,
        strict=form.strict,
        probe_share=form.probe_percent / 100,
    )


def device_pace(file: YamlFile, loc: tuple[Key, ...], form: DeviceForm, config: DeviceConfig) -> DeviceConfig:
    """Return a device with its timing: from the system file, else from its profile, else from the bus."""
    if config.profile.protocol != "modbus":
        _refuse(file, loc, form.model_fields_set.intersection(MODBUS_KEYS))
    timing = config.profile.form.timing
    for group, poll in form.poll.items():
        if poll.phase_ms is not None and poll.phase_ms >= poll.every_ms:
            raise file.error(
                (*loc, "poll", group, "phase_ms"),
                "a phase",
                expected=f"less than {poll.every_ms}",
                got=str(poll.phase_ms),
            )
    if form.backoff_limit_ms < form.backoff_first_ms:
        raise file.error((*loc, "backoff_limit_ms"), "a limit", expected=f"at least {form.backoff_first_ms}")
    timeout_ms = form.timeout_ms or timing.timeout_ms
    spacing_ms = timing.spacing_ms if form.spacing_ms is None else form.spacing_ms
    return replace(
        config,
        phase={group: p.phase_ms for group, p in form.poll.items() if p.phase_ms is not None},
        timeout_s=timeout_ms / 1000 if timeout_ms else None,
        retries=form.retries,
        spacing_s=spacing_ms / 1000,
        backoff_first_s=form.backoff_first_ms / 1000,
        backoff_limit_s=form.backoff_limit_ms / 1000,
    )


def connect_pauses(
    buses: dict[str, BusConfig], form: SystemForm, devices: dict[str, DeviceConfig]
) -> dict[str, BusConfig]:
    """Return `buses` with the longest connect pause that their devices' profiles request, where the system file states
    none.
    """
    asked = dict.fromkeys(buses, 0)
    for device in devices.values():
        asked[device.bus] = max(asked[device.bus], device.profile.form.timing.connect_pause_ms)
    silent = [name for name in buses if form.buses[name].connect_pause_ms is None]
    return buses | {name: replace(buses[name], connect_pause_s=asked[name] / 1000) for name in silent}


def _refuse(file: YamlFile, loc: tuple[Key, ...], keys: Iterable[str]) -> None:
    for key in sorted(keys):
        raise file.error((*loc, key), f"`{key}` on a CAN bus", expected="a Modbus bus")
