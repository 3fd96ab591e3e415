"""The qualities of a tag's value, and the reasons why a value is not good (`fieldtwin.gateway.core.values`)."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation
from fieldtwin.gateway.core.values import Quality, Reason

_SOURCE = "docs/reference/system-file.md"
_REASONS: dict[Reason, tuple[str, str]] = {
    Reason.NEVER_READ: (
        "The gateway has not read the tag since it started, or a sampling device has no sample yet.",
        "Wait for the first poll. If it stays, look for the device's error in the live view or in `fieldtwin trace "
        "--problems`; a tag that is only written needs an entry that reads it back.",
    ),
    Reason.TIMEOUT: (
        "The device did not answer within the timeout, retries included, or a gateway reported that it does not answer.",
        "Check power, wiring, unit ID or node ID, baud rate and parity. `fieldtwin scan` finds devices that answer "
        "elsewhere. A slow device needs a longer `timeout_ms`.",
    ),
    Reason.WIRE_ERROR: (
        "Replies arrive damaged, or do not fit the request: wrong checksum, unit ID, function or length.",
        "On a serial line check termination, A and B, ground and baud rate, and whether a second master is on the line "
        "(`fieldtwin line`). `fieldtwin trace --problems` shows the frames.",
    ),
    Reason.REFUSED: (
        "The device answered with a Modbus exception, or aborted the SDO transfer.",
        "The message has the code: `fieldtwin explain exception 02`, `fieldtwin explain abort 06020000`.",
    ),
    Reason.UNREACHABLE: (
        "The endpoint cannot be opened, or the connection was lost: no such host or port, refused, cable pulled, bus-off.",
        "The device's error in the live view contains the message of the operating system. The gateway tries again by itself.",
    ),
    Reason.STALE: (
        "The last good value is older than the tag's maximum age, so it may no longer be true.",
        "The device is polled too seldom (`every_ms` under `poll`), answers too slowly, or the bus is full: see the exchanges "
        "per second in the live view. `stale_after_ms` of the device sets the maximum age.",
    ),
    Reason.NOT_SAMPLING: (
        "The device answers, but its sample counter does not advance: it repeats an old measurement.",
        "Check whether the device measures: its sample period may be 0, or its sensor may have stopped.",
    ),
    Reason.NOT_A_NUMBER: (
        "The bytes are not a number: a float NaN or infinity, or a digit above 9 in BCD.",
        "Compare type and byte order of the tag with the manual. Some devices report a broken sensor this way.",
    ),
    Reason.OUT_OF_RANGE: (
        "The value is outside of the tag's `range` in the profile. It is published as uncertain.",
        "Compare `range`, `scale` and byte order with the manual; otherwise the measurement itself is wrong.",
    ),
    Reason.NOT_OPERATIONAL: (
        "The CANopen node is not in OPERATIONAL, so it sends no PDOs, or the PLC's program that makes the value has stopped.",
        "See why the node left OPERATIONAL: EMCY messages and boot-ups in the trace. A read-only plant starts no node: "
        "the plant's own NMT master must. `fieldtwin plc status` shows a stopped program.",
    ),
    Reason.HEARTBEAT_LOST: (
        "The CANopen node sent no heartbeat within the consumer time.",
        "Check the node's power and the bus. The consumer time should be at least twice the node's producer time (1017h).",
    ),
    Reason.WRONG_DEVICE: (
        "Another device answers than the one that the system file expects, by its identification. Nothing is written to it.",
        "Compare `fieldtwin identify` with the profile: a device was exchanged, or two have swapped addresses.",
    ),
    Reason.GATEWAY_DEAD: (
        "The gateway has not updated the process image for 1 s, so the PLC's inputs are bad.",
        "The gateway's process has ended or hangs. Its log in the run directory says why.",
    ),
    Reason.SENTINEL: (
        "The device sent one of the values that mean `no measurement`, as listed under `sentinels` of the tag.",
        "The sensor is missing or broken, or measures nothing yet.",
    ),
    Reason.NOT_EXACT: (
        "The stored value differs from the one that the device sent: a text or payload was cut off at 4096 bytes, a text has "
        "a character that databases refuse, or an integer has more than 63 bits. It is stored as uncertain.",
        "Read the tag from the gateway or the trace, which have the whole value. Map a shorter text if the twin needs it.",
    ),
}
_QUALITIES: dict[Quality, tuple[str, str]] = {
    Quality.GOOD: ("The value was read within its maximum age and passed all checks.", "Nothing."),
    Quality.SUBSTITUTED: (
        "The value was bad, and the program's input has the substitute that its `if_bad` states.",
        "The reason next to it explains the cause: `fieldtwin explain timeout`.",
    ),
    Quality.UNCERTAIN: (
        "The device has a value, but it is doubtful: it is out of its range, or the device repeats an old sample.",
        "The reason next to it explains the doubt: `fieldtwin explain out of range`.",
    ),
    Quality.SIMULATED: (
        "A person forces the value, or a simulation substitutes it.",
        "`fieldtwin plc status` lists forces; `fieldtwin plc unforce TAG` removes one.",
    ),
    Quality.BAD: (
        "No value may be used. A program's `if_bad` states the value that the program gets instead.",
        "The reason next to it explains the cause: `fieldtwin explain timeout`.",
    ),
}


def _spellings(reason: Reason) -> tuple[str, ...]:
    """Return the spellings of a reason other than its ID."""
    id = reason.name.lower()
    return tuple(dict.fromkeys(word for word in (str(reason), id.replace("_", "-")) if word != id))


QUALITIES: tuple[Explanation, ...] = (
    *(Explanation(str(q), "quality", str(q), *_QUALITIES[q], _SOURCE) for q in Quality if q in _QUALITIES),
    *(
        Explanation(r.name.lower(), "quality reason", str(r), *_REASONS[r], _SOURCE, _spellings(r))
        for r in Reason
        if r is not Reason.NONE
    ),
)
