"""The OPC UA status code of each quality and reason of a tag (OPC 10000-4, 7.39, and OPC 10000-8, 6.3).

The class is always that of the quality: a value that is bad in the process image is Bad for a client, and one that is uncertain,
substituted or simulated is Uncertain. Each reason for a bad value has a code, so that a client can distinguish a silent device
from a broken sensor. The table is printed in docs/reference/opcua.md. This module does not need the OPC UA library.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from fieldtwin.gateway.core.values import Quality, Reason


class StatusCode(NamedTuple):
    """A status code: its name in the standard, and its number."""

    name: str
    number: int


GOOD = StatusCode("Good", 0x0000_0000)
UNCERTAIN = StatusCode("Uncertain", 0x4000_0000)
BAD = StatusCode("Bad", 0x8000_0000)
SUBSTITUTED = StatusCode("UncertainSubstituteValue", 0x4091_0000)
SIMULATED = StatusCode("UncertainSimulatedValue", 0x4209_0000)

UNCERTAIN_CODES: dict[Reason, StatusCode] = {
    Reason.NOT_SAMPLING: StatusCode("UncertainLastUsableValue", 0x4090_0000),
    Reason.OUT_OF_RANGE: StatusCode("UncertainEngineeringUnitsExceeded", 0x4094_0000),
    Reason.NOT_EXACT: StatusCode("UncertainSensorNotAccurate", 0x4093_0000),
}
"""The codes of uncertain values. Any other reason is `UNCERTAIN`."""

BAD_CODES: dict[Reason, StatusCode] = {
    Reason.NEVER_READ: StatusCode("BadWaitingForInitialData", 0x8032_0000),
    Reason.TIMEOUT: StatusCode("BadNoCommunication", 0x8031_0000),
    Reason.WIRE_ERROR: StatusCode("BadCommunicationError", 0x8005_0000),
    Reason.REFUSED: StatusCode("BadDeviceFailure", 0x808B_0000),
    Reason.UNREACHABLE: StatusCode("BadNotConnected", 0x808A_0000),
    Reason.STALE: StatusCode("BadNoDataAvailable", 0x80B1_0000),
    Reason.NOT_SAMPLING: StatusCode("BadSensorFailure", 0x808C_0000),
    Reason.NOT_A_NUMBER: StatusCode("BadSensorFailure", 0x808C_0000),
    Reason.OUT_OF_RANGE: StatusCode("BadOutOfRange", 0x803C_0000),
    Reason.NOT_OPERATIONAL: StatusCode("BadOutOfService", 0x808D_0000),
    Reason.HEARTBEAT_LOST: StatusCode("BadNoCommunication", 0x8031_0000),
    Reason.WRONG_DEVICE: StatusCode("BadConfigurationError", 0x8089_0000),
    Reason.GATEWAY_DEAD: StatusCode("BadShutdown", 0x800C_0000),
    Reason.SENTINEL: StatusCode("BadSensorFailure", 0x808C_0000),
    Reason.NOT_EXACT: StatusCode("BadDecodingError", 0x8007_0000),
}
"""The codes of bad values."""


def status_code(quality: Quality, reason: Reason) -> StatusCode:
    """Return the status code of a value with this quality and reason."""
    if quality is Quality.GOOD:
        return GOOD
    if quality is Quality.BAD:
        return BAD_CODES.get(reason, BAD)
    if quality is Quality.SUBSTITUTED:
        return SUBSTITUTED
    return SIMULATED if quality is Quality.SIMULATED else UNCERTAIN_CODES.get(reason, UNCERTAIN)


def table() -> Iterator[tuple[str, str, StatusCode]]:
    """Return the rows of the table in the reference: quality, reason and status code."""
    yield str(Quality.GOOD), "", GOOD
    yield str(Quality.SUBSTITUTED), "any", SUBSTITUTED
    yield str(Quality.SIMULATED), "any", SIMULATED
    for reason, code in UNCERTAIN_CODES.items():
        yield str(Quality.UNCERTAIN), str(reason), code
    yield str(Quality.UNCERTAIN), "any other", UNCERTAIN
    for reason, code in BAD_CODES.items():
        yield str(Quality.BAD), str(reason), code
