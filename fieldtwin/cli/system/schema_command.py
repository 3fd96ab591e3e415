"""`fieldtwin schema`: print the JSON schema of a kind of file, or write all schemas to a folder, for editors and checks."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import click

from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.site.schemas import SCHEMAS, schema_text, shipped


@click.command("schema")
@click.argument("kind", required=False, type=click.Choice(list(SCHEMAS)))
@click.option(
    "--write",
    "folder",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Write the schemas of all kinds of files to this folder, as KIND.schema.json.",
)
def command(kind: str | None, folder: Path | None) -> int:
    """Print the JSON schema of a kind of file that users write.

    \b
    system      the plant: buses, devices, programs
    prototype   which devices of it are emulated, and from which source
    network     systems whose modems share an acoustic channel, as prototypes
    profile     a device: its registers or objects
    faults      injected faults, for run --faults and link --faults
    scenario    steps and expected results, for test
    waivers     accepted failures with an owner, for check and test
    rules       a digital twin's commands for its findings, for twin --plan

    An editor reads the schema that the first line of a YAML file names:

    \b
      # yaml-language-server: $schema=.fieldtwin/system.schema.json

    `fieldtwin schema --write .fieldtwin` writes these files, and after an update writes them again.
    """
    if (kind is None) == (folder is None):
        raise UsageError("what to do with which schema is not clear", expected="either a kind of file, or --write DIR")
    if kind is not None:
        sys.stdout.write(schema_text(kind))
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for each in SCHEMAS:
            shutil.copyfile(shipped(each), folder / shipped(each).name)
        stderr.print(f"{len(SCHEMAS)} schemas in {folder}", soft_wrap=True, markup=False, highlight=False)
    return 0
