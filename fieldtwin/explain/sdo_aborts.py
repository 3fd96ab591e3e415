"""The abort codes of SDO transfers (CiA 301 V4.2.0, 7.2.4.3.17, table 22)."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import MEANINGS

_TEXTS: dict[int, tuple[str, str]] = {
    0x0503_0000: (
        "Each segment of a transfer carries a toggle bit that changes from segment to segment. It did not change, so a "
        "segment was lost or arrived twice.",
        "Repeat the transfer. If it recurs, look for frame loss: bus load, termination, a full transmit queue of an adapter.",
    ),
    0x0504_0000: (
        "One side waited too long for the next frame of the transfer, and gave up.",
        "Repeat the transfer. If it recurs, the other side is too slow or frames are lost; increase `timeout_ms` of the bus or "
        "of the device.",
    ),
    0x0504_0001: (
        "The server does not know the command specifier in the first byte. Older nodes answer like this to a block transfer.",
        "Compare the frame with the standard: `fieldtwin record` captures it. A master should then use a segmented transfer.",
    ),
    0x0504_0002: (
        "In a block transfer, the number of segments per block was 0 or more than 127.",
        "A defect of the program that sent it; capture the transfer with `fieldtwin record` and report it.",
    ),
    0x0504_0003: (
        "In a block transfer, a segment's sequence number was not the next one, and the block was not repeated.",
        "Frames were lost. Reduce the bus load; look for a full transmit queue of an adapter.",
    ),
    0x0504_0004: (
        "The checksum at the end of a block transfer does not fit the data that arrived.",
        "Repeat the transfer. If it recurs, one side computes the checksum wrongly.",
    ),
    0x0504_0005: (
        "The node has too little memory for the transfer.",
        "Transfer less at once, or restart the node.",
    ),
    0x0601_0000: (
        "The object does not support this kind of access in the node's present state.",
        "Compare the access with the EDS. Some objects can be written in PRE-OPERATIONAL only.",
    ),
    0x0601_0001: (
        "The object can only be written.",
        "Do not read it: set the tag's access in the profile as in the EDS (`wo`).",
    ),
    0x0601_0002: (
        "The object can only be read.",
        "Do not write it: set the tag's access in the profile as in the EDS (`ro`).",
    ),
    0x0602_0000: (
        "The node has no object with this index. The EDS is of another device or another firmware version.",
        "Compare vendor, product and revision with the EDS: `fieldtwin identify`. Get the EDS of this version.",
    ),
    0x0604_0041: (
        "This object cannot be mapped into a PDO.",
        "Check PDOMapping of the object in the EDS.",
    ),
    0x0604_0042: (
        "The mapped objects together are longer than the 8 bytes of a PDO, or more than the node allows.",
        "Map fewer objects, or spread them over several PDOs.",
    ),
    0x0604_0043: (
        "The parameter does not fit the others, for instance a PDO mapping that was changed while the PDO was enabled.",
        "Disable the PDO (bit 31 of its COB-ID) and set the number of mapped objects to 0 before changing the mapping.",
    ),
    0x0604_0047: (
        "The node has an internal contradiction, for instance between two parameters that were loaded.",
        "Restore the node's defaults (1011h), and set the parameters again one at a time.",
    ),
    0x0606_0000: (
        "The node's hardware failed during the access.",
        "Read the error register (1001h) and the error list (1003h) of the node.",
    ),
    0x0607_0010: (
        "The length of the data is not that of the object.",
        "Check the data type in the profile and in the EDS.",
    ),
    0x0607_0012: (
        "The data is longer than the object.",
        "Check the data type in the profile and in the EDS.",
    ),
    0x0607_0013: (
        "The data is shorter than the object.",
        "Check the data type in the profile and in the EDS.",
    ),
    0x0609_0011: (
        "The object exists, but not this sub-index.",
        "Read sub-index 0 of the object: for arrays and records it is the highest sub-index.",
    ),
    0x0609_0030: (
        "The node does not accept this value, on writes only.",
        "Check the permitted values in the node's manual; `range` in the profile keeps others from being sent.",
    ),
    0x0609_0031: ("The value is above the node's limit.", "Set `range` in the profile to the limits of the manual."),
    0x0609_0032: ("The value is below the node's limit.", "Set `range` in the profile to the limits of the manual."),
    0x0609_0036: (
        "Two limits contradict each other: the maximum would be below the minimum.",
        "Write the limits in the other order.",
    ),
    0x060A_0023: (
        "The node serves one SDO transfer at a time on this channel, and it is in use.",
        "Stop the other master or tool that uses the node's SDO server.",
    ),
    0x0800_0000: (
        "The node gives no closer reason.",
        "Read the error register (1001h) of the node, and compare the request with the manual.",
    ),
    0x0800_0020: (
        "The node's application does not take or store the value. For 1010h and 1011h: the signature `save` or `load` is "
        "missing.",
        "Compare the request with the manual.",
    ),
    0x0800_0021: (
        "The node is under local control, at its own panel for instance.",
        "Switch the node to remote control.",
    ),
    0x0800_0022: (
        "The node's state does not permit the access, for instance a write in OPERATIONAL.",
        "Bring the node into PRE-OPERATIONAL first, if the manual says so.",
    ),
    0x0800_0023: (
        "The node has no object dictionary, or could not generate it from its file.",
        "Load the configuration into the node again.",
    ),
    0x0800_0024: ("The object has no data at present.", "Read it again later."),
}

ABORTS: tuple[Explanation, ...] = tuple(
    Explanation(
        f"abort {code:08X}",
        "SDO abort code",
        MEANINGS[code],
        meaning,
        todo,
        "CiA 301 V4.2.0, 7.2.4.3.17, table 22",
        (f"{code:08X}", f"{code:08X}h", f"0x{code:08X}", f"0x{code:X}", f"abort {code:08X}h", f"abort 0x{code:08X}"),
    )
    for code, (meaning, todo) in _TEXTS.items()
)
