"""Repeat a failed case of a CANopen node without fieldtwin: ``canopen_device.py CASE can PROGRAM ARGUMENT...``.

The program's bus is a TCP connection with a line for each frame. The frames of the case go to node 5, and its frames are
compared with what CiA 301 requires. The result is one JSON object: `confirmed` is true if the node did what it must not.
Exit status 3: this program has no such case. The node has 2000h (INTEGER16, 7, limits -100 and 100) and 2004h, a text.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

WAIT_S = 1.0
LENGTH = "06070010"
"""The general abort code for a wrong length, which is as right as that for a length that is too high or too low."""


class Bus:
    """The line of the program, and everything that was sent and received."""

    def __init__(self, link: socket.socket) -> None:
        self.link, self.pending, self.log = link, b"", list[str]()

    def send(self, identifier: str, data: str) -> None:
        self.log.append(f"> {identifier}#{data}")
        self.link.sendall(f"{identifier}#{data}\n".encode())

    def hear(self, identifier: str = "585", within_s: float = WAIT_S) -> str:
        """Return the data of the next frame with this identifier, "" if none comes."""
        end = time.monotonic() + within_s
        while True:
            while b"\n" in self.pending:
                line, _, self.pending = self.pending.partition(b"\n")
                got, _, data = line.decode().strip().partition("#")
                if got == identifier:
                    self.log.append(f"< {got}#{data}")
                    return data
            left = end - time.monotonic()
            if left <= 0 or not select.select([self.link], [], [], left)[0]:
                self.log.append("< silence")
                return ""
            chunk = self.link.recv(4096)
            if not chunk:
                return ""
            self.pending += chunk

    def ask(self, data: str) -> str:
        self.send("605", data)
        return self.hear()

    def value(self) -> str:
        """Return the content of 2000h as on the bus."""
        reply = self.ask("4000200000000000")
        return reply[8:12] if reply.startswith("4") else reply


def abort(reply: str) -> str:
    """Return the code of an SDO abort, "" for another frame."""
    return bytes.fromhex(reply[8:])[::-1].hex().upper() if reply.startswith("80") else ""


def aborts(*frames: str, codes: tuple[str, ...], keeps: bool = False) -> Callable[[Bus], str]:
    """The last of these requests must be aborted with one of the codes; with `keeps`, 2000h must not change."""

    def case(bus: Bus) -> str:
        before = bus.value() if keeps else ""
        reply = ""
        for frame in frames:
            reply = bus.ask(frame)
            if abort(reply):
                break
        found = [] if abort(reply) in codes else [f"{reply or 'silence'} instead of an abort with {codes[0]}"]
        if keeps and (after := bus.value()) != before:
            found.append(f"2000h changed from {before} to {after}")
        return "; ".join(found)

    return case


def repeated_toggle(bus: Bus) -> str:
    bus.ask("4004200000000000")
    bus.ask("6000000000000000")
    reply = bus.ask("6000000000000000")
    after = bus.ask("7000000000000000")
    ended = abort(after) == "05040001"
    return "" if abort(reply) == "05030000" and ended else f"{reply or 'silence'}, then {after or 'silence'}"


def client_aborts(bus: Bus) -> str:
    bus.ask("4004200000000000")
    bus.ask("6000000000000000")
    bus.send("605", "8004200000000008")
    reply = bus.ask("7000000000000000")
    return "" if abort(reply) == "05040001" else f"{reply or 'silence'} instead of an abort with 05040001"


def no_size(bus: Bus) -> str:
    reply = bus.ask("2200200008000000")
    held = bus.value()
    return "" if reply.startswith("60") and held == "0800" else f"answers {reply or 'silence'}, and 2000h is {held}"


def boots_after(data: str) -> Callable[[Bus], str]:
    def case(bus: Bus) -> str:
        bus.send("000", data)
        reply = bus.hear("705", 4.0)
        return "" if reply == "00" else "no boot-up message within 4 s"

    return case


def reset_amid(bus: Bus) -> str:
    bus.ask("4004200000000000")
    if missing := boots_after("8205")(bus):
        return missing
    reply = bus.ask("6000000000000000")
    return f"continues the earlier transfer: {reply}" if reply and not abort(reply) else ""


def stopped(bus: Bus) -> str:
    bus.send("000", "0205")
    time.sleep(0.2)
    reply = bus.ask("4000100000000000")
    return f"answers {reply} in STOPPED" if reply else ""


def extended(bus: Bus) -> str:
    bus.send("00000605", "4000100000000000")
    reply = bus.hear()
    return f"answers {reply} to a 29-bit identifier" if reply else ""


def switch(bus: Bus) -> str:
    reply = bus.ask("A004200004000000")  # protocol switch threshold 0: no switch allowed
    return f"an ordinary upload: {reply}" if reply.startswith("4") else ""


CASES: dict[str, Callable[[Bus], str]] = {
    "CO-001a": repeated_toggle,
    "CO-002": client_aborts,
    "CO-003a": aborts("6000000000000000", codes=("05040001",)),
    "CO-003b": aborts("0001020304050607", codes=("05040001",)),
    "CO-006b": aborts("2100100014000000", codes=("06010002",)),
    "CO-008b": aborts("4000100100000000", codes=("06090011",)),
    "CO-009a": aborts("2100200003000000", "0908000000000000", codes=("06070012", LENGTH), keeps=True),
    "CO-009b": aborts("2F00200008000000", codes=("06070013", LENGTH), keeps=True),
    "CO-010a": aborts("2B00200065000000", codes=("06090031", "06090030"), keeps=True),
    "CO-010b": aborts("2B0020009BFF0000", codes=("06090032", "06090030"), keeps=True),
    "CO-013a": aborts("2100200002000000", "0908000000000000", codes=("06070012", LENGTH), keeps=True),
    "CO-013b": aborts("2100200002000000", "0D08000000000000", codes=("06070013", LENGTH), keeps=True),
    "CO-014a": aborts("A004200000000000", codes=("05040002",)),
    "CO-014b": aborts("A004200080000000", codes=("05040002",)),
    "CO-021": switch,
    "CO-027": reset_amid,
    "CO-028": stopped,
    "CO-029": no_size,
    "CO-032a": boots_after("8105"),
    "CO-032b": boots_after("8205"),
    "CO-060": extended,
}
"""Each function returns the deviation in words, or an empty text."""


def main() -> int:
    case, _, *words = sys.argv[1:]
    if case not in CASES:
        return 3
    with (
        tempfile.TemporaryDirectory(dir="/tmp", prefix="ftc") as folder,
        socket.create_server(("127.0.0.1", 0)) as listener,
    ):
        program = subprocess.Popen(
            [f"{folder}/node.eds" if word == "EDS" else word for word in words],
            env={**os.environ, "FIELDTWIN_CAN_LINE": f"127.0.0.1:{listener.getsockname()[1]}"},
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True,
        )  # fmt: skip
        try:
            listener.settimeout(10)
            bus = Bus(listener.accept()[0])
            assert program.stdout is not None
            program.stdout.readline()
            time.sleep(0.3)
            if not bus.ask("4000100000000000").startswith("4"):
                raise RuntimeError("the node does not answer an upload of 1000h")
            bus.pending, bus.log = b"", []
            found = CASES[case](bus)
        finally:
            os.killpg(program.pid, signal.SIGKILL)
            program.wait()
    sent = "; ".join(bus.log[:8])
    print(json.dumps({"confirmed": bool(found), "sent": sent, "observed": found or "it does what it must"}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
