"""Configure a node over SDO when it starts, as CiA 301 prescribes, and read the configuration back.

The procedures use a master. They use objects of CiA 301 only, and are independent of particular devices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from fieldtwin.gateway.core.errors import Desync, FileInvalid, SdoAborted, UsageError, VerifyFailed
from fieldtwin.gateway.protocols.canopen import cob_id as cob_ids
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType, decode, encode, size_of
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.pdo.mapping import MAX_ENTRIES, PdoMapping

DEVICE_TYPE = 0x1000
HEARTBEAT_PRODUCER = 0x1017
IDENTITY = 0x1018
TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00
TPDO_MAX = 512
RPDO_COMMUNICATION = 0x1400
RPDO_MAPPING = 0x1600

PDO_INVALID = 1 << 31
"""Bit 31 of a PDO's COB-ID: the PDO does not exist (7.5.2.37)."""
NO_RTR = 1 << 30
"""Bit 30 of a TPDO's COB-ID: the TPDO may not be requested by remote frames."""
SYNCHRONOUS_MAX = 240
"""The highest transmission type of a synchronous PDO (7.5.2.35, 7.5.2.37)."""


class Records(NamedTuple):
    """A PDO's name and the indices of its communication and mapping record."""

    name: str
    communication: int
    mapping: int


PARAMETERS = {2: DataType.UNSIGNED8, 3: DataType.UNSIGNED16, 5: DataType.UNSIGNED16}
"""Sub-indices of a communication record: transmission type, inhibit time (100 us), event timer (ms)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """The identity that a node reports (1000h, 1018h): vendor, product, revision, serial; None for an entry that it
    does not have.
    """

    device_type: int
    vendor: int | None
    product: int | None
    revision: int | None
    serial: int | None


@dataclass(frozen=True, slots=True)
class PdoConfig:
    """The configuration of a PDO in the node.

    `cob_id` is the CAN-ID without flag bits. `event_ms` is a TPDO's event timer or an RPDO's deadline in milliseconds: 0 if it is
    off, None if the node does not support it.
    """

    number: int
    cob_id: int
    enabled: bool
    transmission_type: int
    event_ms: int | None
    mapping: PdoMapping

    @property
    def synchronous(self) -> bool:
        """Return whether the PDO is synchronous (types 0 to 240); an RPDO's values then take effect at the next SYNC."""
        return self.transmission_type <= SYNCHRONOUS_MAX

    @property
    def cyclic(self) -> bool:
        """Return whether a TPDO is also sent when nothing has changed: at each nth SYNC, or by its event timer."""
        return 1 <= self.transmission_type <= SYNCHRONOUS_MAX or bool(not self.synchronous and self.event_ms)


async def read_number(master: CanopenMaster, node: int, index: int, subindex: int, data_type: DataType) -> int:
    """Read an integer object. Raises the errors of `sdo_upload`, and `LengthMismatch` if it has a different size."""
    data = await master.sdo_upload(node, index, subindex, length=size_of(data_type))
    return int(decode(data_type, data))


async def write_number(
    master: CanopenMaster, node: int, index: int, subindex: int, data_type: DataType, value: int
) -> None:
    """Write an integer object. Raises the errors of `sdo_download`, and `UsageError` if `value` does not fit."""
    await master.sdo_download(node, index, subindex, encode(data_type, value))


async def verify_number(
    master: CanopenMaster, node: int, index: int, subindex: int, data_type: DataType, value: int
) -> None:
    """Read an integer object back. Raises `VerifyFailed` if the node holds a different value."""
    held = await read_number(master, node, index, subindex, data_type)
    if held != value:
        where = f"node {node} {index:04X}h:{subindex:02X}"
        raise VerifyFailed(
            "the node accepted the value, but holds a different one", expected=f"{value:X}h", got=f"{held:X}h"
        ).at(where)


async def set_heartbeat_producer(master: CanopenMaster, node: int, ms: int) -> None:
    """Set the producer heartbeat time (1017h, 7.5.2.18) in milliseconds, 0 to switch it off, and verify it."""
    await write_number(master, node, HEARTBEAT_PRODUCER, 0, DataType.UNSIGNED16, ms)
    await verify_number(master, node, HEARTBEAT_PRODUCER, 0, DataType.UNSIGNED16, ms)


