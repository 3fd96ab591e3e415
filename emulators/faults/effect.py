"""Check whether a fault can change anything at its target.

A fault that cannot change anything is refused when its file is loaded, because it would test nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.emulators.faults.can_fault import SDO_REPLY, SDO_REQUEST, CanFault, only_sends
from fieldtwin.emulators.faults.fault import WireFault
from fieldtwin.emulators.faults.frames import MODBUS, FrameDirection, Framing
from fieldtwin.emulators.faults.schema import FUNCTIONS_OF, FaultSpec, addressed
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.profile import Table

WORDS = {
    Framing.RTU: "RTU frames",
    Framing.ASCII: "ASCII frames",
    Framing.MBAP: "Modbus TCP frames",
    Framing.THREAD: "datagrams of a digital thread",
    Framing.MQTT: "MQTT messages",
    Framing.RAW: "bytes of an unknown format",
}
_OF_MODBUS = ("unit", "function", "address", "registers")
_OF_CHANGED_FRAMES = ("nth", "every", "direction", "probability")
_INITIATES = {FrameDirection.REQUEST: (1, 2), FrameDirection.REPLY: (2, 3)}
"""The command specifiers of the SDO frames that name an object, apart from blocks (CiA 301, 7.2.4.3)."""


def check_wire_effect(spec: FaultSpec, framing: Framing, table: Table | None = None) -> None:
    """Raise `WrongAim` for a fault that changes no frame of `framing`, or none at which it aims.

    `table` is the table of the register at which it aims by name.
    """
    kind, aim = spec.kind, spec.aim
    if not issubclass(kind, WireFault):
        return
    if framing not in kind.framings:
        raise WrongAim(
            "name", f"fault {kind.name} changes nothing in {WORDS[framing]}", expected=_words(kind.framings),
            hint=kind.summary,
        )  # fmt: skip
    for key in _OF_MODBUS if framing not in MODBUS else ():
        if getattr(aim, key) is not None:
            raise WrongAim(key, f"{WORDS[framing]} have no {key}", expected=_words(MODBUS))
    aimed = [("function", frozenset({aim.function}) if aim.function is not None else frozenset[int]())]
    aimed.append(("address", frozenset[int]() if aim.address is None else addressed(aim.address)[1]))
    aimed.append(("register", frozenset[int]() if table is None else FUNCTIONS_OF[table]))
    possible = kind.functions
    for key, functions in aimed:
        if functions and possible and not functions & possible:
            raise WrongAim(
                key,
                f"fault {kind.name} changes no frame at this target",
                expected=_codes(possible),
                got=_codes(functions),
            )
        possible = functions & possible if functions and possible else functions or possible


def check_can_effect(spec: FaultSpec, node: int | None, index: int | None = None) -> None:
    """Raise `WrongAim` for a fault that changes no CAN frame at which it aims.

    `node` is the node ID, None if the fault aims at all nodes. `index` is the object of the tag at which it aims by name.
    """
    if not issubclass(spec.kind, CanFault):
        return
    aim, fault, nodes = spec.aim, spec.make(), range(1, 128) if node is None else (node,)
    assert isinstance(fault, CanFault)
    if only_sends(spec.kind):
        for key in _OF_CHANGED_FRAMES:
            if key in aim.model_fields_set:
                raise WrongAim(
                    key, f"fault {spec.kind.name} only sends additional frames, but {key} selects frames to change"
                )
    if aim.cob_id is not None and not _aims(fault, (_payloads(aim.cob_id)), nodes):
        raise WrongAim("cob_id", f"fault {spec.kind.name} changes no frame with the COB-ID {aim.cob_id:03X}h")
    at = aim.index if index is None else index
    if at is not None:
        ways: Iterable[FrameDirection] = fault.ways if not aim.direction else FrameDirection
        if aim.direction in ("request", "reply"):
            ways = (FrameDirection(aim.direction),)
        if not any(_aims(fault, _naming(at, n, way), (n,)) for n in nodes for way in ways):
            raise WrongAim(
                "index" if index is None else "register",
                f"fault {spec.kind.name} changes no frame that names an object",
                hint="leave it out, or aim with cob_id",
            )


def _aims(fault: CanFault, frames: Iterable[CanFrame], nodes: Iterable[int]) -> bool:
    frames = tuple(frames)
    return any(fault.aims_at(frame, node) for node in nodes for frame in frames)


def _payloads(cob_id: int) -> list[CanFrame]:
    """Return one frame of each kind that a fault may change: a heartbeat, and each SDO command."""
    return [CanFrame(cob_id, b"\5"), *(CanFrame(cob_id, bytes((command << 5,)) + bytes(7)) for command in range(8))]


def _naming(index: int, node: int, way: FrameDirection) -> list[CanFrame]:
    base = SDO_REPLY if way is FrameDirection.REPLY else SDO_REQUEST
    rest = index.to_bytes(2, "little") + bytes(5)
    return [CanFrame(base + node, bytes((command << 5,)) + rest) for command in _INITIATES[way]]


def _words(framings: Iterable[Framing]) -> str:
    return " or ".join(WORDS[framing] for framing in Framing if framing in framings)


def _codes(functions: Iterable[int]) -> str:
    return "function " + ", ".join(f"{code:02X}h" for code in sorted(functions))
