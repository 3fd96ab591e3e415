"""What a device holds instead of what its recording or model says: value faults, and values that somebody sets."""

from __future__ import annotations

from dataclasses import dataclass, field

from emulators.faults.engine import in_time
from emulators.faults.fault import Active, ValueFault
from gateway.core.clock import NS_PER_S


@dataclass
class _Put:
    active: Active
    fault: ValueFault
    tag: str
    since_ns: int | None = None
    held: float = 0.0


@dataclass
class Distortions:
    """Of one device. `apply` is asked for every number that the device is about to hold."""

    _puts: dict[str, _Put] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self._puts)

    def put_in(self, active: Active, tag: str) -> None:
        """`tag` is distorted from now on; ``""``: every tag."""
        assert isinstance(active.fault, ValueFault)
        self._puts[active.id] = _Put(active, active.fault, tag)

    def take_away(self, id: str) -> bool:
        return self._puts.pop(id, None) is not None

    def of(self, tag: str) -> bool:
        """Whether anything may distort `tag`."""
        return any(put.tag in ("", tag) for put in self._puts.values())

    def apply(self, tag: str, value: float, now_ns: int) -> float:
        """The number that the device holds instead of `value`, in engineering units."""
        for put in self._puts.values():
            if put.tag not in ("", tag) or not in_time(put.active, now_ns):
                continue
            if put.since_ns is None:
                put.since_ns, put.held = now_ns, value
            put.active.struck += 1
            value = put.fault.distort(value, (now_ns - put.since_ns) / NS_PER_S, put.held, put.active.random)
        return value
