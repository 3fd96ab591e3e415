"""Find the causes of a silent or garbled line, most likely first. The functions do no I/O: they rank causes by evidence.

A weight is not a probability: it orders the causes, and a cause with a weight of 0 is omitted. Each cause states its evidence
and the remedy; if nothing is wrong, the list is empty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fieldtwin.commissioning.scan.can_listener import ObservedBus
from fieldtwin.commissioning.scan.listening import LineVerdict
from fieldtwin.commissioning.scan.settings import name_of
from fieldtwin.commissioning.scan.traffic import Heard
from fieldtwin.gateway.connections.can.facts import CanFacts
from fieldtwin.gateway.connections.serial.line_counters import UartCounters
from fieldtwin.gateway.core.endpoint import SerialSettings

MANY = 0.2
"""Share (0 to 1) of errors, or of bytes in good frames, above which they cannot be due to chance."""
HEALTHY = 0.97
ENOUGH_TEXT = 12
"""Number of received text characters below which they may be text by chance."""
_EDGES = frozenset({0x00, 0x80, 0xC0, 0xE0, 0xF0, 0xF8, 0xFC, 0xFE, 0xFF})
"""The bytes that a receiver gets when the bits of the sender are many times longer than those of the receiver."""


@dataclass(frozen=True, slots=True)
class LikelyCause:
    """One explanation: the cause, its evidence, the remedy. Causes with a larger `weight` are checked first."""

    name: str
    weight: int
    why: str
    remedy: str
    harmless: bool = False
    """True for a cause that is normal and not a fault."""


@dataclass(frozen=True, slots=True)
class ScanProbe:
    """The result of one request that was sent: its echo, and its answer.

    `echo`: ``none``, ``whole`` or ``damaged``. `answer`: ``none``, ``good`` or ``damaged``.
    """

    unit: int
    echo: str
    answer: str
    heard_bytes: int = 0


@dataclass(frozen=True, slots=True)
class SerialEvidence:
    """The evidence about a serial line. `errors` is None if the port has no error counters.

    `verdict` holds the settings that the traffic shows, None without evidence.
    """

    settings: SerialSettings
    heard: Heard
    errors: UartCounters | None = None
    verdict: LineVerdict | None = None
    control: tuple[tuple[str, bool], ...] = ()
    ignored: tuple[str, ...] = ()
    probe: ScanProbe | None = None


def ranked(causes: Iterable[LikelyCause]) -> list[LikelyCause]:
    """Sort the causes, most likely first, without those of weight 0; of equal names only the one with the largest weight."""
    best: dict[str, LikelyCause] = {}
    for cause in causes:
        if cause.weight > 0 and (cause.name not in best or best[cause.name].weight < cause.weight):
            best[cause.name] = cause
    return sorted(best.values(), key=lambda c: (-c.weight, c.name))


# -- serial lines -----------------------------------------------------------------------------------------------------


def serial_causes(e: SerialEvidence) -> list[LikelyCause]:
    """Return the causes of silence, of garbled bytes, and of an unanswered request on a serial line."""
    found: list[LikelyCause] = []
    if e.ignored:
        found.append(
            LikelyCause(
                "the port ignores settings",
                70 if e.heard.bytes and not e.heard.sure else 5,
                f"its driver ignored {', '.join(e.ignored)}",
                "a virtual port has no parity; else use another adapter",
            )
        )
    if not e.heard.bytes:
        answered = e.probe is not None and e.probe.answer == "good"
        found += [] if answered else _of_silence(e)
    elif e.heard.share < HEALTHY or not e.heard.sure or _elsewhere(e) or _many_errors(e):
        found += _of_garbage(e)
    if e.heard.sure:
        found += _of_talk(e.heard)
    if e.errors is not None and e.errors.overrun + e.errors.buffer_overrun:
        lost = e.errors.overrun + e.errors.buffer_overrun
        found.append(
            LikelyCause(
                "this computer reads too slowly", 75, f"{lost} characters were lost in the port", "close other programs"
            )
        )
    if e.probe is not None:
        found += _of_probe(e.probe, e)
    return ranked(found)


def _elsewhere(e: SerialEvidence) -> bool:
    """Return whether the traffic proves settings that differ from the present ones."""
    return e.verdict is not None and e.verdict.sure and e.settings not in (e.verdict.settings, *e.verdict.others)


def _many_errors(e: SerialEvidence) -> bool:
    """Return whether the port counts errors although the frames are whole, for example with a wrong parity."""
    return e.errors is not None and e.errors.parity + e.errors.frame > (1 - HEALTHY) * e.heard.bytes


def _of_silence(e: SerialEvidence) -> list[LikelyCause]:
    causes = []
    breaks = e.errors.breaks + e.errors.frame if e.errors is not None else 0
    if breaks:
        causes.append(
            LikelyCause(
                "A and B swapped",
                90,
                f"no byte, but {breaks} breaks: the line idles at the wrong level",
                "swap A and B",
            )
        )
        causes.append(
            LikelyCause(
                "the line is held low",
                60,
                f"{breaks} breaks",
                "look for a short circuit, missing bias resistors, or a driver that stays enabled",
            )
        )
    elif e.probe is None:
        causes.append(
            LikelyCause(
                "no client sends requests",
                80,
                "a Modbus line is silent until a client sends",
                "this is normal without a client: use `scan`, or `--probe UNIT` to send one request",
                harmless=True,
            )
        )
    control = dict(e.control)
    inputs = [name for name in ("CTS", "DSR", "DCD") if name in control]
    if inputs and not any(control[name] for name in inputs):
        causes.append(
            LikelyCause("nothing is connected", 35, f"{', '.join(inputs)} are all off (an RS485 adapter may leave them so)",
                  "check the device's power, the cable, and the choice of port")
        )  # fmt: skip
    else:
        causes.append(
            LikelyCause("nothing is connected", 30, "no byte and no error", "check the cable and the choice of port")
        )
    if e.errors is None and not breaks:
        causes.append(
            LikelyCause(
                "A and B swapped", 15, "this port has no error counters that would show it", "swap A and B once"
            )
        )
    return causes


def _of_garbage(e: SerialEvidence) -> list[LikelyCause]:
    heard, errors, causes = e.heard, e.errors, []
    if e.verdict is not None and e.verdict.settings != e.settings and e.verdict.heard and e.verdict.heard.sure:
        other = e.verdict.settings
        name = "the baud rate" if other.baudrate != e.settings.baudrate else "the parity or the stop bits"
        return [
            LikelyCause(
                name,
                100,
                f"at {name_of(other)} there are {e.verdict.heard.frames} valid frames",
                f"use {name_of(other)}",
            )
        ]
    total = max(1, heard.bytes)
    parity = errors.parity / total if errors is not None else 0.0
    framing = errors.frame / total if errors is not None else 0.0
    edges = sum(n for value, n in heard.values.items() if value in _EDGES) / total
    text = sum(n for value, n in heard.values.items() if 0x20 <= value < 0x7F or value in (0x0A, 0x0D)) / total
    if text > 0.9 and total >= ENOUGH_TEXT and heard.framing == "rtu":
        colons = heard.values.get(0x3A, 0)
        what = "Modbus ASCII, perhaps" if colons and heard.values.get(0x0D) else "not Modbus RTU"
        causes.append(
            LikelyCause("another protocol", 90, f"{text:.0%} of it is readable text: {what}", "try ascii:PORT")
        )
    if heard.frames and heard.share > MANY:
        if heard.glitches >= max(2, heard.frames // 4):
            causes.append(
                LikelyCause("direction control", 85, f"{heard.glitches} stray bytes and {heard.frames} good frames",
                      "the transceiver is switched too early or too late: rs485=1, or an adapter that switches by itself")
            )  # fmt: skip
        damaged = f"{heard.bad_frames} damaged and {heard.frames} good frames"
        causes.append(
            LikelyCause("termination or noise", 70, damaged, "check 120 ohms at both ends only, bias resistors, shield")
        )
        causes.append(
            LikelyCause("two units answer at once", 40, damaged, "check whether two devices have the same unit ID")
        )
    elif parity > MANY and framing < parity:
        causes.append(
            LikelyCause(
                "the parity or the stop bits", 95, f"{parity:.0%} of the bytes have a wrong parity", "8E1, 8O1, 8N1"
            )
        )
    if not heard.frames or heard.share <= MANY:
        faster = edges > 0.6
        causes.append(
            LikelyCause("the baud rate", 85 if framing > MANY or faster else 60,
                  f"{framing:.0%} framing errors" if framing > MANY else
                  "long bits: the sender is slower than this port" if faster else "bytes, but no valid frame",
                  "`scan --listen` tries other settings without sending")
        )  # fmt: skip
        breaks = errors.breaks if errors is not None else 0
        causes.append(
            LikelyCause(
                "A and B swapped",
                88 if breaks else 45,
                f"{breaks} breaks" if breaks else "no whole frame",
                "swap A and B",
            )
        )
        causes.append(
            LikelyCause(
                "termination or noise", 30, "no whole frame", "check whether a device sends, or the line is open"
            )
        )
        if text <= 0.9:
            causes.append(LikelyCause("another protocol", 25, "no whole frame", "check which protocol is expected"))
    return causes


def _of_talk(heard: Heard) -> list[LikelyCause]:
    causes = []
    asked = sum(u.requests for u in heard.units.values())
    answered = sum(u.replies + u.exceptions for u in heard.units.values())
    if asked and not answered:
        causes.append(
            LikelyCause("only the client is received", 80, f"{asked} requests and no reply",
                  "the devices are off, or have different settings; on RS232 an adapter receives one direction")
        )  # fmt: skip
    elif answered and not asked:
        causes.append(
            LikelyCause(
                "only devices are received",
                80,
                f"{answered} replies and no request",
                "on RS232 an adapter receives one direction",
            )
        )
    elif heard.silent:
        units = ", ".join(map(str, heard.silent[:10]))
        causes.append(
            LikelyCause(
                "units that do not answer", 60, f"no reply from units {units}", "check their power and their unit IDs"
            )
        )
    if heard.repeated > asked // 2 and heard.repeated > 2:
        causes.append(
            LikelyCause(
                "an echo", 40, f"{heard.repeated} requests came twice", "the sender's adapter receives its own frames"
            )
        )
    return causes


def _of_probe(probe: ScanProbe, e: SerialEvidence) -> list[LikelyCause]:
    if probe.answer == "good":
        return []
    unit = f"unit {probe.unit}"
    if probe.answer == "damaged":
        return [
            LikelyCause(
                "termination or noise",
                80,
                f"{unit} answered, damaged",
                "check 120 ohms at both ends, bias resistors, shield",
            ),
            LikelyCause("the parity or the stop bits", 75, f"{unit} answered, damaged", "8E1, 8O1, 8N1"),
            LikelyCause(
                "two units answer at once",
                60,
                f"{unit} answered, damaged",
                "check whether two devices have this unit ID",
            ),
            LikelyCause(
                "direction control", 50, f"{unit} answered, damaged", "rs485=1, or an adapter that switches by itself"
            ),
        ]
    if probe.echo == "damaged":
        return [
            LikelyCause(
                "termination or noise",
                88,
                "our own request came back damaged",
                "a short circuit, or another sender on the line",
            ),
            LikelyCause(
                "another master", 80, "our own request came back damaged", "listen for longer: `line --listen 60s`"
            ),
        ]
    wrong = [
        LikelyCause("a different unit ID", 85, f"{unit} does not answer", "`scan` tries all"),
        LikelyCause("the baud rate", 75, f"{unit} does not answer", "`scan` tries the likely settings"),
    ]
    if probe.echo == "whole":
        return [
            *wrong,
            LikelyCause(
                "A and B swapped", 60, "only our own echo is received, so this end works", "swap A and B at the device"
            ),
            LikelyCause(
                "the device is off", 55, "only our own echo is received", "check its power and the ground connection"
            ),
        ]
    return [
        *wrong,
        LikelyCause("A and B swapped", 70, f"no echo, no answer from {unit}", "swap A and B once"),
        LikelyCause(
            "direction control",
            65,
            "there is no sign that the request was sent",
            "rs485=1, or an adapter that switches by itself",
        ),
        LikelyCause(
            "nothing is connected", 60, f"no echo, no answer from {unit}", "check the cable and the device's power"
        ),
    ]


# -- CAN --------------------------------------------------------------------------------------------------------------


def can_causes(facts: CanFacts, heard: ObservedBus, load: float) -> list[LikelyCause]:
    """Return the causes of a silent CAN bus, of errors, and of a bus load that is too high."""
    found: list[LikelyCause] = []
    errors = facts.tx_errors + facts.rx_errors
    if facts.state == "bus-off":
        found.append(
            LikelyCause("the controller is off", 100, "bus-off: its own frames failed 32 times",
                  "bit rate and wiring first, then `ip link set IFACE down` and `up`")
        )  # fmt: skip
    if facts.tx_errors >= 96:
        why = f"{facts.tx_errors} transmit errors: no node acknowledges"
        found.append(LikelyCause("alone on the bus", 85, why, "check that another node is on, with the same bit rate"))
    if heard.errors and not heard.frames:
        why = f"{heard.errors} error frames and no valid one"
        found.append(LikelyCause("the bit rate", 90, why, "compare with the other nodes"))
        found.append(LikelyCause("CAN-H and CAN-L swapped", 70, why, "swap them"))
        found.append(
            LikelyCause("termination or noise", 60, why, "60 ohms between CAN-H and CAN-L when everything is off")
        )
    elif heard.errors or (facts.rx_errors >= 96 and heard.frames):
        why = f"{heard.errors} error frames and {heard.frames} good ones"
        found.append(
            LikelyCause(
                "termination or noise", 80, why, "60 ohms between CAN-H and CAN-L when everything is off; short stubs"
            )
        )
        found.append(LikelyCause("a node at another bit rate", 60, why, "disconnect nodes one by one"))
    elif not heard.frames:
        why = "no frame and no error" + (f", {errors} errors counted" if errors else "")
        found.append(
            LikelyCause(
                "no node sends", 80, why, "nodes without a heartbeat are silent: use `scan` to ask them", harmless=True
            )
        )
        found.append(LikelyCause("nothing is connected", 45, why, "check the cable and the choice of interface"))
    if load > 0.8:
        found.append(
            LikelyCause("the bus is full", 75, f"load {load:.0%}", "longer PDO inhibit times, a higher bit rate")
        )
    doubled = [n for n, node in heard.nodes.items() if node.boot_ups > 2]
    if doubled:
        why = f"node {', '.join(map(str, doubled))} boots repeatedly"
        found.append(
            LikelyCause("a node restarts", 70, why, "check its supply, its watchdog, and whether a master resets it")
        )
    return ranked(found)


# -- TCP --------------------------------------------------------------------------------------------------------------


def tcp_causes(problem: str, heard: bytes, hung_up: bool, port: int) -> list[LikelyCause]:
    """Return the causes if a host cannot be reached or misbehaves.

    `problem` is the operating system's error ("" if connected), `heard` the unrequested data, and `hung_up` whether the host
    closed the connection.
    """
    text = problem.lower()
    table: list[tuple[Callable[[], bool], list[LikelyCause]]] = [
        (lambda: "refused" in text, [
            LikelyCause("no program listens there", 90, f"the host refuses port {port}", "check the port and the service"),
            LikelyCause("a firewall", 40, "some firewalls refuse like a host", "ask its administrator"),
        ]),
        (lambda: "timed out" in text or "no answer" in text, [
            LikelyCause("the host is off, or a firewall drops packets", 90, problem, "ping it, and check the address"),
        ]),
        (lambda: "route" in text or "unreachable" in text, [
            LikelyCause("no route to that network", 90, problem, "address, netmask and gateway of this computer"),
        ]),
        (lambda: "name" in text or "known" in text, [LikelyCause("the name is not known", 90, problem, "use the address")]),
        (lambda: bool(problem), [LikelyCause("the connection fails", 60, problem, "")]),
        (lambda: hung_up, [
            LikelyCause("no room for another client", 80, "it closes the connection at once",
                        "close other clients: many allow 1 to 5"),
            LikelyCause("an allow list", 60, "it closes the connection at once", "add this computer to the list"),
        ]),
        (lambda: bool(heard), [
            LikelyCause("another protocol", 90, f"it sends unrequested data: {heard[:16].hex(' ')}",
                        "a Modbus server only replies"),
        ]),
    ]  # fmt: skip
    for holds, causes in table:
        if holds():
            return ranked(causes)
    return []
