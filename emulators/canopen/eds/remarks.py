"""Remarks about a data sheet for the user, before its node is started: settings that do not fit the node, and a missing
model.

A DCF is often copied from a different node of the plant, so its ParameterValues are that node's COB-IDs. The emulated node uses
them unchanged, and `remarks` reports them. The module does no I/O. The texts name no command, because the caller knows how to
override the settings.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary
from fieldtwin.emulators.canopen.eds.entries import SubindexEntry

_SHORTEST_CYCLE_US = 50
"""A SYNC without data takes 47 bits: 47 us at 1 Mbit/s, the highest bit rate (CiA 301, 5.3)."""
_INVALID = 1 << 31
_NAMED = 6
"""The largest number of objects that one remark names."""


@dataclass(frozen=True, slots=True)
class Remark:
    """One remark. `by_parameter_value` says that a ParameterValue causes it; `model` says that it is about the missing model."""

    text: str
    by_parameter_value: bool = False
    model: bool = False


def remarks(dictionary: Dictionary, node_id: int, *, has_model: bool) -> list[Remark]:
    """Return remarks on settings that do not fit a node with this ID, and on a missing model (if `has_model` is False)."""
    found = [*_of_another_node(dictionary, node_id), *_of_the_cycle(dictionary)]
    if not has_model:
        found.append(_without_model(dictionary))
    return found


def _of_another_node(dictionary: Dictionary, node_id: int) -> list[Remark]:
    """Return remarks for literal COB-IDs that the predefined connection set (CiA 301, 7.3.3) assigns to a different node."""
    if not 1 <= node_id <= 127:
        return []
    by_node: dict[tuple[int, bool], list[SubindexEntry]] = {}
    for entry in dictionary.entries():
        other = _owner(entry)
        if other and other != node_id:
            by_node.setdefault((other, entry.configured), []).append(entry)
    found = []
    for (other, configured), entries in sorted(by_node.items()):
        kind = "ParameterValues" if configured else "DefaultValues"
        found.append(
            Remark(
                f"these {kind} are COB-IDs of node {other}, and this is node {node_id}: {_listed(entries)}", configured
            )
        )
    said = {other for other, configured in by_node if configured}
    configured_count = sum(entry.configured for entry in dictionary.entries())
    if configured_count and dictionary.node_id and dictionary.node_id not in (node_id, *said):
        text = f"the file commissions node {dictionary.node_id}, and this is node {node_id}"
        found.append(Remark(f"{text}: its {configured_count} ParameterValues are applied as they stand", True))
    return found


def _owner(entry: SubindexEntry) -> int:
    """Return the node that owns a COB-ID in the predefined connection set.

    Returns 0 for a COB-ID that is relative to the node ID, and for all other objects.
    """
    base = _base(entry)
    if base == 0 or entry.node_relative or entry.size != 4:
        return 0
    cob_id = int(codec.decode(entry.data_type, entry.default))
    if cob_id & _INVALID or cob_id & 0x780 != base:
        return 0
    return cob_id & 0x7F


def _base(entry: SubindexEntry) -> int:
    """Return the function code that the predefined connection set has for this COB-ID; 0 for all other objects."""
    index, sub = entry.key
    if (index, sub) == (0x1014, 0):
        return 0x080
    if index == 0x1200 and sub in (1, 2):
        return 0x600 if sub == 1 else 0x580
    if sub == 1 and 0x1400 <= index <= 0x1403:
        return 0x200 + 0x100 * (index - 0x1400)
    if sub == 1 and 0x1800 <= index <= 0x1803:
        return 0x180 + 0x100 * (index - 0x1800)
    return 0


def _listed(entries: list[SubindexEntry]) -> str:
    named = [
        f"{e.index:04X}h:{e.subindex:02X} = {int(codec.decode(e.data_type, e.default)):X}h" for e in entries[:_NAMED]
    ]
    more = len(entries) - len(named)
    return ", ".join(named) + (f" and {more} more" if more else "")


def _of_the_cycle(dictionary: Dictionary) -> list[Remark]:
    entry = dictionary.entry(0x1006, 0)
    cycle_us = int(codec.decode(entry.data_type, entry.default)) if entry is not None and entry.size == 4 else 0
    if entry is None or not 0 < cycle_us < _SHORTEST_CYCLE_US:
        return []
    text = f"1006h (communication cycle period) is {cycle_us} us, and no bus carries a SYNC that often: after each one"
    return [
        Remark(
            f"{text} the node sends EMCY 8100h, which is a drive's fault; 0 switches the supervision off",
            entry.configured,
        )
    ]


def _without_model(dictionary: Dictionary) -> Remark:
    entry = dictionary.entry(0x1000, 0)
    number = 0
    if entry is not None and codec.is_integer(entry.data_type):
        number = int(codec.decode(entry.data_type, entry.default)) & 0xFFFF
    why = (
        f"1000h (device type) names the device profile {number}, which has no model"
        if number
        else "1000h (device type) has no value"
    )
    text = f"{why}: the objects hold what the file says and what clients write"
    if dictionary.entry(0x6040, 0) is not None and dictionary.entry(0x6041, 0) is not None:
        text += "; 6040h and 6041h are those of a CiA 402 drive, but no state machine implements them"
    return Remark(text, model=True)
