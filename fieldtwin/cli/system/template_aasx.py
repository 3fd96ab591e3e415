"""`fieldtwin template to-aasx` and `from-aasx`: a template in a package of the Asset Administration Shell (extra `aas`)."""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict
from pathlib import Path

import click

from fieldtwin.cli.losses import show_losses
from fieldtwin.cli.options import json_option
from fieldtwin.cli.output_files import write_bytes
from fieldtwin.console import stderr
from fieldtwin.descriptions.aas.aid import require_library
from fieldtwin.descriptions.aas.system_interfaces import interfaces_of
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.twin.template.check import examine
from fieldtwin.twin.template.package import open_package, unpack

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_OUT = click.Path(dir_okay=False, path_type=Path)


@click.command("to-aasx")
@click.argument("template", type=_FILE)
@click.option("-o", "--out", required=True, type=_OUT, help="The package: FILE.aasx.")
@json_option
def to_aasx_command(template: Path, out: Path, as_json: bool) -> int:
    """Put TEMPLATE, a zip, into a package of the Asset Administration Shell (AASX).

    The shell states the identity of the template and describes its Modbus TCP devices (IDTA 02017). No code of the template
    runs. It needs the extra `aas`.
    """
    require_library()
    from fieldtwin.descriptions.aas.shell_file import MAX_UNPACKED_BYTES
    from fieldtwin.descriptions.aas.template_shell import template_package

    with open_package(template) as package, tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "template"
        unpack(package, folder)
        manifest = package.manifest
        interfaces, losses = interfaces_of(examine(folder, manifest, plant=True, shown=template))
    with reading(template):
        data = read_input(template, MAX_UNPACKED_BYTES)
    write_bytes(out, template_package(data, manifest, interfaces, str(template)))
    if as_json:
        found = {"package": str(out), "id": manifest.id, "interfaces": [each.id_short for each in interfaces]}
        click.echo(json.dumps(found | {"losses": [asdict(loss) for loss in losses]}))
        return 0
    show_losses(losses)
    plural = "" if len(interfaces) == 1 else "s"
    shown = f"{out}: template {manifest.id[:16]}, {len(interfaces)} Modbus interface{plural}"
    stderr.print(shown, soft_wrap=True, markup=False)
    return 0


@click.command("from-aasx")
@click.argument("package", type=_FILE)
@click.option("-o", "--out", required=True, type=_OUT, help="The template: FILE.zip. No file is replaced.")
@json_option
def from_aasx_command(package: Path, out: Path, as_json: bool) -> int:
    """Take the template out of PACKAGE, which `to-aasx` wrote: the same bytes, compared with their hash.

    No code of the template runs. It needs the extra `aas`.
    """
    require_library()
    from fieldtwin.descriptions.aas.shell_file import MAX_UNPACKED_BYTES
    from fieldtwin.descriptions.aas.template_shell import template_of_package

    if out.exists():
        raise FileInvalid("the file already exists", path=str(out), hint="no file is replaced: choose another name")
    with reading(package):
        data = read_input(package, MAX_UNPACKED_BYTES)
    template = template_of_package(data, str(package))
    write_bytes(out, template)
    if as_json:
        click.echo(json.dumps({"template": str(out), "bytes": len(template)}))
        return 0
    stderr.print(f"{out}: {len(template):,} bytes", soft_wrap=True, markup=False)
    return 0
