"""Check the abilities of this computer. Each check reports its finding and, where something is missing, the remedy."""

from __future__ import annotations

import errno
import os
import platform
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

from fieldtwin.__about__ import __version__
from fieldtwin.doctor import host as here
from fieldtwin.doctor.verdicts import Check, HostVerdict, judged_can, judged_clock, judged_processor, judged_watches
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.data_files import data_root
from fieldtwin.twin.site.system import load_system

MIN_FREE_BYTES = 200 * 1024 * 1024
MIN_OPEN_FILES = 1024


def examine() -> list[Check]:
    """Run every check; they change nothing except temporary files."""
    checks: tuple[Callable[[], Check], ...] = (
        _python,
        _data,
        _run_directory,
        _pty,
        _serial,
        _can,
        _realtime,
        _files,
        _watches,
        _processor,
        _clock,
        _disk,
    )
    return [check() for check in checks]


def _python() -> Check:
    found = f"fieldtwin {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    return Check("python", HostVerdict.OK, found)


def _data() -> Check:
    try:
        root = data_root()
        system = load_system(str(root / "profiles" / "systems" / "observatory.yaml"))
    except FieldtwinError as e:
        return Check("shipped data", HostVerdict.BAD, str(e), "reinstall fieldtwin")
    profiles = len(list((root / "profiles" / "devices").glob("*.yaml")))
    recordings = len(list((root / "recordings").glob("*.jsonl")))
    return Check(
        "shipped data", HostVerdict.OK, f"system {system.name}, {profiles} profiles, {recordings} recordings in {root}"
    )


def _run_directory() -> Check:
    root = runtime_root()
    try:
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        probe = root / f".doctor-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as e:
        return Check(
            "run directory", HostVerdict.BAD, f"{root}: {e.strerror}", "set FIELDTWIN_RUN to a folder of yours"
        )
    return Check("run directory", HostVerdict.OK, str(root))


def _pty() -> Check:
    if not hasattr(os, "openpty"):
        return Check(
            "virtual serial", HostVerdict.NOTE, "this system has none", "emulate on tcp, or on real serial ports"
        )
    import tty

    try:
        master, slave = os.openpty()
        try:
            tty.setraw(slave)
            os.write(master, b"\x11\x03")
            whole = os.read(slave, 2) == b"\x11\x03"
        finally:
            os.close(master)
            os.close(slave)
    except OSError as e:
        return Check("virtual serial", HostVerdict.BAD, f"no pseudo-terminal: {e.strerror}", "mount devpts on /dev/pts")
    if not whole:
        return Check("virtual serial", HostVerdict.BAD, "a raw pty changes bytes", "report this")
    return Check("virtual serial", HostVerdict.OK, "ptys work")


def _serial() -> Check:
    from fieldtwin.gateway.connections.serial_port import local_ports

    ports = local_ports()
    closed = [p for p in ports if not os.access(p, os.R_OK | os.W_OK)]
    if closed:
        return Check("serial ports", HostVerdict.NOTE, f"no access to {', '.join(closed)}", here.join_advice(closed))
    return Check("serial ports", HostVerdict.OK, ", ".join(ports) or "none (prototypes need none)")


def _can() -> Check:
    if not hasattr(socket, "PF_CAN"):
        return Check(
            "kernel CAN", HostVerdict.NOTE, "this Python has no SocketCAN", "prototypes use the software CAN bus"
        )
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as e:
        reason = "no CAN in this kernel" if e.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT) else str(e.strerror)
        return Check(
            "kernel CAN",
            HostVerdict.NOTE,
            reason,
            "prototypes use the software CAN bus; a plant needs `modprobe can-raw`",
        )
    return judged_can(here.can_interfaces())


def _realtime() -> Check:
    allowed, found = here.may_realtime()
    if not allowed:
        advice = (
            "for a steadier scan: rtprio and memlock in /etc/security/limits.d, or CAP_SYS_NICE (systemd: LimitRTPRIO)"
        )
        return Check("real time", HostVerdict.NOTE, found, advice)
    return Check("real time", HostVerdict.OK, found)


def _files() -> Check:
    """Check the hard limit: a process that serves many devices raises its own limit up to it."""
    hard = here.most_open_files()
    if hard is None:
        return Check("open files", HostVerdict.OK, "no limit")
    if hard < MIN_OPEN_FILES:
        return Check("open files", HostVerdict.NOTE, f"limit {hard}", f"ulimit -Hn {MIN_OPEN_FILES} for many devices")
    return Check("open files", HostVerdict.OK, f"limit {hard}")


def _watches() -> Check:
    return judged_watches(here.kernel_number("fs/inotify/max_user_instances"))


def _processor() -> Check:
    return judged_processor(here.cpu_count(), here.cgroup_quota())


def _clock() -> Check:
    return judged_clock(here.clock_state())


def _disk() -> Check:
    root = runtime_root()
    # Path.exists raises if a parent folder is not accessible.
    existing = next((p for p in (root, *root.parents) if os.path.exists(p)), Path("/"))
    free = shutil.disk_usage(existing).free
    found = f"{free // (1024 * 1024)} MiB free at {existing}"
    if free < MIN_FREE_BYTES:
        return Check("disk", HostVerdict.BAD, found, "logs and stores need space")
    return Check("disk", HostVerdict.OK, found)
