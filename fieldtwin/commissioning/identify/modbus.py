"""`identify` of a Modbus unit: read the unit's own identification, then check whether the registers of known profiles
have plausible values. The command only reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from fieldtwin.commissioning.access.connection import frame_of, modbus_at
from fieldtwin.commissioning.access.point import ModbusPoint
from fieldtwin.commissioning.identify import sunspec
from fieldtwin.commissioning.identify.matching import (
    Candidate,
    ModbusClues,
    ProfileReading,
    SunSpec,
    Sureness,
    certain,
    contradicted,
    rank,
    rate_modbus,
    summary,
)
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector, Tap
from fieldtwin.gateway.core.errors import (
    CrcError,
    Desync,
    ModbusExceptionReply,
    ReplyTimeout,
)
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.values import Reason
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.data import ReadRegisters
from fieldtwin.gateway.protocols.modbus.requests.identity import ReadDeviceIdentification, ReportServerId
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply
from fieldtwin.gateway.protocols.modbus.requests.request import Request

MOST_TAGS = 24
"""Number of values of a profile that are read to see whether they are plausible, in addition to those in its `identify`
section.
"""
SILENT = (ReplyTimeout, CrcError, Desync)
NAMES = {0: "vendor", 1: "product code", 2: "revision", 3: "vendor URL", 4: "product", 5: "model", 6: "application"}
R = TypeVar("R", bound=Reply)


@dataclass(slots=True)
class ModbusIdentity:
    """The result of `identify` for a unit: its own identification, and the profiles that may fit."""

    url: str
    unit: int
    clues: ModbusClues = field(default_factory=ModbusClues)
    candidates: list[Candidate] = field(default_factory=list)
    answers: bool = False
    requests: int = 0

    @property
    def summary(self) -> str:
        if not self.answers:
            return f"unit {self.unit} does not answer (`scan` finds units and settings)"
        return summary(self.candidates)

    @property
    def certain(self) -> str | None:
        """Return the profile that is certain; None if no profile or more than one is certain."""
        return certain(self.candidates)


async def identify_modbus(
    url: str,
    unit: int,
    profiles: Iterable[DeviceProfile],
    *,
    timeout_s: float = 1.0,
    per_s: float = 20.0,
    echo: bool = False,
    on_progress: Callable[[str], None] = lambda _: None,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> ModbusIdentity:
    """Identify `unit` at `url`, by its own answers and by comparison with `profiles`. At most `per_s` requests a second.

    Raises `Unreachable` where the endpoint cannot be opened or is lost; the result reports a unit that does not answer.
    """
    result = ModbusIdentity(url, unit)
    async with modbus_at(
        url, timeout_s=timeout_s, spacing_s=1 / per_s, echo=echo, taps=taps, connector=connector, clock=clock
    ) as client:
        asker = _Asker(client, unit, result)
        on_progress("function 11h, server id")
        reply = await asker.ask("11", ReportServerId())
        result.clues.server_id = reply.raw if reply is not None else None
        on_progress("SunSpec header")
        await asker.sunspec()
        on_progress("function 2Bh/0Eh, device identification")
        await asker.identification()
        if "no answer" in result.clues.silence.values() or not result.answers:
            on_progress(
                "register 0"
            )  # the pause also helps servers that lose the next request after a request with an unknown function
            await asker.ask("03", ReadRegisters("holding", 0, 1))
        if result.answers:
            for profile in profiles:
                if profile.protocol == "modbus":
                    on_progress(f"profile {profile.name}")
                    result.candidates.append(await _compare(client, result, profile))
        result.requests = client.counters.requests
    result.candidates = rank(result.candidates)
    return result


def modbus_frames(url: str, unit: int) -> list[str]:
    """Return the frames of the requests that `identify` sends before it reads any profile's registers, for `--dry-run`."""
    headers = [ReadRegisters("holding", base, 2) for base in sunspec.BASES]
    questions = [ReportServerId(), *headers, *(ReadDeviceIdentification(code) for code in (1, 2, 3))]
    return [frame_of(url, unit, question).hex(" ") for question in questions]


