"""`fieldtwin identify`: read a device's identification and find the profile that fits."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.device.device_options import log_option, logged
from fieldtwin.cli.options import Duration, json_option, profiles_option
from fieldtwin.commissioning.identify.canopen import CanIdentity, identify_canopen
from fieldtwin.commissioning.identify.matching import Candidate, Sureness
from fieldtwin.commissioning.identify.modbus import NAMES, ModbusIdentity, identify_modbus, modbus_frames
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.wallclock import run as run_precise
from fieldtwin.twin.site.data_files import device_files, search_path

COLOUR = {
    Sureness.CERTAIN: "bold green",
    Sureness.LIKELY: "green",
    Sureness.POSSIBLE: "yellow",
    Sureness.RULED_OUT: "dim",
}
UNREACHABLE = 4


@click.command("identify")
@click.argument("endpoint")
@click.option("--unit", type=click.IntRange(0, 255), help="Modbus unit ID; default 1.")
@click.option("--node", type=click.IntRange(1, 127), help="CANopen node ID; default 1.")
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), help="CAN: bit rate in bit/s; default: the bus's.")
@click.option(
    "--timeout",
    "timeout_s",
    type=Duration(),
    default="1s",
    show_default=True,
    help="Timeout for each reply. Some devices need more than 500 ms to refuse a request.",
)
@click.option("--rate", "per_s", type=click.FloatRange(0.1, 1000), default=20.0, help="Maximum requests per second.")
@click.option("--echo", is_flag=True, help="Serial: the adapter echoes the sent bytes.")
@click.option("--dry-run", is_flag=True, help="Print the first frames that would be sent; open nothing.")
@click.option("--all", "show_all", is_flag=True, help="Also show the profiles that were ruled out, with the reason.")
@log_option
@profiles_option
@json_option
def command(
    endpoint: str,
    unit: int | None,
    node: int | None,
    bitrate: int | None,
    timeout_s: float,
    per_s: float,
    echo: bool,
    dry_run: bool,
    show_all: bool,
    log: Path | None,
    profiles: tuple[Path, ...],
    as_json: bool,
) -> int:
    """Read the identification of one device at ENDPOINT, and show which profile fits, with confidence and reasons. It sends
    only reads.

    Modbus: functions 2Bh/0Eh and 11h, the SunSpec header, then the registers of each profile. CANopen: objects 1000h, 1008h,
    1009h, 100Ah, 1018h. Only the device's own identification is certain; register values are not. Exit code 1: no profile
    fits; 4: the device does not answer.
    """
    can = Endpoint.parse(endpoint).is_can
    if (unit if can else node) is not None:
        raise UsageError("a CANopen device has --node, a Modbus device --unit")
    if dry_run:
        for line in _first_frames(endpoint, node or 1) if can else modbus_frames(endpoint, 1 if unit is None else unit):
            click.echo(line)
        return 0
    known = known_profiles(profiles)
    with logged(log) as taps, _progress() as show:
        if can:
            result: CanIdentity | ModbusIdentity = run_precise(
                identify_canopen(
                    endpoint,
                    node or 1,
                    known,
                    bitrate=bitrate or 0,
                    timeout_s=timeout_s,
                    per_s=per_s,
                    on_progress=show,
                    taps=taps,
                )
            )
        else:
            result = run_precise(
                identify_modbus(
                    endpoint,
                    1 if unit is None else unit,
                    known,
                    timeout_s=timeout_s,
                    per_s=per_s,
                    echo=echo,
                    on_progress=show,
                    taps=taps,
                )
            )
    if as_json:
        click.echo(json.dumps(_json(result)))
    else:
        _show(result, show_all)
    if not result.answers:
        return UNREACHABLE
    return 0 if any(c.sureness is not Sureness.RULED_OUT for c in result.candidates) else 1


def _first_frames(endpoint: str, node: int) -> Iterator[str]:
    for index, sub in (
        (0x1000, 0),
        *((0x1018, sub) for sub in range(5)),
        *((index, 0) for index in (0x1008, 0x1009, 0x100A)),
    ):
        yield f"{0x600 + node:03X}#40{index.to_bytes(2, 'little').hex().upper()}{sub:02X}00000000"


def known_profiles(folders: Iterable[Path]) -> list[DeviceProfile]:
    """Return every device profile in the search path, the first of each file name.

    A profile that cannot be read is reported and skipped. Raises `UsageError` for a folder of `folders` without profiles.
    """
    found: dict[str, DeviceProfile] = {}
    given = list(folders)
    for folder in given:
        if not device_files(folder) and not (folder / "systems").is_dir():
            raise UsageError(
                "no device profile in this folder", where=str(folder), expected="NAME.yaml or devices/NAME.yaml"
            )
    for folder in search_path(given):
        for path in device_files(folder):
            if path.stem in found:
                continue
            try:
                found[path.stem] = load_profile(path)
            except FileInvalid as e:
                stderr.print(f"left out: {e}", soft_wrap=True, markup=False)
    return list(found.values())


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    if not stderr.is_terminal:
        yield lambda _: None
        return
    with stderr.status("asking") as status:
        yield lambda text: status.update(Text(text))


def _show(result: ModbusIdentity | CanIdentity, show_all: bool) -> None:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, text in _told(result):
        table.add_row(name, text)
    if table.row_count:
        stdout.print(table)
    for candidate in result.candidates:
        if candidate.sureness is not Sureness.RULED_OUT or show_all:
            _show_candidate(candidate)
    hidden = sum(1 for c in result.candidates if c.sureness is Sureness.RULED_OUT)
    if hidden and not show_all:
        stderr.print(f"{hidden} other profiles ruled out (--all shows the reasons)")
    stdout.print(Text(result.summary, "bold"), soft_wrap=True)


def _show_candidate(candidate: Candidate) -> None:
    stdout.print(Text(f"{candidate.sureness}: {candidate.profile}", COLOUR[candidate.sureness]), soft_wrap=True)
    for sign, texts in (("+", candidate.reasons), ("-", candidate.against)):
        for text in texts:
            stdout.print(Text(f"  {sign} {text}"), soft_wrap=True)


def _told(result: ModbusIdentity | CanIdentity) -> list[tuple[str, str]]:
    """Return the device's answers line by line, and the requests that the device did not answer."""
    rows: list[tuple[str, str]] = []
    if isinstance(result, ModbusIdentity):
        clues = result.clues
        if clues.objects is not None:
            rows += [(NAMES.get(n, f"object {n}"), text) for n, text in clues.objects.items()]
        if clues.server_id is not None:
            printable = clues.server_id.decode("ascii", "replace") if clues.server_id.isascii() else ""
            rows.append(
                (
                    "server id (11h)",
                    f"{clues.server_id.hex(' ')} {printable!r}" if printable else clues.server_id.hex(" "),
                )
            )
        if clues.sunspec is not None:
            s = clues.sunspec
            models = ", ".join(str(m[0]) for m in s.models)
            rows.append(("SunSpec", f"at {s.base}, models {models}"))
            rows += [
                (k, v) for k, v in (("manufacturer", s.manufacturer), ("model", s.model), ("serial", s.serial)) if v
            ]
        rows += [(_SILENT.get(n, n), why) for n, why in clues.silence.items() if n in _SILENT]
        return rows
    told = result.clues.identity
    if told is not None:
        device = f"{told.device_type:08X}h" + (
            f" (CiA {told.device_type & 0xFFFF})" if told.device_type & 0xFFFF else ""
        )
        rows.append(("device type (1000h)", device))
        parts = (
            ("vendor", told.vendor),
            ("product", told.product),
            ("revision", told.revision),
            ("serial", told.serial),
        )
        rows += [(f"{name} (1018h)", f"{part:X}h") for name, part in parts if part is not None]
    texts = (("name (1008h)", "name"), ("hardware (1009h)", "hardware"), ("software (100Ah)", "software"))
    return rows + [(label, getattr(result.clues, key)) for label, key in texts if getattr(result.clues, key)]


_SILENT = {"2B": "identification (2Bh/0Eh)", "11": "server id (11h)", "sunspec": "SunSpec"}


def _json(result: ModbusIdentity | CanIdentity) -> dict[str, Any]:
    common = {
        "endpoint": result.url,
        "answers": result.answers,
        "summary": result.summary,
        "certain": result.certain,
        "candidates": [
            {
                "profile": c.profile,
                "sureness": str(c.sureness),
                "reasons": list(c.reasons),
                "against": list(c.against),
            }
            for c in result.candidates
        ],
    }
    if isinstance(result, ModbusIdentity):
        clues = result.clues
        return common | {
            "unit": result.unit,
            "server_id": clues.server_id.hex() if clues.server_id is not None else None,
            "identification": {str(n): t for n, t in clues.objects.items()} if clues.objects is not None else None,
            "sunspec": asdict(clues.sunspec) if clues.sunspec is not None else None,
            "silence": clues.silence,
            "requests": result.requests,
        }
    told = result.clues
    return common | {
        "node": result.node,
        "identity": asdict(told.identity) if told.identity is not None else None,
        "name": told.name,
        "hardware": told.hardware,
        "software": told.software,
        "silence": told.silence,
        "conflict": result.conflict,
    }
