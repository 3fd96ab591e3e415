"""The messages between a simulation and the child process that runs its FMU: length-prefixed MessagePack on two pipes."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable

import msgspec

MAX_BYTES = 1 << 20
"""The largest message, in bytes. A step of the largest number of outputs takes 9 kB."""
_LENGTH = struct.Struct("<I")


class FmuScalar(msgspec.Struct, frozen=True):
    """A scalar variable of an FMU: its value reference, and the suffix of the FMI functions that set and get it
    (``Real``, ``Float64``, ``Boolean`` ...).
    """

    reference: int
    suffix: str


class FmuLoad(msgspec.Struct, frozen=True):
    """The first message to the child process: the unpacked FMU in `folder`, and the variables that are used.

    `start` are the values that are set before the initialization; the simulation then begins at 0 s.
    """

    folder: str
    fmi: int
    identifier: str
    token: str
    instance: str
    start: list[tuple[FmuScalar, float]]
    inputs: list[FmuScalar]
    outputs: list[FmuScalar]


class FmuStep(msgspec.Struct, frozen=True):
    """A step from `t_s` to `t_s` + `step_s` with these values of the inputs. With a step of 0 s only the outputs are read."""

    t_s: float
    step_s: float
    inputs: list[float]


class FmuAnswer(msgspec.Struct, frozen=True):
    """The values of the outputs after a step, or the reason why there are none."""

    outputs: list[float] = []
    error: str = ""


def send(to: int, message: FmuLoad | FmuStep | FmuAnswer) -> None:
    """Write a message to the file descriptor `to`. Raises `OSError` if the other process has ended."""
    data = msgspec.msgpack.encode(message)
    data = _LENGTH.pack(len(data)) + data
    while data:
        data = data[os.write(to, data) :]


def receive(read: Callable[[int], bytes]) -> bytes:
    """Return the next message, undecoded. ``read(n)`` returns 1 to `n` bytes.

    Returns no bytes if the other process has ended, or sends no messages.
    """
    (length,) = _LENGTH.unpack(_exactly(read, _LENGTH.size) or bytes(_LENGTH.size))
    return _exactly(read, length) if length <= MAX_BYTES else b""


def _exactly(read: Callable[[int], bytes], count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = read(count - len(data))
        if not part:
            return b""
        data += part
    return data