class _Asker:
    """A sender of single requests. A refusal or a missing reply is noted in the result and not raised."""

    def __init__(self, client: ModbusClient, unit: int, result: ModbusIdentity) -> None:
        self._client, self._unit, self._result = client, unit, result

    async def ask(self, name: str, request: Request[R]) -> R | None:
        try:
            reply = await self._client.execute(self._unit, request)
        except ModbusExceptionReply as e:
            self._result.answers = self._result.answers or e.code not in (0x0A, 0x0B)
            self._result.clues.silence[name] = f"exception {e.code:02X}h"
        except SILENT as e:
            self._result.clues.silence[name] = "no answer" if isinstance(e, ReplyTimeout) else e.message
        else:
            self._result.answers = True
            return reply
        return None

    async def identification(self) -> None:
        """Read basic, then regular, then extended objects, as far as the unit supports them."""
        objects: dict[int, bytes] = {}
        for code in (1, 2, 3):
            before = len(objects)
            try:
                objects |= await self._client.read_identification(self._unit, code)
            except ModbusExceptionReply as e:
                self._result.answers = self._result.answers or e.code not in (0x0A, 0x0B)
                self._result.clues.silence["2B"] = f"exception {e.code:02X}h"
                break
            except SILENT as e:
                self._result.clues.silence["2B"] = "no answer" if isinstance(e, ReplyTimeout) else e.message
                break
            if len(objects) == before:
                break  # the unit does not support a higher level, and repeats the objects of the lower one
        if objects:
            self._result.answers = True
            self._result.clues.silence.pop("2B", None)
            texts = {n: o.decode("utf-8", "replace").strip("\0 ") for n, o in sorted(objects.items())}
            self._result.clues.objects = texts

    async def sunspec(self) -> None:
        other = False
        for base in sunspec.BASES:
            reply = await self.ask("sunspec", ReadRegisters("holding", base, 2))
            if reply is not None and reply.raw == sunspec.HEADER:
                self._result.clues.silence.pop("sunspec", None)
                self._result.clues.sunspec = await self._models(base)
                return
            other = other or reply is not None
        if other:
            self._result.clues.silence["sunspec"] = "no header"

    async def _models(self, base: int) -> SunSpec:
        models: list[tuple[int, int, int]] = []
        names: dict[str, str] = {}
        at = base + 2
        while len(models) < sunspec.MOST_MODELS and at + 2 <= 0x10000:
            head = await self.ask("sunspec", ReadRegisters("holding", at, 2))
            model = sunspec.next_model(head.raw, at) if head is not None else None
            if model is None:
                break
            models.append(model)
            if model[0] == sunspec.COMMON and not names:
                size = min(sunspec.COMMON_REGISTERS, model[2] + 2)
                reply = await self.ask("sunspec", ReadRegisters("holding", at, size))
                names = sunspec.common(reply.raw) if reply is not None else {}
            at = model[1] + 2 + model[2]
        return SunSpec(base, tuple(models), **names)


async def _compare(client: ModbusClient, result: ModbusIdentity, profile: DeviceProfile) -> Candidate:
    """Read the tags that distinguish this profile from others, the decisive ones first; stop when they rule it out."""
    against = contradicted(profile, result.clues)
    if against:
        return Candidate(profile.name, Sureness.RULED_OUT, (), (against,))
    point = ModbusPoint(client, result.url, result.unit, profile)
    keys = {entry.tag for entry in profile.form.identify}
    avoid = {effect.read for effect in profile.form.effects if effect.read}
    others = [
        tag
        for tag in profile.tags.values()
        if tag.readable and not tag.is_text and not tag.secret and tag.name not in keys and tag.name not in avoid
    ]
    others.sort(key=_telling)
    first = [profile.tags[name] for name in keys if profile.tags[name].readable] or others[:4]
    readings = await _read(point, first)
    verdict = rate_modbus(profile, result.clues, readings)
    if verdict.against and verdict.sureness is Sureness.RULED_OUT:
        return verdict
    readings |= await _read(point, [t for t in others if t.name not in readings][:MOST_TAGS])
    return rate_modbus(profile, result.clues, readings)


def _telling(tag: Tag) -> int:
    """Return the sort key of a tag: tags whose values could turn out to be implausible come first."""
    return 0 if tag.type.startswith("float") else 1 if tag.values or tag.range is not None else 2


async def _read(point: ModbusPoint, tags: Sequence[Tag]) -> dict[str, ProfileReading]:
    if not tags:
        return {}
    readings = {}
    for name, answer in (await point.read(tags)).items():
        tag = next((t for t in tags if t.name == name), None)
        if tag is not None:
            refused = answer.value.reason is Reason.REFUSED
            value = None if answer.problem else answer.value
            readings[name] = ProfileReading(tag, value, answer.problem, refused)
    return readings
