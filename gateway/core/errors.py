"""The error classes. An error names the part to correct, the expected and the received value, the place, and the remedy.

Every error that fieldtwin raises to its callers is a `FieldtwinError`. Exceptions of the operating system and of libraries
(``OSError``, pymodbus, python-can) are translated once, where they arise; the calling code does not catch them. A value of
bad quality is data and never an error (paper.md, ruling 11): these classes state why a value is missing.

The class decides the exit code of the command line (docs/explanation/design.md, "Command line contract").
"""

from __future__ import annotations

import errno
import os
import re
from enum import Enum
from typing import ClassVar

from fieldtwin.gateway.core.escaping import escape_controls


class Blame(Enum):
    """The part of the system in which the cause of the error has to be removed."""

    USER = "the command line"
    FILE = "the file"
    WIRE = "the bus or link"
    DEVICE = "the device"
    HOST = "this computer"
    FIELDTWIN = "fieldtwin itself"


class FieldtwinError(Exception):
    """The base class of all errors of fieldtwin.

    `str()` is one line that is safe to print, even if a file or a device supplied control characters; the parts are not
    changed.

    `expected`, `got`, `where` and `hint` are plain text, empty if they do not apply. `where` names bus, unit ID,
    address, file and line: everything that locates the error.
    """

    exit_code: ClassVar[int] = 70
    blame: ClassVar[Blame] = Blame.FIELDTWIN

    def __init__(self, message: str, *, expected: str = "", got: str = "", where: str = "", hint: str = "") -> None:
        self.message = message
        self.expected = expected
        self.got = got
        self.where = where
        self.hint = hint
        super().__init__(message)

    def __str__(self) -> str:
        text = f"{self.where}: {self.message}" if self.where else self.message
        if self.expected:
            text += f"; expected {self.expected}"
        if self.got:
            text += f"; got {self.got}"
        return escape_controls(f"{text} ({self.hint})" if self.hint else text)

    def at(self, where: str) -> FieldtwinError:
        """Put `where` in front of the location that this error already names, and return this error, for ``raise e.at(...)``."""
        self.where = f"{where}: {self.where}" if self.where else where
        return self


# -- errors of fieldtwin and of the user -------------------------------------------------------------------------------


class CheckFailed(FieldtwinError):
    """A check ran and failed."""

    exit_code = 1
    blame = Blame.DEVICE


class UsageError(FieldtwinError):
    """The request makes no sense or is not permitted."""

    exit_code = 2
    blame = Blame.USER


class NotAllowed(UsageError):
    """The request is well formed, but the configuration forbids it (read-only plant, unmarked tag, limits, rate)."""


class OutOfLimits(NotAllowed):
    """A value may not be written, because it is outside the limits of its tag, or because its type cannot hold it."""


class FileInvalid(FieldtwinError):
    """A file that a user wrote or recorded cannot be used as it is.

    `line` and `column` count from 1; they are 0 if the file has none. `others` are the further errors that the same
    check found (at most `MAX_OTHERS`); the command line prints each on a separate line.
    """

    exit_code = 3
    blame = Blame.FILE
    MAX_OTHERS: ClassVar[int] = 50

    def __init__(
        self,
        message: str,
        *,
        path: str = "",
        line: int = 0,
        column: int = 0,
        expected: str = "",
        got: str = "",
        hint: str = "",
        others: tuple[FileInvalid, ...] = (),
    ) -> None:
        self.path = path
        self.line = line
        self.column = column
        self.others = others[: self.MAX_OTHERS]
        where = path
        if line:
            where += f":{line}" + (f":{column}" if column else "")
        super().__init__(message, expected=expected, got=got, where=where, hint=hint)

    def as_data(self) -> dict[str, str | int]:
        """Return the error as data for JSON, without `others`."""
        return {
            "path": self.path,
            "line": self.line,
            "column": self.column,
            "message": self.message,
            "expected": self.expected,
            "got": self.got,
            "hint": self.hint,
        }


class CommandListMismatch(FileInvalid):
    """The command lists of a driver and its device differ (the paper's Communication, paper.md, ruling 12)."""


class Bug(FieldtwinError):
    """An internal invariant of fieldtwin is broken."""


