"""Options that `fieldtwin run`, `simulate` and `with` share, and their meaning for a file that describes several systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import pairs
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.processes.topside import parse_periods
from fieldtwin.run.template import agree
from fieldtwin.twin.site.groups import group_file

if TYPE_CHECKING:
    from fieldtwin.twin.prototype.group import SystemGroup


@dataclass(frozen=True)
class ReplayOptions:
    """The options for the prototype file, and for the recordings (files by device) that its devices replay. `speed` is a
    factor; 0: that of the prototype file.
    """

    prototype_file: Path | None = option(
        "--prototype-file",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="Use this prototype file.",
    )
    recordings: dict[str, str] = option(
        "--recording",
        multiple=True,
        metavar="DEVICE=FILE",
        callback=lambda ctx, parameter, values: pairs(values, "--recording"),
        help="Replay this recording for a device.",
    )
    speed: float = option("--speed", type=float, default=0.0, help="Speed factor for recordings.")

    def given(self) -> dict[str, object]:
        """Return the values of these options, by the option's name."""
        return {"--recording": self.recordings, "--speed": self.speed, "--prototype-file": self.prototype_file}


commands_option = click.option(
    "--commands",
    default=None,
    metavar="1,2,0,-1",
    callback=lambda ctx, parameter, text: None if text is None else parse_periods(text),
    help="Sample periods that the topside controller commands, spread over the run; or none.",
)
listen_option = click.option(
    "--listen",
    multiple=True,
    metavar="BUS=ENDPOINT",
    callback=lambda ctx, parameter, values: pairs(values, "--listen"),
    help="Endpoint for the emulators of a bus.",
)


def systems_of(
    file: str,
    sources: TemplateSearchOptions,
    others: Mapping[str, object],
    available: str,
    *,
    plant: bool = False,
    virtual: bool,
) -> SystemGroup | None:
    """Return the systems of a file that describes several, after the user has agreed to run them; None for any other file.

    `others` are the values of options that such a file does not have, and `available` names those that it has. Raises
    `UsageError`, `FileInvalid`, `NotAllowed`.
    """
    found = group_file(file, sources.profiles)
    if found is None:
        return None
    from fieldtwin.twin.prototype.group import read_group  # imported here, because a plant has no emulators installed

    group = read_group(*found, sources.profiles)
    if plant:
        raise UsageError(
            f"a {group.kind} file runs only as prototypes: each of its systems is a separate plant",
            hint="run each system on its computer, with its own system file",
        )
    if given := [name for name, value in others.items() if value]:
        raise UsageError(
            f"{', '.join(given)}: not available for a {group.kind}",
            expected=available,
            hint="its systems can be run separately",
        )
    members = [(member.system, member.prototype.path) for member in group.members.values()]
    agree(sources.ask(), group.path, members, beside=group.path, virtual=virtual)
    return group
