"""The answer to a client that sent a broadcast through a bridge, for clients that expect an answer to every request.

Units on a serial line do not answer a broadcast (SL 2.1), so the answer only shows that it was sent. This module does no I/O.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal
from fieldtwin.gateway.protocols.modbus.server.analysis import NO_PATH, exception_pdu

_REPEATED = {0x05: 5, 0x06: 5, 0x0F: 5, 0x10: 5, 0x16: 7}
"""By function code: the number of bytes of the request that the normal reply repeats (AP 6); for 15h all of them."""


def when_all_are_out(pdu: bytes, lines: Iterable[asyncio.Future[bytes | None]]) -> asyncio.Future[bytes | None]:
    """Wait until every line has finished with `pdu`; return the normal reply if it was sent on a line, else exception 0A.

    `lines` hold the result of each line: an exception response if the broadcast was not sent.
    """
    answer: asyncio.Future[bytes | None] = asyncio.get_running_loop().create_future()
    open_ones = list(lines)
    went_out = False

    def ended(line: asyncio.Future[bytes | None]) -> None:
        nonlocal went_out
        open_ones.remove(line)
        went_out = went_out or not line.result()
        if not open_ones and not answer.done():
            answer.set_result(result())

    def result() -> bytes:
        return pdu[: _REPEATED.get(pdu[0], len(pdu))] if went_out else exception_pdu(refusal(pdu[0], NO_PATH))

    if not open_ones:
        answer.set_result(result())
    for line in tuple(open_ones):
        line.add_done_callback(ended)
    return answer