# -- the bus or link ---------------------------------------------------------------------------------------------------


class Unreachable(FieldtwinError):
    """An endpoint cannot be opened, or was lost. Retrying later is sensible."""

    exit_code = 4
    blame = Blame.WIRE


class EndpointBusy(Unreachable):
    """The port, socket or bus exists, but another process uses it."""

    blame = Blame.HOST


class ConnectionLost(Unreachable):
    """An open connection ended: the peer closed it or disappeared, a cable was pulled, or the CAN controller is bus-off."""


class WireError(FieldtwinError):
    """The received data violates the protocol. The request may be repeated."""

    exit_code = 4
    blame = Blame.WIRE


class ReplyTimeout(WireError):
    """No frame that could be the reply arrived in time."""


class CrcError(WireError):
    """A complete reply arrived, but its check sum is wrong."""


class Desync(WireError):
    """A frame arrived that does not answer the request: its unit ID, function, size, transaction or index is different."""


class WrongSize(Desync):
    """A complete reply to this function arrived, but it carries `got_bytes` bytes of values instead of the number requested."""

    def __init__(self, message: str, *, expected: str = "", got: str = "", hint: str = "", got_bytes: int = 0) -> None:
        self.got_bytes = got_bytes
        super().__init__(message, expected=expected, got=got, hint=hint)


# -- the device --------------------------------------------------------------------------------------------------


class DeviceRefused(FieldtwinError):
    """The device understood the request and refused it."""

    exit_code = 5
    blame = Blame.DEVICE


class ModbusExceptionReply(DeviceRefused):
    """A Modbus exception response: `function` as requested, `code` as received (raw, vendor codes included)."""

    NAMES: ClassVar[dict[int, str]] = {
        1: "illegal function",
        2: "illegal data address",
        3: "illegal data value",
        4: "server device failure",
        5: "acknowledge",
        6: "server device busy",
        8: "memory parity error",
        10: "gateway path unavailable",
        11: "gateway target device failed to respond",
    }

    def __init__(self, function: int, code: int, *, where: str = "") -> None:
        self.function = function
        self.code = code
        name = self.NAMES.get(code, "vendor specific")
        super().__init__(f"function {function:02X}h refused with exception {code:02X}h ({name})", where=where)


class SdoAborted(DeviceRefused):
    """The node aborted an SDO transfer. `code` is the 32-bit abort code of CiA 301, 7.2.4.3.17."""

    def __init__(self, index: int, subindex: int, code: int, meaning: str = "", *, where: str = "") -> None:
        self.index = index
        self.subindex = subindex
        self.code = code
        text = f"SDO {index:04X}h:{subindex:02X} aborted with {code:08X}h"
        super().__init__(text + (f" ({meaning})" if meaning else ""), where=where)


class UnknownCommand(DeviceRefused):
    """A command that is not in the device's command list (the paper's Device)."""


class VerifyFailed(DeviceRefused):
    """The device acknowledged a write but holds another value."""


class WrongDevice(DeviceRefused):
    """The device that answers is not the one that the system file expects; writes to it are blocked."""


# -- error texts of the operating system -------------------------------------------------------------------------------

_NUMBER = re.compile(r"\[Errno (\d+)\]")
_UNINFORMATIVE = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT)
"""Errors for ::1, to which ``localhost`` also resolves, on a host without IPv6. They do not explain a failure."""


def os_reason(error: OSError) -> str:
    """Return the operating system's reason as one phrase, without addresses and numbers.

    asyncio tries each address of a name and lists all failures in one text. This function picks the failure of an address to
    which a connection was actually attempted.
    """
    numbers = [error.errno] if error.errno is not None else [int(n) for n in _NUMBER.findall(str(error))]
    if not numbers or numbers[0] < 0:  # getaddrinfo has negative error numbers and its own texts
        silent = "no answer" if isinstance(error, TimeoutError) else type(error).__name__
        return error.strerror or str(error) or silent
    telling = [n for n in numbers if n not in _UNINFORMATIVE]
    if errno.ECONNREFUSED in telling:
        return os.strerror(errno.ECONNREFUSED)
    return os.strerror((telling or numbers)[0])
