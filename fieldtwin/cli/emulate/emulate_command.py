"""`fieldtwin emulate`: emulate the devices of a system, or one device on a serial line, socket or CAN bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.emulate.emulate_options import OneDeviceOptions, RecordingOptions, SystemOptions
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import pairs
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.site.data_files import data_root, find

if TYPE_CHECKING:
    from fieldtwin.run.emulate.device import ModbusExtras


@click.command("emulate", cls=GroupedCommand)
@click.argument("what")
@group("One device", device=OneDeviceOptions)
@group("Recordings", replay=RecordingOptions)
@group("System", field=SystemOptions)
@group("Profiles and templates", sources=TemplateSearchOptions)
def command(
    what: str,
    device: OneDeviceOptions,
    replay: RecordingOptions,
    field: SystemOptions,
    sources: TemplateSearchOptions,
) -> int:
    """Emulate WHAT: a system, a device profile, a recording, or an EDS or DCF file. A plain name is a profile, else a system.

    \b
    All devices of a system, for `fieldtwin run --field localhost`:
      fieldtwin emulate observatory
    One sensor on a virtual serial port, or on Modbus TCP:
      fieldtwin emulate ctd-reference --on pty:/tmp/ctd
      fieldtwin emulate ctd-reference --on tcp://127.0.0.1:1502
    With initial values and faults:
      fieldtwin emulate renogy-rover --values battery_voltage=12.4 \\
          --faults slow.yaml --on tcp://127.0.0.1:1502
    A recording, replayed without a profile:
      fieldtwin emulate site.jsonl --on rtu:/tmp/ttyV0
    A drive on a software CAN bus, which is created or joined:
      fieldtwin emulate drive-cia402 --on can:fieldtwin/127.0.0.1:29536
    A CANopen node from its data sheet, or from a candump log:
      fieldtwin emulate drive.eds --node 5 --on can:fieldtwin/127.0.0.1:0
      fieldtwin emulate bus.log --node 5 --on can:fieldtwin/127.0.0.1:29536
    """
    kind, path = _kind(what, sources.profiles)
    if kind != "recording" and (replay.unknown or replay.at_end):
        raise UsageError("--unknown and --at-end need a recording", got=f"a {kind}")
    if (device.values or device.faults_file or device.any_unit) and kind not in ("device", "recording"):
        raise UsageError(
            "--values, --faults and --any-unit are for a single Modbus device or recording",
            got=f"a {kind}",
            hint="a system's prototype file has `values`, and `fieldtwin run --faults` injects faults",
        )
    if (device.model, device.defaults) != (None, False) and kind not in ("device", "data sheet"):
        raise UsageError("--model and --defaults are for a CANopen device or data sheet", got=f"a {kind}")
    if kind != "system":
        return _emulate_one(kind, path, device, replay)
    if device.endpoints or (device.unit, device.node, device.bitrate) != (None, None, None):
        raise UsageError(
            "--on, --unit, --node and --bitrate need a single device",
            hint="a system's endpoints are in its prototype file",
        )
    from fieldtwin.gateway.wallclock import run as run_precise
    from fieldtwin.run.emulate.field import FieldOptions, run_field
    from fieldtwin.run.template import system_file

    return run_precise(
        run_field(
            FieldOptions(
                system=Path(
                    system_file(
                        str(path), sources.ask(), prototype_file=field.prototype_file, profiles=sources.profiles
                    )
                ),
                prototype_file=field.prototype_file,
                recordings=pairs(replay.recordings, "--recording"),
                speed=replay.speed,
                listen=field.listen,
                control=field.control,
                token=field.token,
                instance=field.instance,
                profiles=sources.profiles,
            )
        )
    )


def _emulate_one(kind: str, path: Path, device: OneDeviceOptions, replay: RecordingOptions) -> int:
    """Emulate a device, a recording, a data sheet or a log until a signal ends it. Return the exit status."""
    from fieldtwin.emulators.context import EndOfRecording
    from fieldtwin.emulators.models.canopen.emulated_node import NodeOptions
    from fieldtwin.emulators.replay.replay import NeverRecorded
    from fieldtwin.run.emulate.device import run_device
    from fieldtwin.run.processes.event_loop import run as run_loop

    unit, node, endpoints = device.unit, device.node, device.endpoints
    if not endpoints:
        raise UsageError(
            "the endpoint to listen on is missing",
            expected="--on pty:PATH, --on tcp://HOST:PORT or, CANopen, --on can:fieldtwin/127.0.0.1:29536",
        )
    of_node = (device.model, device.defaults) != (None, False)
    options = NodeOptions(device.model, not device.defaults) if of_node else None
    if len(replay.recordings) > 1:
        raise UsageError("one device replays one recording")
    recording = Path(replay.recordings[0]) if replay.recordings else None
    if kind == "data sheet":
        if unit is not None:
            raise UsageError("a data sheet has no unit ID", hint="--node")
        from fieldtwin.run.emulate.data_sheet import run_data_sheet

        return run_loop(run_data_sheet(path, endpoints, node, device.bitrate, recording, options))
    if kind == "log":
        if unit is not None or recording is not None:
            raise UsageError("a log needs no --recording, and has no unit ID", expected="--node")
        from fieldtwin.run.emulate.data_sheet import run_log

        return run_loop(run_log(path, endpoints, node, device.bitrate))
    if unit is not None and node is not None:
        raise UsageError("a device has a unit ID or a node ID, not both")
    return run_loop(
        run_device(
            kind, path, endpoints, node if unit is None else unit, recording, replay.speed or 1.0, device.bitrate,
            unknown=NeverRecorded(replay.unknown or "exception"), at_end=EndOfRecording(replay.at_end or "hold"),
            options=options, extras=_extras(kind, path, endpoints, device, recording),
        ),
        serial=any(endpoint.startswith("pty:") for endpoint in endpoints),
    )  # fmt: skip


def _extras(
    kind: str, path: Path, endpoints: tuple[str, ...], device: OneDeviceOptions, recording: Path | None
) -> ModbusExtras | None:
    """Return the initial values, faults and other extras of a Modbus device, None without any.

    Raises `UsageError` and `FileInvalid`.
    """
    from fieldtwin.emulators.device_faults import check_device
    from fieldtwin.emulators.faults.frames import framing_of
    from fieldtwin.emulators.faults.schema import load_faults
    from fieldtwin.gateway.core.endpoint import Endpoint
    from fieldtwin.gateway.core.files.profile_file import load_profile
    from fieldtwin.run.emulate.device import ModbusExtras, plant_of

    values, faults = device.values, device.faults_file
    if not (values or faults or device.any_unit):
        return None
    profile = load_profile(path) if kind == "device" else None
    if profile is not None and profile.protocol != "modbus":
        raise UsageError("--values, --faults and --any-unit are for a Modbus device", got=profile.name)
    if values and (profile is None or recording is not None or profile.inbox is not None):
        raise UsageError(
            "--values gives a device its registers from its profile",
            expected="a profile of registers, without --recording",
            got=path.name,
        )
    held = _values(values) if values else None
    if held is not None and profile is not None:
        unknown = next((name for name in held if name not in profile.tags), None)
        if unknown is not None:
            raise UsageError(f"{profile.name} has no tag {unknown!r}", expected=", ".join(profile.tags))
    framings = {framing_of(plant_of(Endpoint.parse(url))) for url in endpoints}
    said = load_faults(Path(faults), lambda spec: check_device(spec, profile, framings)) if faults else ()
    return ModbusExtras(held, said, device.seed, device.any_unit)


def _values(said: tuple[str, ...]) -> dict[str, float | str]:
    """Return the values of ``TAG=VALUE`` and of YAML files with a mapping of tags to values.

    Later values override earlier ones.
    """
    from fieldtwin.gateway.core.files.yaml_file import load

    found: dict[str, float | str] = {}
    for one in said:
        tag, equals, value = one.partition("=")
        if equals:
            found[tag.strip()] = _number_or_text(value.strip())
            continue
        file = load(Path(one))
        for tag, held in file.data.items():
            if isinstance(held, bool):
                held = str(held).lower()
            if not isinstance(held, int | float | str):
                raise file.error((tag,), f"the value of {tag!r}", expected="a number or text", got=repr(held)[:60])
            found[str(tag)] = held
    return found


def _number_or_text(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _kind(what: str, profiles: tuple[Path, ...]) -> tuple[str, Path]:
    """Return the kind of `what` and its file: ("system" | "device" | "recording" | "log" | "data sheet", file)."""
    from fieldtwin.twin.template.detect import is_template

    direct = Path(what)
    if is_template(direct):
        return "system", direct
    if direct.suffix.lower() in (".eds", ".dcf"):
        return "data sheet", direct
    if direct.suffix == ".log":
        return "log", direct
    if direct.suffix == ".jsonl":
        shipped = data_root() / "recordings" / what
        return "recording", direct if direct.is_file() else shipped
    if direct.is_file():
        from fieldtwin.gateway.core.files.yaml_file import load

        return ("system" if "system" in load(direct).data else "device"), direct
    try:
        return "device", find("devices", what, extra=profiles)
    except UsageError as no_device:
        try:
            return "system", find("systems", what, extra=profiles)
        except UsageError as no_system:
            raise UsageError(
                f"no device profile, system or recording {what!r}",
                expected=f"{no_device.expected}; or {no_system.expected}",
                hint=no_device.hint or no_system.hint,
            ) from None
