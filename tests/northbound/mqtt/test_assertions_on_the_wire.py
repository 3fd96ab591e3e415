"""Assertions of the Sparkplug specification about the packets of a session, and the list of all assertions in the reference."""

from __future__ import annotations

import asyncio
import re
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hall_publication import TAGS, connected, edge_node, note, note_all, published, silent
from local_mosquitto import broker
from sparkplug_host import Received, host, value_of
from support import eventually, run

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.northbound.mqtt.sparkplug_metrics import metric_name
from fieldtwin.twin.site.servers.broker_url import BrokerUrl
from fieldtwin.twin.thread.sparkplug_payloads import decode_payload, topic

FOLDER = Path(__file__).parent
PAGE = FOLDER.parents[2] / "docs" / "reference" / "sparkplug.md"
LIST: dict[str, dict[str, list[str]]] = tomllib.loads((FOLDER / "assertions.toml").read_text(encoding="utf-8"))
ASSERTIONS = 298
"""The number of testable assertions of version 3.0.0, by its release notes."""


class Recorder:
    """A server that answers an MQTT client as a broker does, and records its packets: the type, the flags, and the rest."""

    def __init__(self) -> None:
        self.packets: list[tuple[int, int, bytes]] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                first = (await reader.readexactly(1))[0]
                kind, flags, body = first >> 4, first & 15, await reader.readexactly(await self._length(reader))
                self.packets.append((kind, flags, body))
                writer.write(self._answer(kind, flags, body))
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()

    def _answer(self, kind: int, flags: int, body: bytes) -> bytes:
        """Return CONNACK, PUBACK, SUBACK, UNSUBACK or PINGRESP."""
        if kind == 3:
            return b"\x40\x02" + self._packet_id(body) if flags & 6 else b""
        answers = {
            1: b"\x20\x02\x00\x00",
            8: b"\x90\x03" + body[:2] + b"\x01",
            10: b"\xb0\x02" + body[:2],
            12: b"\xd0\x00",
        }
        return answers.get(kind, b"")

    @staticmethod
    async def _length(reader: asyncio.StreamReader) -> int:
        length = shift = 0
        while True:
            byte = (await reader.readexactly(1))[0]
            length |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return length

    @staticmethod
    def _packet_id(body: bytes) -> bytes:
        at = 2 + int.from_bytes(body[:2], "big")
        return body[at : at + 2]

    def of(self, kind: int) -> list[tuple[int, int, bytes]]:
        return [packet for packet in self.packets if packet[0] == kind]


def fields(body: bytes) -> list[bytes]:
    """Return the length-prefixed fields of the payload of a CONNECT packet (MQTT 3.1.3)."""
    found, at = [], 10
    while at < len(body):
        size = int.from_bytes(body[at : at + 2], "big")
        found.append(body[at + 2 : at + 2 + size])
        at += 2 + size
    return found


def test_connect_has_a_clean_session_and_the_death_as_its_will(tmp_path: Path) -> None:
    async def main() -> None:
        recorder, node = Recorder(), edge_node(writes=True)
        note_all(node, 2000)
        server = await asyncio.start_server(recorder.serve, "127.0.0.1", 0)
        url = BrokerUrl("127.0.0.1", server.sockets[0].getsockname()[1])
        async with published(node, url, tmp_path) as publisher:
            await connected(publisher)
        await eventually(lambda: bool(recorder.of(14)))
        server.close()
        await server.wait_closed()
        [(_, _, connect)] = recorder.of(1)
        assert connect[:7] == b"\x00\x04MQTT\x04"
        flags = connect[7]
        assert flags & 0x02, "clean session"
        assert flags & 0x04, "a will"
        assert (flags >> 3 & 3, flags & 0x20) == (1, 0), "the will has QoS 1 and is not retained"
        _, will_topic, will = fields(connect)
        assert will_topic == b"spBv1.0/plant/NDEATH/hall"
        death = decode_payload(will)
        assert death.seq is None
        assert [(m.name, m.datatype, m.value) for m in death.metrics] == [("bdSeq", 4, 0)]
        assert [(b[4:-1], b[-1]) for _, _, b in recorder.of(8)] == [
            (b"spBv1.0/plant/NCMD/hall", 1), (b"spBv1.0/plant/DCMD/hall/+", 1),
        ]  # fmt: skip
        kinds = [kind for kind, _, _ in recorder.packets]
        assert kinds.index(8) < kinds.index(3), "it subscribes before it publishes its birth"
        last_publish, goodbye = recorder.packets[-2:]
        assert (last_publish[0], goodbye[0]) == (3, 14)
        assert b"/NDEATH/" in last_publish[2]

    run(main(), 60.0)


