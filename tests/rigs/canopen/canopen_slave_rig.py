"""Helpers for the tests of the emulated CANopen node: a data sheet with every kind of object, and control of the node."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.lss.slave import UNCONFIGURED
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS

ROOT = Path(__file__).parents[3]
INCLINOMETER = ROOT / "profiles" / "devices" / "inclinometer-cia410.eds"
NODE = 5
U8, I16, U16, U32, I8, STRING, DOMAIN, U64, BOOL, F32 = 5, 3, 6, 7, 2, 9, 0xF, 0x1B, 1, 8


def var(section: str, data_type: int, access: str = "rw", default: object = "", pdo: int = 0, limits: str = "") -> str:
    low, _, high = limits.partition("..")
    return (
        f"[{section}]\nParameterName={section}\nObjectType=0x7\nDataType=0x{data_type:04X}\nAccessType={access}\n"
        f"DefaultValue={default}\nPDOMapping={pdo}\nLowLimit={low}\nHighLimit={high}\n"
    )


def record(index: str, subs: list[str], kind: int = 9) -> str:
    return f"[{index}]\nParameterName={index}\nObjectType=0x{kind:X}\nSubNumber={len(subs)}\n" + "".join(subs)


def pdo(comm: str, mapping: str, cob: str, kind: int, maps: list[int], room: int = 8) -> str:
    entries = [var(f"{mapping}sub0", U8, "rw", len(maps))]
    entries += [
        var(f"{mapping}sub{n + 1:X}", U32, "rw", f"0x{maps[n] if n < len(maps) else 0:08X}") for n in range(room)
    ]
    parameters = [
        var(f"{comm}sub0", U8, "const", 6),
        var(f"{comm}sub1", U32, "rw", cob),
        var(f"{comm}sub2", U8, "rw", kind),
        var(f"{comm}sub3", U16, "rw", 0),
        var(f"{comm}sub5", U16, "rw", 0),
        var(f"{comm}sub6", U8, "rw", 0),
    ]
    return record(comm, parameters) + record(mapping, entries)


RICH = "".join(
    [
        "[DeviceInfo]\nVendorName=rig\nVendorNumber=\nNrOfTXPDO=2\nNrOfRXPDO=2\nLSS_Supported=1\nBaudRate_125=1\nBaudRate_500=1\n",
        "[DummyUsage]\nDummy0005=1\n",
        var("1000", U32, "ro", "0x0"),
        var("1001", U8, "ro", 0, 1),
        record("1003", [var("1003sub0", U8), *(var(f"1003sub{n}", U32, "ro") for n in (1, 2, 3))], 8),
        var("1005", U32, "rw", "0x80"),
        var("1006", U32, "rw", 0),
        var("1007", U32, "rw", 0),
        var("1008", STRING, "const", "a node for tests"),
        var("100C", U16, "rw", 0),
        var("100D", U8, "rw", 0),
        record("1010", [var("1010sub0", U8, "ro", 3), *(var(f"1010sub{n}", U32, "rw", 1) for n in (1, 2, 3))], 8),
        record("1011", [var("1011sub0", U8, "ro", 3), *(var(f"1011sub{n}", U32, "rw", 1) for n in (1, 2, 3))], 8),
        var("1012", U32, "rw", "0x80000100"),
        var("1014", U32, "rw", "$NODEID+0x80"),
        var("1015", U16, "rw", 0),
        record("1016", [var("1016sub0", U8, "ro", 2), var("1016sub1", U32), var("1016sub2", U32)], 8),
        var("1017", U16, "rw", 0),
        record(
            "1018",
            [
                var("1018sub0", U8, "const", 4),
                *(var(f"1018sub{n}", U32, "ro", v) for n, v in ((1, 0x1F4), (2, 0x20), (3, 3), (4, 0x12345678))),
            ],
        ),
        var("1019", U8, "rw", 0),
        record(
            "1201",
            [
                var("1201sub0", U8, "const", 3),
                var("1201sub1", U32, "rw", "0x80000000"),
                var("1201sub2", U32, "rw", "0x80000000"),
                var("1201sub3", U8, "rw", 0),
            ],
        ),
        record("1029", [var("1029sub0", U8, "ro", 1), var("1029sub1", U8)], 8),
        pdo("1400", "1600", "$NODEID+0x200", 255, [0x20000010, 0x20010008]),
        pdo("1401", "1601", "$NODEID+0x300", 1, [0x00050008, 0x20000010]),
        pdo("1800", "1A00", "$NODEID+0x180", 254, [0x20000010, 0x20020010]),
        pdo("1801", "1A01", "$NODEID+0xC0000280", 1, [0x20020010]),
        var("2000", I16, "rw", 0, 1, "-100..100"),
        var("2001", U8, "rww", 0, 1),
        var("2002", U16, "ro", 0, 1),
        var("2003", U32, "wo", 0),
        var("2004", STRING, "rw", "hello"),
        var("2005", U64, "rw", "0x1122334455667788"),
        var("2006", U16, "rw", 7),
        var("2007", BOOL, "rw", 0),
        var("2008", F32, "rw", "1.5", 0, "0..10"),
        "[2009]\nParameterName=blob\nObjectType=0x2\nDataType=0x000F\nAccessType=rw\n",
        record("2010", [var("2010sub0", U8, "ro", 2), var("2010sub1", U16), var("2010sub2", U16)], 8),
        var("6000", U16, "rw", 10),
    ]
)


class Rig:
    """One node and a manual clock. Frames are strings in candump's notation."""

    def __init__(self, text: str = RICH, context: NodeContext | None = None, node_id: int = NODE) -> None:
        self.node = CanopenNode(parse_eds(text), node_id, context)
        self.node_id = node_id
        self.now_ns = 1_000_000_000
        self.boot = self.texts(self.node.start(self.now_ns))

    @staticmethod
    def texts(frames: list[CanFrame]) -> list[str]:
        return [str(frame) for frame in frames]

    def send(self, can_id: int, data: str = "", *, remote: bool = False, extended: bool = False) -> list[str]:
        """Put a frame with hex data on the bus; return the node's frames in reply."""
        frame = CanFrame(can_id, b"" if remote else bytes.fromhex(data), remote=remote, extended=extended)
        return self.texts(self.node.feed(frame, self.now_ns))

    def nmt(self, command: int, node_id: int | None = None) -> list[str]:
        return self.send(0, bytes([command, self.node_id if node_id is None else node_id]).hex())

    def sdo(self, data: str) -> str:
        """Send one SDO request, padded with zeros; return the data of its only reply, or '' for silence."""
        return self.sdo_and_more(data)[0]

    def sdo_and_more(self, data: str) -> tuple[str, list[str]]:
        frames = self.send(0x600 + self.node_id, data.replace(" ", "").ljust(16, "0"))
        head = f"{0x580 + self.node_id:03X}#"
        replies = [f.removeprefix(head) for f in frames if f.startswith(head)]
        assert len(replies) <= 1, f"one request, many replies: {replies}"
        return (replies[0] if replies else ""), [f for f in frames if not f.startswith(head)]

    def write(self, index: int, sub: int, value: int, size: int) -> str:
        """Make an expedited download; return '' on success, else the abort code in hex."""
        data = bytes([0x23 | (4 - size) << 2]) + mux(index, sub) + value.to_bytes(size, "little", signed=value < 0)
        return code(self.sdo(data.hex()))

    def read(self, index: int, sub: int = 0) -> int:
        """Make an expedited upload of an unsigned number."""
        reply = bytes.fromhex(self.sdo((b"\x40" + mux(index, sub)).hex()))
        assert reply[0] & 0xF3 == 0x43, reply.hex()
        return int.from_bytes(reply[4 : 8 - (reply[0] >> 2 & 3)], "little")

    def read_code(self, index: int, sub: int = 0) -> str:
        return code(self.sdo((b"\x40" + mux(index, sub)).hex()))

    def advance(self, ms: float) -> list[tuple[float, str]]:
        """Let time pass and wake the node exactly when it requests it; return (ms since the call, frame)."""
        start, end = self.now_ns, self.now_ns + int(ms * NS_PER_MS)
        sent: list[tuple[float, str]] = []
        for _ in range(100_000):
            wake = self.node.wake_at_ns()
            if wake is None or wake > end:
                break
            self.now_ns = max(self.now_ns, wake)
            frames = self.node.tick(self.now_ns)
            sent += [((self.now_ns - start) / NS_PER_MS, str(frame)) for frame in frames]
        else:
            raise AssertionError("the node asks to be woken without end")
        self.now_ns = end
        return sent


def mux(index: int, sub: int) -> bytes:
    return index.to_bytes(2, "little") + bytes([sub])


def code(reply: str) -> str:
    """Return the abort code of a reply, '' if it is not an abort."""
    raw = bytes.fromhex(reply)
    assert raw, "no reply"
    return raw[:3:-1].hex().upper() if raw[0] == 0x80 else ""


def unnamed(identity: tuple[int, ...]) -> CanopenNode:
    factory = {(0x1018, sub): part.to_bytes(4, "little") for sub, part in enumerate(identity, start=1)}
    return CanopenNode(parse_eds(RICH), UNCONFIGURED, NodeContext(factory=factory))
