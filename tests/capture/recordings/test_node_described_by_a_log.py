"""A node described only by a log: it has the objects in the log, and sends the recorded frames."""

from __future__ import annotations

import pytest

from fieldtwin.capture.recordings.log_sheet import LogSheet, nodes_of
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.replay.objects import RecordedObjects
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.candump import line_of, read_lines

MS = 1_000_000
Log = list[tuple[int, CanFrame]]
ASKED = """\
0 605#4018100400000000 585#43181004EFBEADDE
10 605#4004200000000000 585#410420000A000000
12 605#6000000000000000 585#007265636F726465
14 605#7000000000000000 585#1964206F00000000
20 605#4006200000000000 585#4B06200063000000
22 605#2B06200064000000 585#6006200000000000
30 605#4010200000000000 585#8010200000000206
40 605#4011200000000000 585#8011200022000008
"""


def frame(text: str) -> CanFrame:
    identifier, _, data = text.partition("#")
    return CanFrame(int(identifier, 16), bytes.fromhex(data))


def log() -> Log:
    """SDO traffic, then 2 s of a heartbeat every 100 ms and a TPDO of three bytes every 50 ms, which counts."""
    out: Log = []
    for line in ASKED.splitlines():
        at, *frames = line.split()
        out += [((int(at) + n) * MS, frame(text)) for n, text in enumerate(frames)]
    out += [(at * MS, frame("705#05")) for at in range(100, 2100, 100)]
    out += [(at * MS, frame(f"185#{at // 50:02X}0AFF")) for at in range(110, 2110, 50)]
    return sorted(out, key=lambda pair: pair[0])


def node_of(frames: Log) -> CanopenNode:
    text = LogSheet(frames, 5).eds("a log")
    dictionary = parse_eds(text)
    assert not dictionary.notes, "there is nothing to mend in it"
    written = read_lines(line_of(t_ns, f) for t_ns, f in frames)
    objects = RecordedObjects(((t_ns, f) for t_ns, _, f in written), dictionary, 5)
    return CanopenNode(dictionary, 5, NodeContext(source=objects, factory=objects.initial, refusals=objects.refusals))


def test_a_node_from_a_log_answers_and_sends_as_recorded() -> None:
    frames = log()
    assert nodes_of(frames) == [5]
    node = node_of(frames)
    again: Log = [(0, f) for f in node.start(0)]
    for t_ns, asked in frames:
        if asked.can_id == 0x605:
            again.append((t_ns, asked))
            again += [(t_ns + MS, answer) for answer in node.feed(asked, t_ns)]
    again = [pair for pair in again if pair[1].can_id in (0x605, 0x585)]
    sdo = [pair for pair in frames if pair[1].can_id in (0x605, 0x585)]
    assert [str(f) for _, f in again] == [str(f) for _, f in sdo]
    assert node.feed(CanFrame(0, b"\x01\x05"), 100 * MS) is not None
    sent: Log = []
    while (due_ns := node.wake_at_ns()) is not None and due_ns <= 2000 * MS:
        sent += [(due_ns, f) for f in node.tick(due_ns)]
    beats = [t for t, f in sent if f.can_id == 0x705]
    data = [f.data for _, f in sent if f.can_id == 0x185]
    assert 18 <= len(beats) <= 20
    assert all(len(d) == 3 and d[1:] == b"\x0a\xff" for d in data)
    assert sorted(d[0] for d in data) == [d[0] for d in data], "the signal is played"
    assert 35 <= len({d[0] for d in data}) <= 41


def test_a_mapping_in_the_log_is_used() -> None:
    told = "605#40001A0000000000 585#4F001A0001000000 605#40001A0100000000 585#43001A0110000260"
    frames = [(n * MS, frame(text)) for n, text in enumerate(told.split())]
    frames += [(at * MS, frame("185#3412")) for at in range(100, 600, 100)]
    text = LogSheet(frames, 5).eds("x")
    assert "[6002]" in text
    assert "[5F01" not in text
    node = node_of(frames)
    node.start(0)
    [answer] = node.feed(frame("605#4002600000000000"), 200 * MS)
    assert str(answer) == "585#4B02600034120000"


def test_a_log_without_the_node() -> None:
    with pytest.raises(UsageError, match="nothing of node 6"):
        LogSheet(log(), 6)
