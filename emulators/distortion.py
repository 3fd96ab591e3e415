"""Values that replace those of a device's recording or model: value faults, and values that a user sets."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.emulators.faults.engine import in_time
from fieldtwin.emulators.faults.fault import Active, ValueFault
from fieldtwin.gateway.core.clock import NS_PER_S


@dataclass
class _Put:
    active: Active
    fault: ValueFault
    tag: str
    since_ns: int | None = None
    held: float = 0.0


@dataclass
class Distortions:
    """The value faults of one device. Before the device stores a number, it passes the number to `apply`."""

    _puts: dict[str, _Put] = field(default_factory=dict)
    counts_given: bool = False
    """Whether a fault takes effect when `gave` reports that its value was sent. Otherwise each number that `apply` changes
    counts as an effect, which suits a device that computes its values when they are read.
    """

    def __bool__(self) -> bool:
        return bool(self._puts)

    def put_in(self, active: Active, tag: str) -> None:
        """Distort `tag` from now on, or every tag if it is ``""``."""
        assert isinstance(active.fault, ValueFault)
        self._puts[active.id] = _Put(active, active.fault, tag)

    def take_away(self, id: str) -> bool:
        return self._puts.pop(id, None) is not None

    def of(self, tag: str, *, named: bool = False) -> bool:
        """Return whether a fault may distort `tag`. With `named`, only faults that name this tag count."""
        return any(
            (put.tag == tag or (put.tag == "" and not named)) and put.fault.on(tag) is not None
            for put in self._puts.values()
        )

    def apply(self, tag: str, value: float, now_ns: int, *, named: bool = False) -> float:
        """Return the number that the device stores instead of `value`, in engineering units. `named` as in `of`."""
        for put in self._puts.values():
            if (put.tag != tag and (put.tag != "" or named)) or not in_time(put.active, now_ns):
                continue
            fault = put.fault.on(tag)
            if fault is None:
                continue
            if put.since_ns is None:
                put.since_ns, put.held = now_ns, value
            put.active.struck += not self.counts_given
            value = fault.distort(value, (now_ns - put.since_ns) / NS_PER_S, put.held, put.active.random)
        return value

    def gave(self, tag: str, now_ns: int, *, named: bool = False) -> None:
        """Count that each fault that distorts `tag` took effect, because the device has sent the value.

        `named` as in `of`.
        """
        for put in self._puts.values():
            aimed = put.tag == tag or (put.tag == "" and not named)
            if aimed and in_time(put.active, now_ns) and put.fault.on(tag) is not None:
                put.active.struck += 1
