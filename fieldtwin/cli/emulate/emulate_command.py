"""`fieldtwin emulate`: emulate the devices of a system, or one device on a serial line, socket or CAN bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Secret, pairs
from fieldtwin.cli.template_question import SourceOptions
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.processes.field_contact import DEFAULT_CONTROL_PORT
from fieldtwin.twin.site.data_files import data_root, find

if TYPE_CHECKING:
    from fieldtwin.run.emulate.device import Extras


@click.command("emulate", cls=GroupedCommand)
@click.argument("what")
@group(
    "One device",
    click.option(
        "--on",
        "endpoints",
        multiple=True,
        metavar="ENDPOINT",
        help="For a device or recording: the endpoint to listen on.",
    ),
    click.option(
        "--unit", type=click.IntRange(1, 247), default=None, help="For a device: its unit ID; default: the profile's."
    ),
    click.option(
        "--node",
        type=click.IntRange(1, 255),
        default=None,
        help="For a CANopen device or data sheet: its node ID; 255: none yet, an LSS master assigns it.",
    ),
    click.option(
        "--bitrate",
        type=click.IntRange(10_000, 1_000_000),
        default=None,
        help="For a CANopen device: bit/s of the software bus; default 125000 for a new bus.",
    ),
    click.option(
        "--values",
        multiple=True,
        metavar="TAG=VALUE|FILE",
        help="For a Modbus profile: initial register values, 0 by default; no recording is replayed. FILE: a YAML mapping.",
    ),
    click.option(
        "--faults",
        "faults_file",
        type=click.Path(exists=True, dir_okay=False),
        help="For a Modbus device or recording: inject these faults (see fieldtwin faults).",
    ),
    click.option("--seed", type=int, default=1, help="With --faults: seed of random choices; default: 1."),
    click.option(
        "--any-unit",
        is_flag=True,
        help="For one Modbus device on TCP, TLS or UDP: answer to every unit ID, as some devices do.",
    ),
    click.option(
        "--model",
        type=click.Choice(["401", "402", "404", "406", "410", "none"]),
        default=None,
        help="For a CANopen device: the CiA profile whose model computes its objects. Default: from object 1000h.",
    ),
    click.option(
        "--defaults", is_flag=True, help="For a CANopen device: start with the DefaultValues, not with ParameterValues."
    ),
)
@group(
    "Recording",
    click.option(
        "--recording",
        "recordings",
        multiple=True,
        metavar="[DEVICE=]FILE",
        help="Replay this recording; for a data sheet: a log of candump -L.",
    ),
    click.option("--speed", type=float, default=0.0, help="Speed factor for recordings."),
    click.option(
        "--unknown",
        type=click.Choice(["exception", "silence", "interpolate"]),
        default=None,
        help="For a recording: the answer to a request that was not recorded. Default: exception.",
    ),
    click.option(
        "--at-end",
        type=click.Choice(["hold", "loop", "error"]),
        default=None,
        help="For a recording: at the end of its values, hold the last one (default), begin again, or answer with exception 04.",
    ),
)
@group(
    "System",
    click.option(
        "--prototype-file",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="For a system: use this prototype file.",
    ),
    click.option(
        "--listen", multiple=True, metavar="BUS=ENDPOINT", help="For a system: endpoint for the emulators of a bus."
    ),
    click.option(
        "--control",
        default=f"127.0.0.1:{DEFAULT_CONTROL_PORT}",
        show_default=True,
        metavar="HOST:PORT",
        help="For a system: control address, for `fieldtwin run --field`.",
    ),
    click.option(
        "--token",
        type=Secret(),
        default="",
        metavar="@FILE",
        help="Token that --control requires from its clients; needed if not on loopback. Or FIELDTWIN_EMULATE_TOKEN.",
    ),
    click.option("--instance", default="", help="Name of the run directory; default: the system's name and -field."),
)
@group("Profiles and templates", sources=SourceOptions)
def command(
    what: str,
    endpoints: tuple[str, ...],
    unit: int | None,
    node: int | None,
    bitrate: int | None,
    model: str | None,
    defaults: bool,
    recordings: tuple[str, ...],
    speed: float,
    unknown: str | None,
    at_end: str | None,
    values: tuple[str, ...],
    faults_file: str | None,
    seed: int,
    any_unit: bool,
    prototype_file: Path | None,
    listen: tuple[str, ...],
    control: str,
    token: str,
    instance: str,
    sources: SourceOptions,
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
    if kind != "recording" and (unknown or at_end):
        raise UsageError("--unknown and --at-end need a recording", got=f"a {kind}")
    if (values or faults_file or any_unit) and kind not in ("device", "recording"):
        raise UsageError(
            "--values, --faults and --any-unit are for a single Modbus device or recording",
            got=f"a {kind}",
            hint="a system's prototype file has `values`, and `fieldtwin run --faults` puts faults in",
        )
    of_node = (model, defaults) != (None, False)
    if of_node and kind not in ("device", "data sheet"):
        raise UsageError("--model and --defaults are for a CANopen device or data sheet", got=f"a {kind}")
    if kind == "system":
        if endpoints or (unit, node, bitrate) != (None, None, None):
            raise UsageError(
                "--on, --unit, --node and --bitrate need a single device",
                hint="a system's endpoints are in its prototype file",
            )
        from fieldtwin.gateway.wallclock import run as run_precise
        from fieldtwin.run.emulate.field import FieldOptions, run_field
        from fieldtwin.run.template import system_file

        agreed = system_file(str(path), sources.ask(), prototype_file=prototype_file, profiles=sources.profiles)

        return run_precise(
            run_field(
                FieldOptions(
                    system=Path(agreed),
                    prototype_file=prototype_file,
                    recordings=pairs(recordings, "--recording"),
                    speed=speed,
                    listen=pairs(listen, "--listen"),
                    control=control,
                    token=token,
                    instance=instance,
                    profiles=sources.profiles,
                )
            )
        )
    from fieldtwin.emulators.context import EndOfRecording
    from fieldtwin.emulators.models.emulated_node import NodeOptions
    from fieldtwin.emulators.replay.replay import NeverRecorded
    from fieldtwin.run.emulate.device import run_device
    from fieldtwin.run.processes.event_loop import run as run_loop

    if not endpoints:
        raise UsageError(
            "the endpoint to listen on is missing",
            expected="--on pty:PATH, --on tcp://HOST:PORT or, CANopen, --on can:fieldtwin/127.0.0.1:29536",
        )
    options = NodeOptions(model, not defaults) if of_node else None
    if len(recordings) > 1:
        raise UsageError("one device replays one recording")
    if kind == "data sheet":
        if unit is not None:
            raise UsageError("a data sheet has no unit ID", hint="--node")
        from fieldtwin.run.emulate.data_sheet import run_data_sheet

        log = Path(recordings[0]) if recordings else None
        return run_loop(run_data_sheet(path, endpoints, node, bitrate, log, options))
    if kind == "log":
        if unit is not None or recordings:
            raise UsageError("a log needs no --recording, and has no unit ID", expected="--node")
        from fieldtwin.run.emulate.data_sheet import run_log

        return run_loop(run_log(path, endpoints, node, bitrate))
    if unit is not None and node is not None:
        raise UsageError("a device has a unit ID or a node ID, not both")
    extras = _extras(kind, path, values, recordings, faults_file, seed, any_unit)
    unit = node if unit is None else unit
    recording = Path(recordings[0]) if recordings else None
    serial = any(endpoint.startswith("pty:") for endpoint in endpoints)
    return run_loop(
        run_device(
            kind, path, endpoints, unit, recording, speed or 1.0, bitrate, unknown=NeverRecorded(unknown or "exception"),
            at_end=EndOfRecording(at_end or "hold"), options=options, extras=extras,
        ),
        serial=serial,
    )  # fmt: skip


def _extras(
    kind: str,
    path: Path,
    values: tuple[str, ...],
    recordings: tuple[str, ...],
    faults_file: str | None,
    seed: int,
    any_unit: bool,
) -> Extras | None:
    """Return the optional parts of a Modbus device, or None. Raises `UsageError` and `FileInvalid`."""
    from fieldtwin.emulators.device_faults import check_device
    from fieldtwin.emulators.faults.schema import load_faults
    from fieldtwin.gateway.core.files.profile import load_profile
    from fieldtwin.run.emulate.device import Extras

    if not (values or faults_file or any_unit):
        return None
    profile = load_profile(path) if kind == "device" else None
    if profile is not None and profile.protocol != "modbus":
        raise UsageError("--values, --faults and --any-unit are for a Modbus device", got=profile.name)
    if values and (profile is None or recordings or profile.inbox is not None):
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
    stated = held is not None
    said = (
        load_faults(Path(faults_file), lambda spec: check_device(spec, profile, values=stated)) if faults_file else ()
    )
    return Extras(held, said, seed, any_unit)


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
            if isinstance(held, bool) or not isinstance(held, int | float | str):
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
    from fieldtwin.twin.template.package import is_template

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
