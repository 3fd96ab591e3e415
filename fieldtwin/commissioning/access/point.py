"""One device on a live connection for the commissioning commands: read tags, write a tag, and return the frames for a dry
run.

This module must never decide what may be written (`writing` does), and must not depend on files or displays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from fieldtwin.commissioning.access.address import AUTO
from fieldtwin.commissioning.access.connection import frame_of
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    CrcError,
    Desync,
    DeviceRefused,
    ModbusExceptionReply,
    NotAllowed,
    ReplyTimeout,
    SdoAborted,
)
from fieldtwin.gateway.core.files.profile import DeviceProfile, RegisterRange, Tag
from fieldtwin.gateway.core.files.profile_schema import Limits, ProfileForm
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue
from fieldtwin.gateway.devices.codec import apply_scale, decode, decode_little, encode, reorder
from fieldtwin.gateway.devices.read_plan import (
    ILLEGAL_ADDRESS,
    TOO_LONG,
    GroupPlan,
    Learnt,
    Read,
    cells,
    plan_reads,
    read_request,
)
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.sdo.transfers import SdoDownload, SdoUpload
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.protocols.modbus.requests.data import (
    WriteCoil,
    WriteCoils,
    WriteRegister,
    WriteRegisters,
)
from fieldtwin.gateway.protocols.modbus.requests.request import Request

WIRE_TROUBLE = (ReplyTimeout, CrcError, Desync)
OBJECT_BYTES = {"bool": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4}
"""Number of bytes of a CANopen object by type; 8 for the numeric types that are not listed."""


MOST_SILENT = 3
"""Number of consecutive requests without a reply after which no further request is sent to the unit during the same reading."""


@dataclass(frozen=True, slots=True)
class PointValue:
    """A tag's value, or a bad value whose `problem` is the error of the device or the connection."""

    value: TagValue
    problem: str = ""


class Point(Protocol):
    """A device that can be queried. Methods return each frame as sent on the bus, in one line: hex digits, or candump's
    notation.
    """

    protocol: str
    where: str
    requests: int
    """Number of requests or SDO transfers sent to the device."""

    async def read(
        self, tags: Sequence[Tag], found: dict[str, PointValue] | None = None, *, alone: bool = False
    ) -> dict[str, PointValue]:
        """Return each tag's value by name, read in as few requests as possible.

        A refused or lost read gives a bad value with its problem; only errors that end the connection are raised. In that case
        `found` holds the values that were read before. With `alone` the tags of a request that failed are read again, one by one.
        """
        ...

    async def write(self, tag: Tag, data: bytes) -> None:
        """Write `data`, the result of `encoded`, in one request, once. Raises the errors of connection and device."""
        ...

    def read_frames(self, tags: Sequence[Tag]) -> list[str]:
        """Return the frames of the requests that `read` would send if all succeed; of an SDO transfer only its first frame."""
        ...

    def write_frames(self, tag: Tag, data: bytes) -> list[str]:
        """Return the frames that `write` would send."""
        ...


def encoded(tag: Tag, value: Scalar) -> bytes:
    """Return the bytes that represent an engineering value on the bus: registers, or the little-endian bytes of an object.

    Raises `NotAllowed` for a value that the tag cannot hold. A value of type bytes is returned unchanged.
    """
    if isinstance(value, bytes):
        return value
    if isinstance(value, str) and tag.type == "string":
        return _text(tag, value)
    data = encode(tag, value)
    if tag.at is not None:
        return data
    big = reorder(data, tag.order)
    return big[::-1][: OBJECT_BYTES.get(tag.type, 8)]


def _text(tag: Tag, value: str) -> bytes:
    """Return text as a device holds it: padded to whole registers with NULs, its bytes swapped where the order swaps bytes."""
    if not value.isascii():
        raise NotAllowed(f"{tag.name}: only ASCII can be written", got=repr(value))
    raw = value.encode("ascii")
    if tag.at is None:
        return raw
    if len(raw) > 2 * tag.at.count:
        raise NotAllowed(f"{tag.name}: the text is too long", expected=f"at most {2 * tag.at.count} characters")
    raw = raw.ljust(2 * tag.at.count, b"\0")
    return reorder(raw, "BADC") if tag.order in ("BADC", "DCBA") else raw


def decoded(tag: Tag, data: bytes, t_ns: int) -> TagValue:
    """Return the value in `data`.

    An object of unknown type is an unsigned number if its length is that of a number, else text or bytes.
    """
    if tag.at is not None:
        return decode(tag, data, t_ns)
    if tag.type == AUTO:
        text = len(data) > 4 and data.rstrip(b"\0").isascii() and data.rstrip(b"\0").decode("ascii").isprintable()
        kind = f"uint{8 * len(data)}" if len(data) in (1, 2, 4) else "string" if text else "bytes"
        tag = replace(tag, type=kind)
    size = OBJECT_BYTES.get(tag.type, None if tag.is_text else 8)
    # the bytes do not have the length of the stated type: they are shown, and not decoded as a different type
    if size is not None and len(data) != size:
        return TagValue(data, Quality.UNCERTAIN, Reason.NOT_A_NUMBER, t_ns, data)
    return decode_little(tag, data, t_ns)


