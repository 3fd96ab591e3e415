"""Properties of this computer for `fieldtwin doctor`: values without verdicts. A property that cannot be read is None."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from fieldtwin.doctor.verdicts import ClockState, quota_of

_STA_UNSYNC = 0x0040  # linux/timex.h
_TIME_ERROR = 5
_ARPHRD_CAN = 280  # linux/if_arp.h
_IFF_UP = 0x1  # linux/if.h


def may_realtime() -> tuple[bool, str]:
    """Return whether the user's rights and limits allow SCHED_FIFO, and a message about it. The function does not try it."""
    try:
        import resource
    except ImportError:
        return False, "this system has no SCHED_FIFO"
    if not hasattr(resource, "RLIMIT_RTPRIO"):
        return False, "this system has no SCHED_FIFO"
    soft = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if os.geteuid() == 0 or soft > 0 or soft == resource.RLIM_INFINITY:
        return True, "SCHED_FIFO may be used"
    return False, "SCHED_FIFO is not allowed"


def most_open_files() -> int | None:
    """Return the hard limit of open files; None for no limit, or if this system has no such limit."""
    try:
        import resource
    except ImportError:
        return None
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    return None if hard == resource.RLIM_INFINITY else hard


def kernel_number(name: str) -> int | None:
    """Return the number in the file `name` in /proc/sys; None if it cannot be read."""
    with suppress(OSError, ValueError):
        return int((Path("/proc/sys") / name).read_text())
    return None


def can_interfaces() -> dict[str, bool]:
    """Return the kernel's CAN interfaces, and whether each is up."""
    found = {}
    for kind in sorted(Path("/sys/class/net").glob("*/type")):
        with suppress(OSError, ValueError):  # the interface may have been removed
            if int(kind.read_text()) == _ARPHRD_CAN:
                found[kind.parent.name] = bool(int((kind.parent / "flags").read_text(), 16) & _IFF_UP)
    return found


def cpu_count() -> int:
    """Return the number of processors that this process may run on."""
    if sys.platform.startswith("linux"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cgroup_quota() -> float | None:
    """Return the smallest CPU quota of this cgroup and its parents (v2), or that of cgroup v1, in processors; None without
    one.
    """
    found: list[float] = []
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            number, controllers, path = line.split(":", 2)
            if number == "0" and not controllers:
                place = Path("/sys/fs/cgroup") / path.lstrip("/")
                for folder in (place, *place.parents):
                    if folder.is_relative_to("/sys/fs/cgroup"):
                        found += _quota_in(folder / "cpu.max")
    with suppress(OSError, ValueError):
        old = Path("/sys/fs/cgroup/cpu")
        quota_us = int((old / "cpu.cfs_quota_us").read_text())
        if quota_us > 0:
            found.append(quota_us / int((old / "cpu.cfs_period_us").read_text()))
    return min(found, default=None)


def _quota_in(file: Path) -> list[float]:
    with suppress(OSError):
        quota = quota_of(file.read_text())
        return [quota] if quota is not None else []
    return []


class _Timex(ctypes.Structure):
    """The beginning of struct timex (adjtimex(2)), followed by padding for its remaining fields."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 512),
    )


def clock_state() -> ClockState | None:
    """Return the kernel's clock state, which adjtimex(2) reads without a change; None if it cannot be read."""
    year = datetime.now(UTC).year
    if not sys.platform.startswith("linux"):
        return None
    timex = _Timex()
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return None
    if state < 0:
        return None
    bad = state == _TIME_ERROR or bool(timex.status & _STA_UNSYNC)
    return ClockState(synchronised=not bad, error_s=timex.maxerror / 1e6, year=year)


def join_advice(ports: Sequence[str]) -> str:
    """Return the way to get access to `ports`: the groups that own them, if their members have access; else a udev rule."""
    groups: list[str] = []
    try:
        import grp
        import pwd
    except ImportError:
        return "another program may have them open"
    for port in ports:
        with suppress(OSError, KeyError):
            status = os.stat(port)
            if status.st_mode & 0o060 == 0o060:
                groups.append(grp.getgrgid(status.st_gid).gr_name)
    if not groups:
        return 'their groups may not either: a udev rule such as SUBSYSTEM=="tty", GROUP="dialout", MODE="0660"'
    try:
        user = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:  # the user of a container may have no entry in the list of users
        return f"run with the group {', '.join(sorted(set(groups)))} (docker --group-add)"
    wanted = sorted(set(groups))
    return f"sudo usermod -aG {','.join(wanted)} {user}, and log in again"