def check_order(messages: list[Received]) -> None:
    """Require the sequence numbers of one session (6.4.20): 0 in NBIRTH, and then one more in each message."""
    assert [m.payload.seq for m in messages] == [n % 256 for n in range(len(messages))]
    assert messages[0].kind == "NBIRTH"


def check_birth(message: Received, aliases: dict[int, int]) -> None:
    """Require name, alias, type, value and properties of each metric of a birth. `aliases` gets the type of each alias."""
    for metric in message.payload.metrics:
        assert metric.name
        assert 1 <= metric.datatype <= 34
        assert metric.HasField("timestamp")
        assert metric.is_null or metric.WhichOneof("value")
        if metric.name in ("bdSeq", "Node Control/Rebirth"):
            assert not metric.HasField("alias")
            continue
        assert metric.HasField("alias")
        assert aliases.setdefault(metric.alias, metric.datatype) == metric.datatype
        check_properties(metric)


def check_properties(metric: Any) -> None:
    properties = dict(zip(metric.properties.keys, metric.properties.values, strict=True))
    assert properties["Quality"].type == 3
    assert properties["Quality"].int_value in (0, 192, 500)
    assert {name: each.type for name, each in properties.items() if name != "Quality"} == {
        name: {"Reason": 12, "engUnit": 12, "engLow": 10, "engHigh": 10}[name]
        for name in properties
        if name != "Quality"
    }