class ModbusPoint:
    """The unit `unit` at the endpoint `url`, queried through `client`.

    `profile` gives its limits and gaps; limits that the device reveals are kept in `learnt`.
    """

    protocol = "modbus"

    def __init__(self, client: ModbusClient | None, url: str, unit: int, profile: DeviceProfile | None = None) -> None:
        self.where = f"{url} unit {unit}"
        self.unit = unit
        self.learnt = Learnt()
        self.requests = 0
        self._client = client
        self._url = url
        self._profile = profile
        self._plans: dict[tuple[str, ...], GroupPlan] = {}

    @property
    def is_broadcast(self) -> bool:
        """Return whether the unit ID addresses all units of the line."""
        return self.unit == 0 and framing_of(Endpoint.parse(self._url)) in ("rtu", "ascii")

    @property
    def client(self) -> ModbusClient:
        assert self._client is not None, "a dry run sends nothing"
        return self._client

    async def read(
        self, tags: Sequence[Tag], found: dict[str, PointValue] | None = None, *, alone: bool = False
    ) -> dict[str, PointValue]:
        """Read as `Point.read` describes. If a tag is scaled by a second tag, the second tag is read too.

        With `alone`, reading one by one ends when the unit has left `MOST_SILENT` consecutive requests without a reply: the
        remaining tags keep the result of the request in which they were read together.
        """
        found = {} if found is None else found
        plan = self._plan(self._with_scales(tags))
        answers: dict[str, PointValue] = {}
        todo, silent = list(plan.reads), 0
        try:
            while todo:
                read = todo.pop(0)
                if silent >= MOST_SILENT and all(t.name in answers for t in read.tags):
                    continue
                try:
                    raw, t_ns = await self._transaction(read.range)
                except ModbusExceptionReply as e:
                    silent = 0
                    parts = plan.refused(read, e.code) if e.code in (ILLEGAL_ADDRESS, TOO_LONG) else ()
                    if not parts:
                        answers |= _bad(read.tags, Reason.REFUSED, e)
                    todo[:0] = parts or (_singly(read) if alone else ())
                except WIRE_TROUBLE as e:
                    timeout = isinstance(e, ReplyTimeout)
                    silent = silent + 1 if timeout else 0
                    answers |= _bad(read.tags, Reason.TIMEOUT if timeout else Reason.WIRE_ERROR, e)
                    todo[:0] = _singly(read) if alone else ()
                else:
                    silent = 0
                    plan.taken(read)
                    answers |= {
                        t.name: PointValue(decode(t, part(read.range, t.registers, raw), t_ns)) for t in read.tags
                    }
            plan.pass_ended()
        finally:
            found |= {t.name: self._scaled(t, answers) for t in tags if t.name in answers}
        return found

    async def write(self, tag: Tag, data: bytes) -> None:
        """Write as `Point.write` describes, with the function that the profile's limits permit."""
        self.requests += 1
        await self.client.execute(self.unit, write_request(tag, data, self._functions))

    def read_frames(self, tags: Sequence[Tag]) -> list[str]:
        return [self._frame(read_request(r.range)) for r in self._plan(self._with_scales(tags)).reads]

    def write_frames(self, tag: Tag, data: bytes) -> list[str]:
        return [self._frame(write_request(tag, data, self._functions))]

    @property
    def _functions(self) -> list[int] | None:
        return self._profile.form.limits.functions if self._profile is not None else None

    def _frame(self, request: Request[Any]) -> str:
        return frame_of(self._url, self.unit, request).hex(" ")

    async def _transaction(self, at: RegisterRange) -> tuple[bytes, int]:
        self.requests += 1
        reply = await self.client.execute(self.unit, read_request(at))
        return cells(reply), reply.t_ns

    def _with_scales(self, tags: Sequence[Tag]) -> list[Tag]:
        known = {t.name: t for t in tags}
        if self._profile is not None:
            for tag in tags:
                if tag.scale_by is not None:
                    known.setdefault(tag.scale_by, self._profile.tags[tag.scale_by])
        return list(known.values())

    def _scaled(self, tag: Tag, answers: dict[str, PointValue]) -> PointValue:
        answer = answers[tag.name]
        if tag.scale_by is None or answer.problem:
            return answer
        by = answers.get(tag.scale_by)
        return PointValue(apply_scale(tag, answer.value, by.value if by is not None else None))

    def _plan(self, tags: Sequence[Tag]) -> GroupPlan:
        """Return the gateway's own read planner for these tags only. Later calls use the limits that were learnt."""
        key = tuple(t.name for t in tags)
        if key not in self._plans:
            self._plans[key] = GroupPlan(asked_profile(tags, self._profile), "asked", self.learnt)
        return self._plans[key]


