"""Judge a computer's properties for a plant's controller, with remedies. The properties are arguments: `checks` reads them
from the computer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

MIN_INOTIFY = 16
MIN_CPUS = 1.0
"""Smallest number of processors. Gateway, PLC and the process of the run share them, and with fewer than one processor scans
are late.
"""


class HostVerdict(Enum):
    """The verdict of a check. NOTE: something optional is missing, and everything else works."""

    OK = "ok"
    NOTE = "note"
    BAD = "bad"


@dataclass(frozen=True)
class DoctorCheck:
    """One check: its name, the verdict, the finding and, where something is missing, the remedy."""

    name: str
    verdict: HostVerdict
    found: str
    advice: str = ""


@dataclass(frozen=True)
class ClockState:
    """The kernel's clock: whether it is synchronised, and the kernel's estimate of its error."""

    synchronised: bool
    error_s: float
    year: int


def clock_verdict(state: ClockState | None) -> DoctorCheck:
    """Judge the clock; `state` is None if the kernel's clock state cannot be read.

    Scans and polls use the monotonic clock; a wrong time of day spoils logs and recordings and makes TLS fail.
    """
    if state is None:
        return DoctorCheck(
            "clock", HostVerdict.NOTE, "this system does not report whether it is synchronised", "use NTP or PTP"
        )
    if state.year < 2024:
        return DoctorCheck(
            "clock", HostVerdict.BAD, f"the year is {state.year}", "set the clock, and use a backup battery or NTP"
        )
    if not state.synchronised:
        advice = "start chrony or systemd-timesyncd: time stamps of logs and certificates depend on it"
        return DoctorCheck("clock", HostVerdict.NOTE, "the kernel's clock is not synchronised", advice)
    return DoctorCheck("clock", HostVerdict.OK, f"synchronised, at most {state.error_s * 1000:.0f} ms off")


def can_interface_verdict(interfaces: Mapping[str, bool]) -> DoctorCheck:
    """Judge the kernel's CAN interfaces; `interfaces` maps each name to whether it is up.

    The bit rate has to be set before an interface is brought up, by an authorised user.
    """
    found = ", ".join(name if up else f"{name} (down)" for name, up in interfaces.items())
    down = [name for name, up in interfaces.items() if not up]
    if down:
        rate = "" if down[0].startswith("v") else " type can bitrate 125000 restart-ms 100"
        return DoctorCheck("kernel CAN", HostVerdict.NOTE, found, f"sudo ip link set {down[0]} up{rate}")
    return DoctorCheck("kernel CAN", HostVerdict.OK, found or "available, no interface (`ip link add vcan0 type vcan`)")


def watches_verdict(instances: int | None) -> DoctorCheck:
    """Judge the inotify limit; `instances` is the limit per user, None if this system has no inotify.

    fieldtwin does not use inotify; udev, journald and systemd need it to announce ports and start services.
    """
    if instances is None:
        return DoctorCheck("inotify", HostVerdict.OK, "not on this system")
    if instances < MIN_INOTIFY:
        advice = "sysctl fs.inotify.max_user_instances=128"
        return DoctorCheck("inotify", HostVerdict.NOTE, f"{instances} instances per user", advice)
    return DoctorCheck("inotify", HostVerdict.OK, f"{instances} instances per user")


def processor_verdict(cpus: int, quota: float | None) -> DoctorCheck:
    """Judge the processors. `quota`: the processors that a cgroup allows, None for no limit.

    When a quota is used up, the kernel stops all processes of the cgroup until the next period begins.
    """
    if quota is None:
        return DoctorCheck("processors", HostVerdict.OK, f"{cpus}, no quota")
    found = f"{cpus}, of which a cgroup grants {quota:g} at most"
    if quota < MIN_CPUS:
        advice = "scans are late whenever the quota is used up: grant at least one (docker --cpus, systemd CPUQuota)"
        return DoctorCheck("processors", HostVerdict.NOTE, found, advice)
    return DoctorCheck("processors", HostVerdict.OK, found)


def quota_of(text: str) -> float | None:
    """Return the number of processors in cgroup v2's ``cpu.max``: ``QUOTA PERIOD`` in microseconds, or ``max PERIOD``.

    Return None for no quota.
    """
    words = text.split()
    if len(words) != 2 or not all(w.isascii() and w.isdigit() for w in words) or int(words[1]) == 0:
        return None
    return int(words[0]) / int(words[1])