@pytest.mark.interop
@pytest.mark.long
@pytest.mark.timeout(180)
def test_every_message_has_times_numbers_and_types_as_required(tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        began_ms = time.time() * 1000
        note_all(node, 2000)
        with broker(tmp_path) as mosquitto, host(mosquitto.port) as watching:
            async with published(node, BrokerUrl("127.0.0.1", mosquitto.port), tmp_path) as publisher:
                await connected(publisher)
                for n in range(300):
                    note(node, 3000 + n, sensor__offset=n, control__total=n)
                    await connected(publisher)
                silent(node, "fan", 4000)
                publisher.wake()
                await eventually(lambda: bool(watching.of("DDEATH", "fan")), within_s=40)
                note_all(node, 5000)
                await connected(publisher)
                await eventually(lambda: len(watching.of("DBIRTH", "fan")) == 2, within_s=40)
            await eventually(lambda: bool(watching.of("NDEATH")), within_s=40)
        messages, aliases = watching.messages[:-1], dict[int, int]()
        check_order(messages)
        assert {m.kind for m in messages} == {"NBIRTH", "DBIRTH", "NDATA", "DDATA", "DDEATH"}
        for message in messages:
            assert (message.qos, message.retain) == (0, False)
            assert began_ms - 1000 < message.payload.timestamp < time.time() * 1000 + 1000
            if "BIRTH" in message.kind:
                check_birth(message, aliases)
                continue
            for metric in message.payload.metrics:
                assert metric.alias in aliases, "its birth came before"
                assert not metric.HasField("name")
                assert not metric.HasField("datatype")
                assert metric.HasField("timestamp")
                check_properties(metric)
        assert len(aliases) == len(TAGS)
        birth = messages[0].by_name
        rebirth = birth["Node Control/Rebirth"]
        assert (rebirth.datatype, value_of(rebirth)) == (11, False)
        assert (birth["bdSeq"].datatype, value_of(birth["bdSeq"])) == (4, 0)
        for device in ("sensor", "fan"):
            assert set(watching.of("DBIRTH", device)[0].by_name) == {t.local for t in TAGS if t.device == device}
        assert [(m.device, list(m.payload.metrics)) for m in messages if m.kind == "DDEATH"] == [("fan", [])]

    run(main(), 120.0)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_names_with_characters_that_mqtt_reserves_are_refused(place: int) -> None:
    for name in ("a+", "a#", "a/b", "", "a\n"):
        names = ["plant", "hall", "sensor"]
        names[place] = name
        if place == 2 and not name:
            continue  # the topic of the node itself
        with pytest.raises(UsageError, match="a name in Sparkplug"):
            topic(names[0], "DBIRTH", names[1], names[2])
    assert topic("Prüfstand 1", "NBIRTH", "hall") == "spBv1.0/Prüfstand 1/NBIRTH/hall"


def test_names_are_unique_within_a_node() -> None:
    """Devices and tags are keys of the system file and of profiles, so that each exists once; names differ by case."""
    node = edge_node()
    names = [(tag.device, metric_name(tag)) for tag in node.tags.values()]
    assert len(set(names)) == len(names)
    assert topic("plant", "DBIRTH", "hall", "Fan") != topic("plant", "DBIRTH", "hall", "fan")


# -- the list ----------------------------------------------------------------------------------------------------------------


def every(section: str) -> list[str]:
    return [name for names in LIST[section].values() for name in names]


def test_each_assertion_is_in_the_list_once() -> None:
    names = [*every("holds"), *every("not_applicable"), *LIST["not_held"], *every("others")]
    assert len(set(names)) == len(names) == ASSERTIONS
    assert all(re.fullmatch(r"[a-zA-Z0-9-]+", name) for name in names)


def test_each_test_of_the_list_exists() -> None:
    for place in LIST["holds"]:
        file, _, function = place.partition("::")
        assert f"\ndef {function}(" in (FOLDER / file).read_text(encoding="utf-8"), place


def tables() -> str:
    """Return the tables of the page."""

    def table(head: str, rows: list[tuple[str, str]]) -> str:
        lines = [f"| assertion | {head} |", "|---|---|", *(f"| `tck-id-{name}` | {text} |" for name, text in rows)]
        return "\n".join(lines) + "\n"

    def rows(section: str, shown: Callable[[str], str]) -> list[tuple[str, str]]:
        return [(name, shown(why)) for why, names in LIST[section].items() for name in names]

    def test_of(place: str) -> str:
        return "`" + place.partition("::")[2].removeprefix("test_").replace("_", " ") + "`"

    parts = [
        ("Assertions that hold", table("test", rows("holds", test_of))),
        ("Assertions that do not apply", table("reason", rows("not_applicable", str))),
        (
            "Assertions about others",
            table("about", rows("others", lambda actor: f"a {actor}" if actor[0] != "M" else f"an {actor}")),
        ),
    ]
    return "\n".join(f"## {title}\n\n{text}" for title, text in parts)


def test_the_page_shows_the_list() -> None:
    """`python tests/northbound/mqtt/test_assertions_on_the_wire.py` writes the tables of the page."""
    page = PAGE.read_text(encoding="utf-8")
    assert page[page.index("## Assertions that hold") :] == tables()
    assert f"| hold | {len(every('holds'))} |" in page
    assert f"| do not apply | {len(every('not_applicable'))} |" in page
    assert f"| are not met | {len(LIST['not_held'])} |" in page
    assert f"| concern host applications or MQTT servers | {len(every('others'))} |" in page


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text[: text.index("## Assertions that hold")] + tables(), encoding="utf-8")
