"""Open a serial port. This is the only file of the gateway that imports ``serial``.

pyserial finds, locks and configures the port: it knows the baud rates and peculiarities of each system, including the
COM ports of Windows. `line` and `threads` transfer the bytes.
"""

from __future__ import annotations

import asyncio
import errno
import os
import stat
from types import ModuleType

import serial
from serial.tools import list_ports

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable, UsageError

grp: ModuleType | None
_REFUSED: tuple[type[Exception], ...] = (ValueError,)
try:
    import grp
    import termios

    _REFUSED = (ValueError, termios.error)
except ImportError:  # Windows
    grp = None

Port = serial.Serial

CHUNK = 4096
"""The largest number of bytes taken in one read: the size of the kernel's own buffer of a tty."""

_BUSY = (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK)
_ABSENT = (errno.ENOENT, errno.ENXIO, errno.ENODEV)


def open_port(endpoint: Endpoint, read_s: float = 0.0, write_s: float = 0.0) -> Port:
    """Open, lock and configure the port. Its reads and writes wait at most `read_s` and `write_s` seconds; 0: they do not wait.

    Raises the errors of `SerialConnection.open`. This may take seconds: call it in a thread.
    """
    settings = endpoint.serial
    try:
        port = Port(
            port=endpoint.path,
            baudrate=settings.baudrate,
            bytesize=settings.data_bits,
            parity="N" if is_pty(endpoint.path) else settings.parity,
            stopbits=settings.stop_bits,
            timeout=read_s,
            write_timeout=write_s,
            # With a timeout of 0 pyserial sets VMIN 1: reading an empty port gives EAGAIN, and b"" only means that the port
            # hung up.
            inter_byte_timeout=None if read_s else 0.0,
            exclusive=True,
        )
        if endpoint.rs485:
            _set_rs485(port, endpoint)
        return port
    except serial.SerialException as e:
        raise _cannot_open(endpoint, e.errno or 0, str(e)) from e
    except _REFUSED as e:
        raise UsageError(
            "the port refuses these settings",
            got=f"{settings.baudrate} baud, {settings.frame}",
            where=str(endpoint),
            hint=str(e),
        ) from e
    except OSError as e:
        raise _cannot_open(endpoint, e.errno or 0, str(e)) from e


def is_pty(path: str) -> bool:
    """Return whether the port is a pty, also through a symbolic link. A pty drops parity silently.

    glibc reports the lost parity as an error if no other setting changes, so setting 8E1 a second time fails.
    """
    return os.path.realpath(path).startswith("/dev/pts/")


def _set_rs485(port: Port, endpoint: Endpoint) -> None:
    try:
        from fieldtwin.gateway.connections.serial.rs485 import let_driver_switch

        let_driver_switch(int(port.fileno()))
    except (OSError, ImportError, AttributeError) as e:  # a system without descriptors of ports
        port.close()
        raise UsageError(
            "the port has no RS485 mode",
            expected="a driver that switches the direction (ioctl TIOCSRS485)",
            got=getattr(e, "strerror", None) or str(e),
            where=str(endpoint),
            hint="remove rs485=1 if the adapter switches the direction by itself",
        ) from e


def close_unwanted(opening: asyncio.Future[Port]) -> None:
    """Close the port that `opening` has opened although the caller was cancelled meanwhile."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()


def _cannot_open(endpoint: Endpoint, number: int, text: str) -> Unreachable:
    where = str(endpoint)
    if number in _BUSY:
        return EndpointBusy(
            "the port is held by another program", where=where, hint=f"find it with: fuser {endpoint.path}"
        )
    if number in _ABSENT:
        return Unreachable("there is no such serial port", where=where, hint=_ports_hint())
    if number in (errno.EACCES, errno.EPERM):
        return Unreachable("no permission for the port", where=where, hint=_group_hint(endpoint.path))
    if number == errno.ENOTTY or "Could not configure port" in text:  # this error of pyserial has no number
        return Unreachable("this is not a serial port", where=where, hint=_ports_hint())
    return Unreachable(f"cannot open the port: {os.strerror(number) if number else text}", where=where)


def lost(endpoint: Endpoint, why: str) -> ConnectionLost:
    """Return the error for a port that is gone."""
    return ConnectionLost(f"the serial port is gone: {why}", where=str(endpoint))


def local_ports() -> list[str]:
    """Return the names of the serial ports that this computer has now."""
    return sorted(port.device for port in list_ports.comports())


def _ports_hint() -> str:
    names = local_ports()
    return f"ports here: {', '.join(names[:8])}" if names else "this computer has no serial port"


def _group_hint(path: str) -> str:
    """Return a hint with the group that owns the port's device file: dialout on Debian, uucp on other systems."""
    if grp is None:
        return ""
    try:
        info = os.stat(path)
        group = grp.getgrgid(info.st_gid).gr_name
    except (OSError, KeyError):
        return ""
    if not info.st_mode & stat.S_IWGRP or group == "root":
        return f"only its owner may use {path}"
    return f"join its group and log in again: sudo usermod -aG {group} $USER"