async def read_identity(master: CanopenMaster, node: int) -> Identity:
    """Read device type and identity. An entry beyond the node's highest sub-index is None."""
    u32 = DataType.UNSIGNED32
    device_type = await read_number(master, node, DEVICE_TYPE, 0, u32)
    highest = await read_number(master, node, IDENTITY, 0, DataType.UNSIGNED8)
    parts = [await read_number(master, node, IDENTITY, sub, u32) if sub <= highest else None for sub in range(1, 5)]
    return Identity(device_type, *parts)


async def read_tpdo(master: CanopenMaster, node: int, number: int) -> PdoConfig:
    """Read TPDO `number` (from 1) with its mapping, for a driver that uses the node's existing configuration."""
    return await _read_pdo(master, node, number, _tpdo(number))


async def read_tpdos(master: CanopenMaster, node: int, up_to: int = TPDO_MAX) -> tuple[PdoConfig, ...]:
    """Read TPDO 1, 2 and so on with their mappings, up to the first one that the node does not have."""
    return await _read_pdos(master, node, up_to, _tpdo)


async def read_rpdos(master: CanopenMaster, node: int, up_to: int = TPDO_MAX) -> tuple[PdoConfig, ...]:
    """Read RPDO 1, 2 and so on with their mappings, up to the first one that the node does not have."""
    return await _read_pdos(master, node, up_to, _rpdo)


async def _read_pdos(
    master: CanopenMaster, node: int, up_to: int, records: Callable[[int], Records]
) -> tuple[PdoConfig, ...]:
    found: list[PdoConfig] = []
    while len(found) < up_to:
        number = len(found) + 1
        try:
            found.append(await _read_pdo(master, node, number, records(number)))
        except SdoAborted:
            break
    return tuple(found)


async def _read_pdo(master: CanopenMaster, node: int, number: int, records: Records) -> PdoConfig:
    communication = records.communication
    word = await read_number(master, node, communication, 1, DataType.UNSIGNED32)
    highest = await read_number(master, node, communication, 0, DataType.UNSIGNED8)
    kind = await read_number(master, node, communication, 2, DataType.UNSIGNED8)
    event = await read_number(master, node, communication, 5, DataType.UNSIGNED16) if highest >= 5 else None
    return PdoConfig(
        number, word & 0x7FF, not word & PDO_INVALID, kind, event, await _read_mapping(master, node, records.mapping)
    )


def tpdos_of(dictionary: ObjectDictionary) -> tuple[PdoConfig, ...]:
    """Return the TPDOs of an EDS or DCF. Raises `FileInvalid` for an invalid mapping."""
    return _pdos_of(dictionary, _tpdo)


def rpdos_of(dictionary: ObjectDictionary) -> tuple[PdoConfig, ...]:
    """Return the RPDOs of an EDS or DCF. Raises `FileInvalid` for an invalid mapping."""
    return _pdos_of(dictionary, _rpdo)


def _pdos_of(dictionary: ObjectDictionary, records: Callable[[int], Records]) -> tuple[PdoConfig, ...]:
    found = []
    for number in range(1, TPDO_MAX + 1):
        name, communication, mapping = records(number)
        word = _number_in(dictionary, communication, 1)
        if word is None:
            continue
        count = _number_in(dictionary, mapping, 0) or 0
        words = [_number_in(dictionary, mapping, sub) or 0 for sub in range(1, min(count, MAX_ENTRIES) + 1)]
        try:
            mapped = PdoMapping.from_words(words)
        except Desync as e:
            where = f"[{mapping:04X}]: the mapping of {name}"
            raise FileInvalid(where, path=dictionary.path, expected=e.expected, got=e.got) from e
        kind = _number_in(dictionary, communication, 2)
        event = _number_in(dictionary, communication, 5)
        enabled = not word & PDO_INVALID
        found.append(PdoConfig(number, word & 0x7FF, enabled, 255 if kind is None else kind, event, mapped))
    return tuple(found)


def _number_in(dictionary: ObjectDictionary, index: int, subindex: int) -> int | None:
    entry = dictionary.get(index, subindex)
    return entry.default if entry is not None and isinstance(entry.default, int) else None


