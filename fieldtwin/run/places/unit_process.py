"""A process that runs the units of one campaign, one after the other.

A unit that crashes or takes too long ends this process only. A cluster's worker has threads, sockets and a clock, which a run in
virtual time excludes, and it lives longer than one version of a user's Python program.

Messages are pickles, each after its length in bytes. The process receives the work and then units, and sends an answer for each
unit. Both ends have the same version of fieldtwin, which a cluster's worker has checked.
"""

from __future__ import annotations

import os
import pickle
import struct
import sys
from typing import Any, BinaryIO

from fieldtwin.gateway.core.errors import Bug, FieldtwinError

MAX_RESULT_BYTES = 4 << 20
"""Largest size of a unit's result, in bytes. Usual results have some kilobytes."""
_LENGTH = struct.Struct(">Q")


def write_message(file: BinaryIO, data: bytes) -> None:
    """Write a message. Raises `OSError` if the other end is closed."""
    file.write(_LENGTH.pack(len(data)) + data)
    file.flush()


def read_message(file: BinaryIO) -> bytes | None:
    """Return the next message, None if the other end is closed."""
    head = file.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    data = file.read(size)
    return data if len(data) == size else None


def main(argv: list[str]) -> None:
    """Run units until the input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of a user's program must not mix with the answers
    os.chdir(argv[1])
    requests = sys.stdin.buffer
    work: Any = pickle.loads(read_message(requests) or b"")
    while (request := read_message(requests)) is not None:
        write_message(answers, _answer(work, pickle.loads(request)))


def _answer(work: Any, unit: Any) -> bytes:
    """Return the pickle of whether the unit ended, and of its result or its error."""
    try:
        answer = pickle.dumps((True, work.run(unit)))
    except FieldtwinError as e:
        answer = pickle.dumps((False, e))
    except Exception as e:
        answer = pickle.dumps((False, Bug(f"the run of seed {unit} ended with {type(e).__name__}: {e}")))
    if len(answer) <= MAX_RESULT_BYTES:
        return answer
    reason = f"its result has {len(answer)} bytes, and at most {MAX_RESULT_BYTES} are sent"
    return pickle.dumps((True, work.unfinished(unit, reason)))


if __name__ == "__main__":
    main(sys.argv)