class CanopenPoint:
    """The node `node` on the bus at `url`, queried over SDO through `master`; its NMT state is never changed."""

    protocol = "canopen"

    def __init__(self, master: CanopenMaster | None, url: str, node: int) -> None:
        self.where = f"{url} node {node}"
        self.node = node
        self.requests = 0
        self._master = master

    @property
    def master(self) -> CanopenMaster:
        assert self._master is not None, "a dry run sends nothing"
        return self._master

    async def read(
        self, tags: Sequence[Tag], found: dict[str, PointValue] | None = None, *, alone: bool = False
    ) -> dict[str, PointValue]:
        """Read as `Point.read` describes. Each tag is a separate transfer, so `alone` has no effect."""
        answers: dict[str, PointValue] = {} if found is None else found
        for tag in tags:
            assert tag.object is not None
            self.requests += 1
            try:
                data = await self.master.sdo_upload(self.node, *tag.object)
            except SdoAborted as e:
                answers |= _bad([tag], Reason.REFUSED, e)
            except WIRE_TROUBLE as e:
                answers |= _bad([tag], Reason.TIMEOUT if isinstance(e, ReplyTimeout) else Reason.WIRE_ERROR, e)
            else:
                answers[tag.name] = PointValue(decoded(tag, data, 1))
        return answers

    async def write(self, tag: Tag, data: bytes) -> None:
        assert tag.object is not None
        self.requests += 1
        await self.master.sdo_download(self.node, *tag.object, data)

    def read_frames(self, tags: Sequence[Tag]) -> list[str]:
        return [str(SdoUpload(self.node, *t.object, 0).start(0)) for t in tags if t.object is not None]

    def write_frames(self, tag: Tag, data: bytes) -> list[str]:
        assert tag.object is not None
        return [str(SdoDownload(self.node, *tag.object, 0, data).start(0))]


def _singly(read: Read) -> tuple[Read, ...]:
    """Return a separate read for each tag of `read`; an empty tuple if it has only one tag or must be read whole."""
    if read.messages or len(read.tags) < 2:
        return ()
    return tuple(Read(t.registers, (t,), ()) for t in read.tags)


def asked_profile(tags: Sequence[Tag], profile: DeviceProfile | None) -> DeviceProfile:
    """Return a profile of `tags` alone, in one group ``asked``, with the limits and gaps of `profile`.

    Without `profile` reads are as long as the standard permits, and never include a register that was not requested.
    """
    form = profile.form if profile is not None else ProfileForm(
        device="raw/raw", source="", protocol="modbus", limits=Limits(max_gap=0)
    )  # fmt: skip
    named = {t.name: replace(t, poll="asked", access="rw") for t in tags}
    gaps = profile.gaps if profile is not None else ()
    return DeviceProfile("", "", form, named, {}, None, None, None, gaps)


def planned(tags: Sequence[Tag], profile: DeviceProfile | None) -> tuple[Read, ...]:
    """Return the fewest reads for `tags` (`plan_reads`)."""
    return plan_reads(asked_profile(tags, profile), "asked")


def part(read: RegisterRange, at: RegisterRange, raw: bytes) -> bytes:
    """Return the bytes of the registers or bits `at`, cut from `raw`, the bytes of the whole `read`; a bit takes one byte."""
    width = 1 if read.table in ("coil", "discrete") else 2
    start = (at.address - read.address) * width
    return raw[start : start + at.count * width]


def write_request(tag: Tag, data: bytes, functions: Sequence[int] | None) -> Request[Any]:
    """Return the one request that writes `tag`. `functions` are the function codes that the device has (None: unknown).

    It is 05 or 0Fh for a coil, 06 for one register if the device has it or is unknown, else 10h.
    """
    at = tag.registers
    if at.table == "coil":
        value = bool(int.from_bytes(data))
        if functions is not None and 5 not in functions:
            return WriteCoils(at.address, (value,))
        return WriteCoil(at.address, value)
    words = tuple(int.from_bytes(data[i : i + 2]) for i in range(0, len(data), 2))
    if len(words) == 1 and (functions is None or 6 in functions):
        return WriteRegister(at.address, words[0])
    return WriteRegisters(at.address, words)


def _bad(
    tags: Sequence[Tag], reason: Reason, error: DeviceRefused | ReplyTimeout | CrcError | Desync
) -> dict[str, PointValue]:
    return {t.name: PointValue(TagValue(None, Quality.BAD, reason), error.message) for t in tags}
