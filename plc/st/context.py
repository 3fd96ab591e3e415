"""The scan as compiled code sees it: its time and number, its limits, and the messages of mailboxes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

from fieldtwin.gateway.core.image.image import Message
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.program import ScanTooLong
from fieldtwin.plc.st import values

MAX_STEPS = 1_000_000
"""How many loop iterations, and calls of functions and function blocks, a program may make in one scan. The limit is
the same in real and in virtual time; in virtual time nothing else ends an endless loop."""


class Context:
    """The interface through which compiled code uses the running scan."""

    __slots__ = ("executed", "first_scan", "instances", "left", "lookup", "now_ns", "published", "scan")

    def __init__(self) -> None:
        self.left = MAX_STEPS
        """The number of loop iterations and calls that the scan may still make."""
        self.now_ns = 0
        self.scan = 0
        """The number of the scan, for the records of assignments."""
        self.first_scan = False
        self.published: tuple[dict[str, Any], tuple[str | None, ...]] | None = None
        """Where machine code publishes the variables that it changes: a dictionary, and the key of each variable of the PROGRAM.
        Machine code that has published them sets it to None."""
        self.instances = 0
        """The number of instances that variables of an interface type can refer to."""
        self.lookup: Callable[[str], TagValue] | None = None
        self.executed: Callable[[Any], None] | None = None
        """The function that probes for coverage call. Code without probes does not use it."""

    @property
    def scan_ns(self) -> int:
        """Return the scan's time for SCAN_TIME(). A program that uses it depends on absolute time, not only on differences."""
        return self.now_ns

    def is_good(self, name: str) -> bool:
        """Return whether an input is good. A forced value counts as good: the user who forces it wants it to be used."""
        assert self.lookup is not None
        return self.lookup(name).quality in (Quality.GOOD, Quality.SIMULATED)

    def number(self) -> int:
        """Return the number of a new instance, by which states refer to it."""
        self.instances += 1
        return self.instances

    @staticmethod
    def too_long() -> NoReturn:
        """End a scan that has used up its iterations and calls. Raises `ScanTooLong`."""
        raise ScanTooLong(f"more than {MAX_STEPS:,} loop iterations and calls in one scan")

    @staticmethod
    def message(messages: tuple[Message, ...], number: int) -> Message:
        """Return a message of a mailbox; `number` counts from 1."""
        return messages[values.index(number, 1, len(messages))]
