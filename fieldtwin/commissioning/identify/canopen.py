"""`identify` of a CANopen node: read 1000h, 1008h, 1009h, 100Ah and 1018h, and compare them with the data sheets of known
profiles.

The command only reads, one object at a time, with a pause after each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from fieldtwin.commissioning.access.connection import canopen_at
from fieldtwin.commissioning.identify.matching import CanClues, Candidate, certain, rank, rate_canopen, summary
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Tap
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, SdoAborted
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.protocols.canopen.configure import Identity
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, load_dictionary
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.wallclock import WallClock

NAMES = {0x1008: "name", 0x1009: "hardware", 0x100A: "software"}
LONGEST_TEXT = 256


@dataclass(slots=True)
class CanIdentity:
    """The result of `identify` for a node: the values of its identity objects, and the profiles that may fit."""

    url: str
    node: int
    clues: CanClues = field(default_factory=CanClues)
    candidates: list[Candidate] = field(default_factory=list)
    answers: bool = False
    conflict: str = ""
    """The reason to assume that two nodes have this ID, "" without such a reason; a value may then come from either of them."""

    @property
    def summary(self) -> str:
        if self.conflict:
            return f"{self.conflict}; the values read may belong to either node"
        return summary(self.candidates) if self.answers else f"node {self.node} does not answer SDO requests"

    @property
    def certain(self) -> str | None:
        """Return the profile that is certain; None if no profile or more than one is certain."""
        return None if self.conflict else certain(self.candidates)


async def identify_canopen(
    url: str,
    node: int,
    profiles: Iterable[DeviceProfile],
    *,
    bitrate: int = 0,
    timeout_s: float = 0.5,
    per_s: float = 20.0,
    on_progress: Callable[[str], None] = lambda _: None,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> CanIdentity:
    """Identify `node` on the bus at `url`, and compare it with `profiles`, with at most `per_s` requests a second. Raises the
    same errors as `canopen_at`.
    """
    clock = clock or WallClock()
    result = CanIdentity(url, node)
    async with canopen_at(url, bitrate, sdo_timeout_s=timeout_s, taps=taps, connector=connector, clock=clock) as master:
        asker = _Asker(master, result, clock, 1 / per_s)
        on_progress("1000h, device type")
        kind = await asker.number(0x1000, 0)
        if result.answers:
            on_progress("1018h, identity")
            highest = await asker.number(0x1018, 0) or 0
            parts = [await asker.number(0x1018, sub) if sub <= highest else None for sub in range(1, 5)]
            if kind is not None:
                result.clues.identity = Identity(kind, *parts)
            for index, name in NAMES.items():
                on_progress(f"{index:04X}h, {name}")
                setattr(result.clues, name, await asker.text(index))
        result.conflict = master.conflicts.get(node, "")
    if result.answers:
        result.candidates = rank(
            rate_canopen(p, _data_sheet(p, node), result.clues) for p in profiles if p.protocol == "canopen"
        )
    return result


class _Asker:
    """A sender of single SDO uploads. An abort or a missing reply is noted in the result and not raised."""

    def __init__(self, master: CanopenMaster, result: CanIdentity, clock: Clock, pause_s: float) -> None:
        self._master, self._result, self._clock = master, result, clock
        self._pause_ns = round(pause_s * NS_PER_S)

    async def number(self, index: int, subindex: int) -> int | None:
        data = await self._upload(index, subindex)
        return int.from_bytes(data[:4], "little") if data is not None and len(data) in (1, 2, 4) else None

    async def text(self, index: int) -> str:
        data = await self._upload(index, 0)
        return "" if data is None else data[:LONGEST_TEXT].decode("utf-8", "replace").strip("\0 ")

    async def _upload(self, index: int, subindex: int) -> bytes | None:
        name = f"{index:04X}:{subindex:02X}"
        try:
            data = await self._master.sdo_upload(self._result.node, index, subindex)
        except SdoAborted as e:
            self._result.answers = True
            self._result.clues.silence[name] = f"abort {e.code:08X}h"
            return None
        except (ReplyTimeout, Desync) as e:
            self._result.clues.silence[name] = "no answer" if isinstance(e, ReplyTimeout) else e.message
            return None
        finally:
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + self._pause_ns)
        self._result.answers = True
        return data


def _data_sheet(profile: DeviceProfile, node: int) -> ObjectDictionary | None:
    return load_dictionary(profile.eds_path, node) if profile.eds_path is not None else None