async def configure_tpdo(
    master: CanopenMaster,
    node: int,
    number: int,
    mapping: Iterable[tuple[int, int, int]],
    cob_id: int,
    transmission_type: int = 254,
    event_ms: int | None = None,
    inhibit_100us: int | None = None,
) -> PdoMapping:
    """Configure TPDO `number` (from 1) by the procedure of 7.5.2.38, verify it, and return its mapping.

    `mapping` is (index, subindex, bits) in order, at most 64 bits. `cob_id` is the CAN-ID; the node's setting for remote frames
    is not changed. `event_ms` 0 switches the event timer off; None does not write event timer and inhibit time, which a node need
    not have. Call it in PRE-OPERATIONAL. Raises `UsageError` before anything is sent, `SdoAborted` if the node refuses a step
    (the TPDO then stays disabled), `VerifyFailed` if the node finally holds different values.
    """
    parameters = ((2, transmission_type), (3, inhibit_100us), (5, event_ms))
    return await _configure_pdo(master, node, _tpdo(number), mapping, cob_id, parameters)


async def configure_rpdo(
    master: CanopenMaster,
    node: int,
    number: int,
    mapping: Iterable[tuple[int, int, int]],
    cob_id: int,
    transmission_type: int = 255,
) -> PdoMapping:
    """Configure RPDO `number` (from 1) by the procedure of 7.5.2.36, verify it, and return its mapping.

    Parameters and errors are those of `configure_tpdo`. With `transmission_type` 0 to 240 the node applies the values at the next
    SYNC.
    """
    return await _configure_pdo(master, node, _rpdo(number), mapping, cob_id, ((2, transmission_type),))


async def _configure_pdo(
    master: CanopenMaster,
    node: int,
    records: Records,
    mapping: Iterable[tuple[int, int, int]],
    cob_id: int,
    optional: Iterable[tuple[int, int | None]],
) -> PdoMapping:
    """Configure a PDO. `optional` maps sub-indices of the communication record to values; a value of None is not written."""
    name, communication, mapped = records
    wanted = PdoMapping.of(mapping)
    cob_ids.check_pdo_cob_id(cob_id)
    if not wanted.entries:
        raise UsageError(f"{name} of node {node} maps nothing", expected="at least one object")
    u8, u32 = DataType.UNSIGNED8, DataType.UNSIGNED32
    parameters = [(sub, PARAMETERS[sub], value) for sub, value in optional if value is not None]
    for _, data_type, value in parameters:
        encode(data_type, value)  # a value that does not fit is refused before anything is sent

    # Bits 0 to 29 must not change while the PDO exists: first write the old CAN-ID with bit 31, at the end the new one.
    held = await read_number(master, node, communication, 1, u32)
    final = cob_id | held & NO_RTR
    await write_number(master, node, communication, 1, u32, held | PDO_INVALID)
    await write_number(master, node, mapped, 0, u8, 0)
    for sub, entry in enumerate(wanted.entries, 1):
        await write_number(master, node, mapped, sub, u32, entry.word)
    await write_number(master, node, mapped, 0, u8, len(wanted.entries))
    for sub, data_type, value in parameters:
        await write_number(master, node, communication, sub, data_type, value)
    await write_number(master, node, communication, 1, u32, final)

    await verify_number(master, node, communication, 1, u32, final)
    for sub, data_type, value in parameters:
        await verify_number(master, node, communication, sub, data_type, value)
    found = await _read_mapping(master, node, mapped)
    if found != wanted:
        raise VerifyFailed(f"the mapping of {name}", expected=str(wanted), got=str(found)).at(f"node {node}")
    return wanted


async def _read_mapping(master: CanopenMaster, node: int, index: int) -> PdoMapping:
    count = await read_number(master, node, index, 0, DataType.UNSIGNED8)
    if count > MAX_ENTRIES:  # 254 and 255 mean a multiplexed PDO, which has no mapping to read
        raise VerifyFailed("not the mapping of a plain PDO", expected="at most 64 objects", got=str(count)).at(
            f"node {node} {index:04X}h"
        )
    return PdoMapping.from_words(
        [await read_number(master, node, index, sub, DataType.UNSIGNED32) for sub in range(1, count + 1)]
    )


def _tpdo(number: int) -> Records:
    return _records(f"TPDO {number}", number, TPDO_COMMUNICATION, TPDO_MAPPING)


def _rpdo(number: int) -> Records:
    return _records(f"RPDO {number}", number, RPDO_COMMUNICATION, RPDO_MAPPING)


def _records(name: str, number: int, communication: int, mapping: int) -> Records:
    if not 1 <= number <= TPDO_MAX:
        raise UsageError(f"no such {name[:4]}", expected=f"1 to {TPDO_MAX}", got=str(number))
    return Records(name, communication + number - 1, mapping + number - 1)
