"""`fieldtwin diff`: compare two dumps, or a dump and a profile, field by field."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.options import json_option, pairs, profiles_option
from fieldtwin.commissioning.dump.diff import Differences, Leave, diff_dictionary, diff_dumps, diff_profile
from fieldtwin.commissioning.dump.file import Dump, load_dump
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, load_dictionary
from fieldtwin.reports.site.about import headed
from fieldtwin.twin.site.data_files import device_files, find, search_path

DIFFERENT = 1


@click.command("diff")
@click.argument("left", type=click.Path(dir_okay=False, path_type=Path), metavar="DUMP")
@click.argument("right", metavar="DUMP|PROFILE|EDS")
@click.option(
    "--profile",
    "profile_name",
    default="",
    metavar="NAME",
    help="Profile with the names for two dumps; default: the dump's.",
)
@click.option("--ignore", multiple=True, metavar="PATTERN", help="Tags or addresses to leave out, e.g. 'energy_*'.")
@click.option(
    "--tolerance",
    multiple=True,
    metavar="NAME=NUMBER",
    help="Smaller differences count as equal; NAME * sets all other tags.",
)
@click.option("--settings", is_flag=True, help="With two dumps: only writable values.")
@profiles_option
@json_option
def command(
    left: Path,
    right: str,
    profile_name: str,
    ignore: tuple[str, ...],
    tolerance: tuple[str, ...],
    settings: bool,
    profiles: tuple[Path, ...],
    as_json: bool,
) -> int:
    """Compare a DUMP with another dump, a PROFILE or an EDS. Exit code 1 if they differ.

    \b
    fieldtwin diff before.jsonl after.jsonl --settings
    fieldtwin diff meter.jsonl eastron-sdm630
    fieldtwin diff drive.jsonl drive.eds
    """
    one = _dump(left)
    leave = Leave(ignore, _tolerances(tolerance), settings)
    if _is_dump(Path(right)):
        other = _dump(Path(right))
        if one.protocol != other.protocol:
            raise FileInvalid("dumps of two protocols", path=right, expected=one.protocol, got=other.protocol)
        profile = _named(one, profile_name, profiles)
        found = diff_dumps(one, other, profile, _sheet(one, profile), leave)
    else:
        found = _against(one, right, profiles, leave)
    if as_json:
        h = one.header
        endpoint, when = str(h.get("endpoint", "")), str(h.get("started", ""))
        head = headed("diff", one.protocol, endpoint, int(h["address"]), Path(right).name, device=left.name, when=when)
        click.echo(json.dumps(head | asdict(found)))
    else:
        _show(found, left.name, Path(right).name)
    return DIFFERENT if found.found or not found.compared else 0  # without a compared field there is no result


def _against(one: Dump, right: str, folders: tuple[Path, ...], leave: Leave) -> Differences:
    if Path(right).suffix.lower() in (".eds", ".dcf"):
        if one.protocol != "canopen":
            raise UsageError("an EDS is for the dump of a CANopen node", got=one.path)
        return diff_dictionary(one, load_dictionary(Path(right), int(one.header["address"])))
    profile = load_profile(find("devices", right, extra=folders))
    if profile.protocol != one.protocol:
        raise UsageError(f"{profile.name} is a {profile.protocol} device", expected=f"a profile of {one.protocol}")
    sheet = _sheet(one, profile)
    return diff_dictionary(one, sheet) if sheet is not None else diff_profile(one, profile, leave)


def _dump(path: Path) -> Dump:
    dump = load_dump(path)
    if not dump.passes:
        raise FileInvalid("a dump without values", path=str(path))
    if not dump.ended:
        stderr.print(f"{path.name} was interrupted: the missing parts are not compared", soft_wrap=True)
    return dump


def _is_dump(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return b"fieldtwin_dump" in file.read(64)
    except OSError:
        return False


def _named(dump: Dump, name: str, folders: tuple[Path, ...]) -> DeviceProfile | None:
    """Return the requested profile, else the installed profile with which the dump was made, None if there is neither."""
    if name:
        return load_profile(find("devices", name, extra=folders))
    known = dump.header.get("profile")
    if not known:
        return None
    for folder in search_path(folders):
        for path in device_files(folder):
            if f"device: {known}" in path.read_text(encoding="utf-8", errors="replace"):
                return load_profile(path)
    stderr.print(f"no profile {known} here: addresses instead of names (--profile)", soft_wrap=True)
    return None


def _sheet(dump: Dump, profile: DeviceProfile | None) -> ObjectDictionary | None:
    path = profile.eds_path if profile is not None else None
    named = dump.header.get("eds")
    if path is None and dump.protocol == "canopen" and named and Path(str(named)).is_file():
        path = Path(str(named))
    return load_dictionary(path, int(dump.header["address"])) if path is not None else None


def _tolerances(texts: tuple[str, ...]) -> dict[str, float]:
    try:
        return {name: abs(float(number)) for name, number in pairs(texts, "--tolerance").items()}
    except ValueError as e:
        raise UsageError(f"--tolerance: {e}", expected="NAME=NUMBER") from e


def _show(found: Differences, left: str, right: str) -> None:
    if found.found:
        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in ("name", "at", "what", left, right):
            table.add_column(name, overflow="fold")
        for d in found.found:
            table.add_row(Text(d.name), d.at if d.at != d.name else "", d.kind, Text(d.left), Text(d.right))
        stdout.print(table)
    for note in found.notes:
        stderr.print(Text(note), soft_wrap=True)
    nothing = "" if found.compared else ": nothing in these two can be compared"
    stderr.print(f"{found.compared} compared, {len(found.found)} different{nothing}")
