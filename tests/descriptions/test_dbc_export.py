"""DBC: cantools decodes the candump log of an emulated node with our export, and finds the values of our tags."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

import can
import canopen
import cantools.database
import pytest
from canopen.profiles.p402 import BaseNode402
from support import run

from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.descriptions.canopen import dbc
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.models.canopen.emulated_node import emulated_node
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping
from fieldtwin.gateway.wallclock import WallClock

DEVICES = Path(__file__).parents[2] / "profiles" / "devices"
NODE, EVENT_MS = 7, 20


def shipped(name: str) -> DeviceProfile:
    return load_profile(DEVICES / f"{name}.yaml")


def database_of(profile: DeviceProfile, node: int) -> cantools.database.can.Database:
    """Return our export as cantools reads it from a file."""
    text = dbc.export_description(profile, {"node": str(node)}).content.decode("cp1252")
    found = cantools.database.load_string(text, "dbc")
    assert isinstance(found, cantools.database.can.Database)
    return found


def record_a_drive(profile: DeviceProfile, log: Path) -> None:
    """Let the canopen package turn an emulated drive, while python-can writes a candump log of the software bus."""

    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 500_000)
        node = emulated_node(profile, NODE, None, 0).node
        try:
            async with Nursery() as nursery:
                nursery.start(serve_node(server.attach("drive"), node, WallClock()), "drive")
                host, port = server.bound.address
                await asyncio.to_thread(turn, f"{host}:{port}", profile, log)
        finally:
            await server.aclose()

    run(main(), timeout_s=60)


def turn(channel: str, profile: DeviceProfile, log: Path) -> None:
    network = canopen.Network(SoftBus(channel))
    network.connect()
    listener = SoftBus(channel)
    notifier = can.Notifier(listener, [can.Logger(str(log))])
    try:
        node = BaseNode402(NODE, str(profile.eds_path))
        network.add_node(node)
        for pdo in range(4):
            node.sdo[0x1800 + pdo][5].raw = EVENT_MS
        node.nmt.state = "PRE-OPERATIONAL"
        node.setup_402_state_machine()
        node.nmt.state = "OPERATIONAL"
        node.op_mode = "PROFILED VELOCITY"
        node.state = "OPERATION ENABLED"
        node.sdo[0x60FF].raw = -20_000
        until(lambda: node.sdo[0x606C].raw == -20_000)
        count = len(log.read_bytes()) if log.exists() else 0
        until(lambda: node.sdo[0x6064].raw < -1000 and len(log.read_bytes()) > count)
    finally:
        notifier.stop()
        listener.shutdown()
        network.disconnect()


def until(condition: Callable[[], bool], within_s: float = 30.0) -> None:
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_cantools_decodes_the_log_of_an_emulated_drive_as_our_tags(tmp_path: Path) -> None:
    profile, log = shipped("drive-cia402"), tmp_path / "drive.log"
    record_a_drive(profile, log)
    database, tags = database_of(profile, NODE), TagMap(profile)
    assert profile.eds_path is not None
    dictionary = load_dictionary(profile.eds_path, NODE)
    seen: dict[str, set[object]] = {}
    for frame in can.CanutilsLogReader(log):
        number = {0x187: 0, 0x287: 1, 0x387: 2, 0x487: 3}.get(frame.arbitration_id)
        if number is None:
            continue
        decoded = database.decode_message(frame.arbitration_id, bytes(frame.data), decode_choices=False)
        count = dictionary.entries[0x1A00 + number, 0].default
        assert isinstance(count, int)
        words = [dictionary.entries[0x1A00 + number, sub].default for sub in range(1, count + 1)]
        mapping = PdoMapping.from_words([word for word in words if isinstance(word, int)])
        ours: dict[str, object] = {}
        for entry, data in zip(mapping.entries, mapping.unpack(bytes(frame.data)), strict=True):
            ours |= tags.of_object(entry.index, entry.subindex, data, 0)
        assert decoded == ours
        for name, value in ours.items():
            seen.setdefault(name, set()).add(value)
    assert set(seen) == {"statusword", "mode_display", "position", "velocity"}
    assert -20_000 in seen["velocity"]
    assert len(seen["position"]) > 3
    assert 3 in seen["mode_display"]


def test_scale_offset_unit_and_names_of_values_are_those_of_the_tags(tmp_path: Path) -> None:
    text = (DEVICES / "inclinometer-cia410.yaml").read_text(encoding="utf-8")
    (tmp_path / "inclinometer-cia410.eds").write_bytes((DEVICES / "inclinometer-cia410.eds").read_bytes())
    path = tmp_path / "tilt.yaml"
    path.write_text(text, encoding="utf-8")
    profile = load_profile(path)
    database = database_of(profile, 5)
    signals = {signal.name: signal for message in database.messages for signal in message.signals}
    carried = [tag for tag in profile.tags.values() if tag.name in signals]
    assert carried
    for tag in carried:
        signal = signals[tag.name]
        assert (signal.scale, signal.offset, signal.unit or "") == (tag.scale, tag.offset, tag.unit)
    names = {
        signal.name: signal.choices for m in database_of(shipped("drive-cia402"), 7).messages for signal in m.signals
    }
    assert {int(n): str(v) for n, v in (names["mode"] or {}).items()} == dict(
        shipped("drive-cia402").tags["mode"].values
    )


def test_senders_and_can_ids_are_those_of_the_node() -> None:
    database = database_of(shipped("io-cia401"), 9)
    assert {(m.frame_id, m.name, tuple(m.senders)) for m in database.messages} == {
        (0x189, "io_cia401_TPDO1", ("io_cia401",)),
        (0x289, "io_cia401_TPDO2", ("io_cia401",)),
        (0x209, "io_cia401_RPDO1", ("master",)),
        (0x309, "io_cia401_RPDO2", ("master",)),
    }


def with_eds(folder: Path, *changes: tuple[str, str]) -> DeviceProfile:
    """Return the I/O module with changes in the text of its EDS."""
    text = (DEVICES / "io-cia401.eds").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "io-cia401.eds").write_text(text, encoding="utf-8")
    path = folder / "io.yaml"
    path.write_text((DEVICES / "io-cia401.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    return load_profile(path)


@pytest.mark.parametrize(
    ("change", "place", "why"),
    [
        (("0x60000108", "0x60000178"), "TPDO1", "its mapping is not valid"),
        (("0x60000208", "0x60000108"), "TPDO1", "names in a message differ"),
        (("0x60000208", "0x60000204"), "signal inputs_2", "4 bits of type UNSIGNED8 are an unsigned number"),
        (("$NODEID+0x180", "$NODEID+0x80000180"), "TPDO1", "does not exist (bit 31)"),
    ],
)
def test_what_a_dbc_cannot_say_is_listed(change: tuple[str, str], place: str, why: str, tmp_path: Path) -> None:
    losses = dbc.export_description(with_eds(tmp_path, change), {}).losses
    assert any(loss.place == place and why in loss.why for loss in losses), losses


def test_dummies_leave_a_gap(tmp_path: Path) -> None:
    (message,) = [
        m for m in database_of(with_eds(tmp_path, ("0x60000108", "0x00050008")), 6).messages if m.frame_id == 0x186
    ]
    assert [(s.name, s.start) for s in message.signals] == [("inputs_2", 8)]


def test_a_profile_without_a_mapped_pdo_is_refused(tmp_path: Path) -> None:
    profile = with_eds(tmp_path, ("[1A0", "[2A0"), ("[160", "[260"))
    with pytest.raises(FileInvalid, match="no PDO of this node is mapped"):
        dbc.export_description(profile, {})
    with pytest.raises(UsageError, match="modbus device"):
        dbc.export_description(shipped("eastron-sdm630"), {})
