"""The state of one output: its tag, its device, its wanted value and the progress of the last write. It makes no decisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import FieldtwinError, NotAllowed
from fieldtwin.gateway.core.values import TagValue
from fieldtwin.gateway.devices.driver import DeviceDriver
from fieldtwin.gateway.runtime.buses.bus import Bus

SAFE = "safe: "


@dataclass
class Output:
    """One output: its tag, its device, and the progress of the last write."""

    tag: str
    local: str
    driver: DeviceDriver
    bus: Bus
    safe: float | None
    wanted: float | None = None
    by: str = ""
    held: float | None = None
    held_since_ns: int = 0
    compared: TagValue | None = None
    """The last value read from the device that was compared with the sent value and found equal."""
    pending: bool = False
    refused: tuple[float, str] | None = None
    not_a_number: bool = False
    """True if the program's newest value is not a number, so that `wanted` is an older value."""
    waits_since_ns: int | None = None
    """The time since which the output waits for a device that does not answer; `AWAY_REPORTED` once the journal has an entry
    about it.
    """
    next_try_ns: int = 0
    commanded: bool = False
    """Whether a program writes this output. If not, the gateway writes only its safe value and the values that clients
    request.
    """
    untouched: bool = True
    """True until the first write of this output or the loss of its device. Until then the device may already hold the wanted
    value.
    """
    due_since_ns: int | None = None
    """The monotonic time since which the first write has been due while the device was online."""
    asked: Callable[[FieldtwinError | None], None] | None = None
    """The callback of the client that requested one write; None for a value that the PLC or the safe state commands."""

    @property
    def ready(self) -> bool:
        """Return whether the device accepts a write now."""
        return self.bus.takes(self.driver.config.name, self.local)

    @property
    def frame(self) -> object | None:
        """Return the frame that carries this output, or None for an output that is written by itself.

        Outputs that share a frame get the same object."""
        return self.bus.frame_of(self.driver.config.name, self.local)

    @property
    def settle_ns(self) -> int:
        """Return how long after a write the device may still report the previous value, in ns."""
        return self.bus.settle_ns(self.driver.config.name, self.local)

    @property
    def read_back(self) -> bool:
        """Return whether the gateway gets the output's value cyclically, by polls or because the device sends it."""
        driver, tag = self.driver, self.driver.profile.tags[self.local]
        if not tag.readable:
            return False
        if self.bus.unrequested(driver.config.name, self.local):
            return True
        return any(tag in driver.profile.group(group) for group in driver.config.poll)

    def shown(self, value: object) -> object:
        """Return `value` as it is written into the audit log: a secret value is replaced by a fixed text."""
        return "(secret)" if self.driver.profile.tags[self.local].secret else value

    def answer(self, error: FieldtwinError | None) -> None:
        """Report the result to the client that requested the write.

        The client requested one write, so the gateway does not write the value again later."""
        asked, self.asked = self.asked, None
        if asked is not None:
            if not self.by.startswith(SAFE):
                self.wanted = None
            asked(error)


def as_sent(output: Output) -> bytes:
    """Return the bytes that would be sent now for the value that `output` holds; empty if the value is no longer allowed."""
    try:
        return output.driver.command(output.local, output.held).data if output.held is not None else b""
    except NotAllowed:
        return b""
