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
from fieldtwin.doctor.verdicts import (
    DoctorCheck,
    HostVerdict,
    can_interface_verdict,
    clock_verdict,
    processor_verdict,
    watches_verdict,
)
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.data_files import data_root
from fieldtwin.twin.site.system import load_system

MIN_FREE_BYTES = 200 * 1024 * 1024
MIN_OPEN_FILES = 1024


def examine() -> list[DoctorCheck]:
    """Run every check; they change nothing except temporary files."""
    checks: tuple[Callable[[], DoctorCheck], ...] = (
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


def _python() -> DoctorCheck:
    found = f"fieldtwin {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    return DoctorCheck("python", HostVerdict.OK, found)


def _data() -> DoctorCheck:
    try:
        root = data_root()
        system = load_system(str(root / "profiles" / "systems" / "observatory.yaml"))
    except FieldtwinError as e:
        return DoctorCheck("shipped data", HostVerdict.BAD, str(e), "reinstall fieldtwin")
    profiles = len(list((root / "profiles" / "devices").glob("*.yaml")))
    recordings = len(list((root / "recordings").glob("*.jsonl")))
    return DoctorCheck(
        "shipped data", HostVerdict.OK, f"system {system.name}, {profiles} profiles, {recordings} recordings in {root}"
    )


def _run_directory() -> DoctorCheck:
    root = runtime_root()
    try:
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        probe = root / f".doctor-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as e:
        return DoctorCheck(
            "run directory", HostVerdict.BAD, f"{root}: {e.strerror}", "set FIELDTWIN_RUN to a folder of yours"
        )
    return DoctorCheck("run directory", HostVerdict.OK, str(root))


def _pty() -> DoctorCheck:
    if not hasattr(os, "openpty"):
        return DoctorCheck(
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
        return DoctorCheck(
            "virtual serial", HostVerdict.BAD, f"no pseudo-terminal: {e.strerror}", "mount devpts on /dev/pts"
        )
    if not whole:
        return DoctorCheck("virtual serial", HostVerdict.BAD, "a raw pty changes bytes", "report this")
    return DoctorCheck("virtual serial", HostVerdict.OK, "ptys work")


def _serial() -> DoctorCheck:
    from fieldtwin.gateway.connections.serial.port import local_ports

    ports = local_ports()
    closed = [p for p in ports if not os.access(p, os.R_OK | os.W_OK)]
    if closed:
        return DoctorCheck(
            "serial ports", HostVerdict.NOTE, f"no access to {', '.join(closed)}", here.join_advice(closed)
        )
    return DoctorCheck("serial ports", HostVerdict.OK, ", ".join(ports) or "none (prototypes need none)")


def _can() -> DoctorCheck:
    if not hasattr(socket, "PF_CAN"):
        return DoctorCheck(
            "kernel CAN", HostVerdict.NOTE, "this Python has no SocketCAN", "prototypes use the software CAN bus"
        )
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as e:
        reason = "no CAN in this kernel" if e.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT) else str(e.strerror)
        return DoctorCheck(
            "kernel CAN",
            HostVerdict.NOTE,
            reason,
            "prototypes use the software CAN bus; a plant needs `modprobe can-raw`",
        )
    return can_interface_verdict(here.can_interfaces())


def _realtime() -> DoctorCheck:
    allowed, found = here.may_realtime()
    if not allowed:
        advice = (
            "for a steadier scan: rtprio and memlock in /etc/security/limits.d, or CAP_SYS_NICE (systemd: LimitRTPRIO)"
        )
        return DoctorCheck("real time", HostVerdict.NOTE, found, advice)
    return DoctorCheck("real time", HostVerdict.OK, found)


def _files() -> DoctorCheck:
    """Check the hard limit of open files, up to which a process that serves many devices raises its own limit."""
    hard = here.most_open_files()
    if hard is None:
        return DoctorCheck("open files", HostVerdict.OK, "no limit")
    if hard < MIN_OPEN_FILES:
        return DoctorCheck(
            "open files", HostVerdict.NOTE, f"limit {hard}", f"ulimit -Hn {MIN_OPEN_FILES} for many devices"
        )
    return DoctorCheck("open files", HostVerdict.OK, f"limit {hard}")


def _watches() -> DoctorCheck:
    return watches_verdict(here.kernel_number("fs/inotify/max_user_instances"))


def _processor() -> DoctorCheck:
    return processor_verdict(here.cpu_count(), here.cgroup_quota())


def _clock() -> DoctorCheck:
    return clock_verdict(here.clock_state())


def _disk() -> DoctorCheck:
    root = runtime_root()
    # Path.exists raises if a parent folder is not accessible.
    existing = next((p for p in (root, *root.parents) if os.path.exists(p)), Path("/"))
    free = shutil.disk_usage(existing).free
    found = f"{free // (1024 * 1024)} MiB free at {existing}"
    if free < MIN_FREE_BYTES:
        return DoctorCheck("disk", HostVerdict.BAD, found, "logs and stores need space")
    return DoctorCheck("disk", HostVerdict.OK, found)
