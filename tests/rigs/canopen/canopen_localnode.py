"""Run rows of canopen_slave.toml without threads on LocalNode, the node of the `canopen` package, in place of the emulated node.

It has hardly any timers (its heartbeat is a thread of python-can), so only the order of frames is checked.
"""

from __future__ import annotations

import io
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import canopen
from canopen_rows import Row, key_of, parse_frame
from canopen_slave_rig import NODE, RICH

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection

FILE = Path(__file__).parents[2] / "vectors" / "canopen_localnode.toml"
DUMMIES = "".join(f"Dummy{n:04}={n // 5 % 2}\n" for n in range(1, 8))
EVENTS = ("error", "clear", "set")
"""Device events for which LocalNode has a function."""


class _Periodic:
    """A replacement for python-can's cyclic sending in a thread; here it never sends."""

    def stop(self) -> None: ...

    def modify_data(self, message: can.Message) -> None: ...

    update = modify_data


class SilentBus:
    """Record sent frames."""

    def __init__(self) -> None:
        self.sent: list[str] = []

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        data = b"" if message.is_remote_frame else bytes(message.data)
        self.sent.append(str(CanFrame(message.arbitration_id, data, remote=message.is_remote_frame)))

    def send_periodic(self, *_: Any, **__: Any) -> _Periodic:
        return _Periodic()

    def shutdown(self) -> None: ...


def load_known() -> tuple[str, dict[str, str]]:
    """The examined version and its deviations, by row id."""
    file = tomllib.loads(FILE.read_text())
    return file["version"], {entry["id"]: entry["instead"] for entry in file["known"]}


def can_be_asked(row: Row) -> bool:
    """Return whether the row needs only frames and events that LocalNode supports."""
    events = [what[1:].split()[0] for _, what in row.hear if what.startswith("!")]
    return row.node_id == NODE and not row.options and all(event in EVENTS for event in events)


def make_localnode(text: str = RICH) -> tuple[canopen.Network, canopen.LocalNode, SilentBus]:
    """LocalNode with the rig's data sheet, on a separate bus, PRE-OPERATIONAL."""
    sheet = io.StringIO(text.replace("VendorNumber=\n", "VendorNumber=0\n").replace("Dummy0005=1\n", DUMMIES))
    sheet.name = "rig.eds"
    network, bus = canopen.Network(), SilentBus()
    network.bus = bus  # type: ignore[assignment]
    node = canopen.LocalNode(NODE, sheet)  # type: ignore[arg-type]
    network.add_node(node)
    node.nmt.state = "PRE-OPERATIONAL"
    bus.sent.clear()
    return network, node, bus


class LocalNodeOnBus:
    """LocalNode behind our connection. Its exceptions count as silence, because a thread of python-can would swallow them."""

    def __init__(self, connection: CanConnection, text: str = RICH) -> None:
        self._connection = connection
        self._network, self._node, self._bus = make_localnode(text)
        self.raised: list[str] = []

    async def serve(self) -> None:
        """Run until cancelled or lost."""
        try:
            while True:
                frame = await self._connection.recv()
                if not frame.remote and not frame.extended:
                    try:
                        self._network.notify(frame.can_id, bytearray(frame.data), 0.0)
                    except Exception as e:  # errors of the third-party package are what the test examines
                        self.raised.append(type(e).__qualname__)
                for text in self._bus.sent:
                    await self._connection.send(parse_frame(text))
                self._bus.sent.clear()
        finally:
            self._network.bus = None


def play_localnode(row: Row) -> str:
    """Return the deviation of LocalNode from the row, '' if there is none."""
    network, node, bus = make_localnode()
    try:
        for _, what in row.hear:
            step(network, node, what)
    except Exception as e:  # errors of the third-party package are what the test examines
        return f"raises {type(e).__module__}.{type(e).__qualname__}"
    finally:
        network.bus = None
    return difference(row, node, bus.sent)


def step(network: canopen.Network, node: canopen.LocalNode, what: str) -> None:
    if not what.startswith("!"):
        frame = parse_frame(what)
        if not frame.remote and not frame.extended:  # its Network never passes on a remote frame
            network.notify(frame.can_id, bytearray(frame.data), 0.0)
        return
    name, *words = what[1:].split()
    calls: dict[str, Callable[[], None]] = {
        "error": lambda: node.emcy.send(int(words[0], 16), int(words[1], 16) if len(words) > 1 else 1),
        "clear": lambda: node.emcy.reset(),
        "set": lambda: node.set_data(*key_of(words[0]), bytes.fromhex(words[1])),
    }
    calls[name]()


def difference(row: Row, node: canopen.LocalNode, sent: list[str]) -> str:
    wanted = [str(parse_frame(text)) for _, text in row.say]
    for number, frame in enumerate(wanted):
        if number >= len(sent):
            return f"silent instead of {frame}"
        if sent[number] != frame:
            return f"{sent[number]} instead of {frame}"
    if len(sent) > len(wanted):
        return f"sends {sent[len(wanted)]} besides"
    if node.nmt.state != row.state:
        return f"is {node.nmt.state} instead of {row.state}"
    for key, value in row.values.items():
        held = node.get_data(*key_of(key)).hex()
        if held != value:
            return f"holds {held or 'nothing'} in {key} instead of {value or 'nothing'}"
    return ""
