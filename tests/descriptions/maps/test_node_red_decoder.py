"""The function nodes of an exported flow decode registers as the gateway does. Node.js runs them."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from fieldtwin.descriptions.maps.node_red import export_description
from fieldtwin.gateway.core.files.profile import BIT_TABLES
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.devices.codec import decode

PROFILES = Path(__file__).parents[3] / "profiles" / "devices"
RUN = """
const cases = JSON.parse(require('fs').readFileSync(0));
const run = each => new Function('msg', each.func)({payload: each.payload}).payload;
console.log(JSON.stringify(cases.map(run)));
"""


@pytest.mark.interop
@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
@pytest.mark.parametrize(
    "name",
    ["eastron-sdm630", "sunspec-inverter-103", "current-meter", "delta-vfd-e", "renogy-rover", "vehicle-localiser"],
)
def test_function_nodes_decode_registers_as_the_gateway_does(name: str) -> None:
    profile = load_profile(PROFILES / f"{name}.yaml")
    nodes = json.loads(export_description(profile, {}).content)
    chance = random.Random(name)
    registers: dict[tuple[str, int], int] = {}
    cases = []
    for node in nodes:
        if node["type"] == "modbus-read":
            table = {"HoldingRegister": "holding", "InputRegister": "input", "Coil": "coil", "Input": "discrete"}[
                node["dataType"]
            ]
            addresses = range(int(node["adr"]), int(node["adr"]) + int(node["quantity"]))
            most = 1 if table in BIT_TABLES else 0x7E7E  # no pattern of a NaN
            words = [chance.choice([chance.randint(0, most), 0x4142]) for _ in addresses]
            registers |= {(table, address): word for address, word in zip(addresses, words, strict=True)}
            cases.append({"payload": words, "func": next(n["func"] for n in nodes if n["id"] == node["wires"][0][0])})
    done = subprocess.run(
        ["node", "-e", RUN], input=json.dumps(cases), capture_output=True, text=True, check=True, timeout=30
    )
    decoded: dict[str, Scalar | None] = {key: value for part in json.loads(done.stdout) for key, value in part.items()}
    compared = 0
    for tag in profile.tags.values():
        at = tag.registers
        key = f"{tag.name}_raw" if tag.scale_by else tag.name
        if key not in decoded:
            continue
        data = b"".join(registers[at.table, at.address + i].to_bytes(2) for i in range(at.count))
        ours = decode(replace(tag, range=None), data, 0).value
        assert decoded[key] == (pytest.approx(ours, rel=1e-12) if isinstance(ours, float) else ours), key
        compared += 1
    assert compared == len(decoded) > 0
