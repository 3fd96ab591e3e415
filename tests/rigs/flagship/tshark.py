"""Decode with tshark, as an independent dissector: a pcap file in, chosen fields of every packet out."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from fieldtwin.capture.formats.pcap import write_pcap
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.endpoint import Endpoint

needs_tshark = pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")

OPTIONS = {
    "tcp": ["-o", "ip.check_checksum:TRUE", "-o", "tcp.check_checksum:TRUE"],
    "rtu": [
        *("-o", 'uat:user_dlts:"User 0 (DLT=147)","mbrtu","0","","0",""'),
        *("-o", "mbrtu.crc_verification:TRUE"),
    ],
    "can": ["-d", "can.subdissector,canopen"],
}
REMARKS = ("_ws.malformed", "_ws.expert.severity", "_ws.expert.message")
"""tshark's own diagnostics: retransmissions, wrong checksums, malformed frames."""
CHAT = 0x200000
"""The severity of harmless remarks such as "connection establish request"; notes, warnings and errors are above it."""


def dissect(path: Path, captured: list[Captured], endpoint: Endpoint, fields: list[str]) -> list[dict[str, str]]:
    """Write the capture of `endpoint` and dissect it with tshark; return `fields` of every packet, missing ones empty.

    Fails if tshark has a remark on a packet.
    """
    count = write_pcap(path, captured, endpoint)
    wanted = [*fields, *REMARKS, "_ws.col.Protocol"]
    command = ["tshark", "-n", "-r", str(path), *OPTIONS[endpoint.scheme], "-T", "fields", "-E", "separator=|"]
    out = subprocess.run(
        [*command, *(a for f in wanted for a in ("-e", f))],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        env={**os.environ, "HOME": str(path.parent)},  # no preferences except these
    )
    packets = [dict(zip(wanted, line.split("|"), strict=True)) for line in out.stdout.splitlines()]
    assert len(packets) == count, out.stderr
    for number, packet in enumerate(packets, 1):
        severities = [int(s) for s in packet["_ws.expert.severity"].split(",") if s]
        assert not packet["_ws.malformed"], f"packet {number}: {packet}"
        assert max(severities, default=CHAT) <= CHAT, f"packet {number}: {packet}"
    return packets
