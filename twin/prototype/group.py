"""Systems that run together as prototypes. A system alone is a group of one, whose name is empty.

A file that describes several systems has a kind (`fieldtwin.twin.site.groups`), which says what the systems share.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, ClassVar, cast

from fieldtwin.emulators.faults.schema import FaultSpec
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.groups import group_file, group_module
from fieldtwin.twin.site.system import System


@dataclass(frozen=True)
class GroupMember:
    """One of the systems. `name` is empty for a system alone."""

    name: str
    system: System
    prototype: Prototype

    @property
    def prefix(self) -> str:
        """Return the beginning of each of this system's names in the group: ``west.``; empty for a system alone."""
        return f"{self.name}." if self.name else ""


@dataclass(frozen=True)
class SystemGroup(ABC):
    """The systems of a run. This class gives them names and distributes faults to them.

    `members` are in the file's order; `seed` is the file's.
    """

    name: str
    path: Path
    seed: int
    members: Mapping[str, GroupMember]

    kind: ClassVar[str] = ""
    """The registered kind of the file; empty for a system alone."""

    @property
    @abstractmethod
    def whole(self) -> System:
        """Return all systems combined as one system, with the names of the group. The result is for inspection and must never
        be run.
        """

    @property
    def shared(self) -> tuple[str, ...]:
        """Return the names of the shared resources. A fault can name one of them as its target, like a bus."""
        return ()

    @abstractmethod
    def split(self, name: str) -> tuple[str, str]:
        """Split ``west.ctd.pressure`` into ``west`` and ``ctd.pressure``. Raises `UsageError` for an unknown system."""

    @abstractmethod
    def check_fault(self, spec: FaultSpec) -> None:
        """Check a fault's aim. Raises `WrongAim` if the aim is neither in a system nor a shared resource."""

    @abstractmethod
    def place(self, faults: Iterable[Mapping[str, Any]]) -> dict[str, tuple[dict[str, Any], ...]]:
        """Return the faults by system, under that system's own names, or by the shared resource that they name.

        A system without a fault is not included. Raises `UsageError` for an unknown system.
        """

    def random_shared_faults(
        self, random: Random, kinds: Collection[str], mean_s: float, last_s: float
    ) -> list[dict[str, Any]]:
        """Return random faults of the shared resources, in the form of a fault file. All of them have ended after `last_s`
        seconds.

        `kinds` are names of faults; empty: all. `mean_s` is the mean time between two faults of a system, in seconds.
        """
        return []


class OneSystem(SystemGroup):
    """A system alone, as a group. `one_system` creates it."""

    @property
    def whole(self) -> System:
        return self.members[""].system

    def split(self, name: str) -> tuple[str, str]:
        return "", name

    def check_fault(self, spec: FaultSpec) -> None:
        target(self.whole, spec)

    def place(self, faults: Iterable[Mapping[str, Any]]) -> dict[str, tuple[dict[str, Any], ...]]:
        return {"": tuple(dict(fault) for fault in faults)}


def one_system(system: System, prototype: Prototype) -> OneSystem:
    """Return a system as a group of one."""
    return OneSystem(system.name, system.path, prototype.seed, {"": GroupMember("", system, prototype)})


def load_group(name: str, profiles: Iterable[Path] = ()) -> SystemGroup | None:
    """Read the file that `name` refers to if it describes several systems, with all files that it names; else None.

    Raises `FileInvalid` with the place of the error.
    """
    profiles = tuple(profiles)
    found = group_file(name, profiles)
    return None if found is None else read_group(*found, profiles)


def read_group(kind: str, path: Path, profiles: Iterable[Path] = ()) -> SystemGroup:
    """Read a file that `group_file` has found, with all files that it names. Raises `FileInvalid`."""
    return cast(SystemGroup, group_module(kind).load(path, profiles))
