"""`fieldtwin export recording`, the default of `fieldtwin export`: convert recordings for other programs."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from fieldtwin.cli.options import json_option, profiles_option
from fieldtwin.console import stdout
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.twin.site.data_files import find

_UNITS = {".pcap": "packets", ".pcapng": "packets", ".mcap": "messages"}


@click.command("recording", context_settings={"auto_envvar_prefix": "FIELDTWIN_EXPORT"})
@click.argument("recording", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--profile",
    "profile_name",
    default="",
    metavar="NAME",
    help="Profile whose tags become columns of a table, or a topic of an MCAP file.",
)
@click.option(
    "--framing",
    type=click.Choice(["mbap", "rtu"]),
    default="mbap",
    show_default=True,
    help="Exchanges as packets: as Modbus TCP, or as RTU frames (link type USER0).",
)
@click.option("--endpoint", default="", metavar="URL", help="Endpoint to export from a capture with several endpoints.")
@profiles_option
@json_option
def command(
    recording: Path,
    out: Path,
    profile_name: str,
    framing: str,
    endpoint: str,
    profiles: tuple[Path, ...],
    as_json: bool,
) -> int:
    """Convert RECORDING to OUT; the suffix selects the format: .csv, .parquet, .log (candump), .pcap, .pcapng or .mcap.

    \b
    meter.jsonl   to .csv, .parquet or .mcap (with --profile: in the tags'
                  units), to .pcap or .pcapng for Wireshark
    bus.log       to .csv, .parquet, .pcap, .pcapng, .mcap
    cast.jsonl    recorded signals: to .csv, .parquet or .mcap
    a capture     of run --capture, record --tap or a command's --log:
                  to .pcapng or .mcap; of one endpoint to .pcap;
                  of a CAN bus to .log

    A trace of simulate becomes .pcapng or .mcap by `fieldtwin trace`.
    """
    from fieldtwin.capture.recordings.exporting import export

    profile = load_profile(find("devices", profile_name, extra=profiles)) if profile_name else None
    count = export(recording, out, profile=profile, framing=framing, url=endpoint)
    if as_json:
        json.dump({"out": str(out), "records": count}, sys.stdout)
        sys.stdout.write("\n")
    else:
        stdout.print(
            f"{out}: {count} {_UNITS.get(out.suffix.lower(), 'records')}",
            soft_wrap=True,
            markup=False,
        )
    return 0
