"""RS485 direction control by the kernel (Linux: ioctl TIOCSRS485, Documentation/driver-api/serial/serial-rs485.rst).

The driver raises RTS, which opens the transmitter, before the first character and drops it after the last one: a
program outside the kernel cannot do that in time. This module only packs the settings and calls one ioctl; it must not depend on
the use of the port.
"""

from __future__ import annotations

import errno
import struct

TIOCGRS485, TIOCSRS485 = 0x542E, 0x542F

ENABLED = 1 << 0
RTS_ON_SEND = 1 << 1
RTS_AFTER_SEND = 1 << 2

_SERIAL_RS485 = struct.Struct("=8I")  # flags, delay before and after sending in ms, reserved
_NO_SUCH_REQUEST = errno.ENOTTY


def settings_sent(driver: bytes) -> bytes:
    """Return the struct serial_rs485 to set, based on the driver's present one: RTS is high while sending and low otherwise.

    Delays, termination and other settings of the board from the driver or the device tree are not changed.
    """
    flags, *rest = _SERIAL_RS485.unpack(driver)
    return _SERIAL_RS485.pack((flags | ENABLED | RTS_ON_SEND) & ~RTS_AFTER_SEND, *rest)


def let_driver_switch(fd: int) -> None:
    """Turn RS485 mode on.

    Raises `OSError`: ENOTTY if the port ignores the setting or has no such mode; ptys and most USB adapters have none.
    """
    import fcntl  # not on Windows, which has no such request

    driver = fcntl.ioctl(fd, TIOCGRS485, bytes(_SERIAL_RS485.size))
    kept = fcntl.ioctl(fd, TIOCSRS485, settings_sent(driver))
    if not _SERIAL_RS485.unpack(kept)[0] & ENABLED:  # the kernel returns the settings that it applied
        raise OSError(_NO_SUCH_REQUEST, "the driver does not keep the setting")
