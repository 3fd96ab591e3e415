"""`fieldtwin new`: write a working site into a new folder, after a few questions or from options."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import profiles_option
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable

if TYPE_CHECKING:
    from fieldtwin.new_site.wishes import DeviceWish

CONTROLS = ("python", "st", "none", "own")
CIS = ("github", "gitlab", "none")


@dataclass(frozen=True)
class DeviceChoices:
    """The options for the devices of the site: named by profile, or found by a scan."""

    devices: tuple[str, ...] = option(
        "--device",
        multiple=True,
        metavar="[NAME=]PROFILE[@ENDPOINT][#ADDRESS]",
        help="A device: a shipped profile or a profile file, its endpoint on the plant, its unit ID or node ID. Repeatable.",
    )
    scans: tuple[str, ...] = option(
        "--scan",
        multiple=True,
        metavar="ENDPOINT[#LIST]",
        help="Scan the endpoint and use the devices found there; #1-20 asks only these addresses. Repeatable.",
    )


@dataclass(frozen=True)
class FileChoices:
    """The options for the parts of the site in addition to its devices. None: ask, or use the default."""

    control: str | None = option(
        "--control",
        type=click.Choice(CONTROLS),
        help="The program: in Python (default), in Structured Text, none, or your own controller.",
    )
    ci: str | None = option("--ci", type=click.Choice(CIS), help="Test after each change; default github.")
    compose: bool | None = option(
        "--compose/--no-compose", default=None, help="A Compose file with the simulation; default yes."
    )
    name: str | None = option("--name", help="The name of the system; default: made of DIR.")
    yes: bool = option(
        "--yes", "-y", is_flag=True, help="Ask nothing: use the default for each choice without an option."
    )


@click.command("new", cls=GroupedCommand)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@group("Devices", devices=DeviceChoices)
@group("Parts of the site", parts=FileChoices)
@group("Search", profiles_option)
def command(folder: Path, devices: DeviceChoices, parts: FileChoices, profiles: tuple[Path, ...]) -> int:
    """Write a working site into the new or empty folder DIR: system, simulated devices, scenarios, program, README, files for
    an editor, for CI and for Compose.

    On a terminal it asks for what no option says. Elsewhere, and with --yes, it asks nothing.

    \b
    An example, a tank with a pump:
      fieldtwin new pumpstation --yes
    Two shipped profiles, and a profile of yours:
      fieldtwin new hall --device eastron-sdm630#5 \\
          --device tank=./tank.yaml@tcp://192.0.2.7 --control st
    The devices on a serial line:
      fieldtwin new hall --scan rtu:/dev/ttyUSB0

    In the new folder `fieldtwin test` passes at once.
    """
    from fieldtwin.new_site.devices import site_devices
    from fieldtwin.new_site.site import site_files
    from fieldtwin.new_site.wishes import Ci, Control, Wishes, check_name, name_from, parse_device, title_of
    from fieldtwin.new_site.writing import check_empty, write_site

    asking = not parts.yes and sys.stdin.isatty() and sys.stderr.isatty()
    check_empty(folder)
    title = title_of(folder)
    system = check_name(parts.name, "the system's name") if parts.name else name_from(title, "site")
    wishes = [parse_device(text) for text in devices.devices]
    for text in devices.scans:
        wishes += _scanned(text, profiles, asking)
    if devices.scans and not wishes:
        raise Unreachable(
            "the scan found no device for the new site", hint="fieldtwin infer drafts a profile from a dump"
        )
    if asking and not wishes:
        wishes = _ask_for_devices(profiles)
    chosen = site_devices(wishes, profiles)
    control = parts.control or _ask("Control", CONTROLS, asking)
    ci = parts.ci or _ask("CI", CIS, asking)
    compose = parts.compose
    if compose is None:
        compose = click.confirm("Compose file?", default=True, err=True) if asking else True
    files = site_files(Wishes(title, system, tuple(wishes), Control(control), Ci(ci), compose), chosen)
    write_site(folder, files)
    for path in files:
        if not path.startswith(".fieldtwin/"):
            stdout.print(str(folder / path), soft_wrap=True, markup=False, highlight=False)
    _say(f"{len(files)} files. Next: cd {shlex.quote(str(folder))} && fieldtwin test")
    return 0


def _say(text: str) -> None:
    stderr.print(text, soft_wrap=True, markup=False, highlight=False)


def _ask(what: str, choices: tuple[str, ...], asking: bool) -> str:
    """Ask the user for one of `choices`; the first is the default, also if `asking` is False."""
    if not asking:
        return choices[0]
    answer: str = click.prompt(what, type=click.Choice(choices), default=choices[0], err=True)
    return answer


def _ask_for_devices(profiles: tuple[Path, ...]) -> list[DeviceWish]:
    """Ask for devices until the answer is empty. After an invalid answer, print the error and ask again."""
    from fieldtwin.new_site.devices import site_devices
    from fieldtwin.new_site.wishes import EXAMPLE, parse_device
    from fieldtwin.twin.site.data_files import device_files, search_path

    known = sorted({path.stem for folder in search_path(profiles) for path in device_files(folder)})
    _say(f"Profiles: {', '.join(known)}")
    _say(
        "A device is a profile or a profile file, with @ENDPOINT and #ADDRESS if you know them; `scan ENDPOINT` scans."
    )
    wishes: list[DeviceWish] = []
    while True:
        default = "" if wishes else EXAMPLE
        prompt = "Next device (Enter: no more)" if wishes else "Device"
        answer = str(click.prompt(prompt, default=default, show_default=bool(default), err=True)).strip()
        if not answer:
            return wishes
        try:
            if answer.startswith("scan "):
                wishes += _scanned(answer.removeprefix("scan ").strip(), profiles, asking=True)
                continue
            more = [*wishes, parse_device(answer)]
            site_devices(more, profiles)
        except FieldtwinError as e:
            _say(str(e))
            continue
        wishes = more


def _scanned(text: str, profiles: tuple[Path, ...], asking: bool) -> list[DeviceWish]:
    """Scan ``ENDPOINT[#LIST]`` and return the devices found there. Raises `Unreachable` if no device answers."""
    from fieldtwin.cli.device.identify_command import known_profiles
    from fieldtwin.cli.device.scan_command import numbers
    from fieldtwin.cli.device.scan_progress import ScanProgress
    from fieldtwin.cli.stop_key import StopKey
    from fieldtwin.gateway.core.endpoint import Endpoint
    from fieldtwin.gateway.wallclock import run as run_precise
    from fieldtwin.new_site.scanning import Scanned, scan_endpoint

    url, _, some = text.partition("#")
    addresses = numbers(some or None, 1, 127 if Endpoint.parse(url).is_can else 247, "the addresses")

    async def scan() -> Scanned:
        with StopKey() as stop, ScanProgress(stop.listens) as show:
            words = shlex.join(["fieldtwin", *sys.argv[1:]])
            return await scan_endpoint(
                url, addresses, known_profiles(profiles), words=words, on_progress=show, stop=stop.pressed
            )

    found = run_precise(scan())
    for remark in found.remarks:
        _say(remark)
    if found.stopped and not (asking and click.confirm("The scan is not complete. Go on?", default=False, err=True)):
        raise click.Abort
    if not (found.devices or found.remarks):
        raise Unreachable("the scan found no device", where=url, hint="fieldtwin scan shows the replies")
    return found.devices
