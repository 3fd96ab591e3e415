"""A Modbus TCP device for the tests of `fieldtwin dump`, written without any code of the project."""

from __future__ import annotations

import socketserver
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Answer = Callable[[int, int, int], list[int] | int | None]
"""Map ``(function, address, count)`` to the registers of the reply (any number), an exception code, or None for silence."""


class _Handler(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        while len(head := self.rfile.read(6)) == 6:
            transaction, _, length = struct.unpack(">HHH", head)
            body = self.rfile.read(length)
            if body[1] > 4:
                reply = bytes((body[1] | 0x80, 1))
            else:
                found = self.server.answer(body[1], *struct.unpack(">HH", body[2:6]))  # type: ignore[attr-defined]
                if found is None:
                    continue
                if isinstance(found, int):
                    reply = bytes((body[1] | 0x80, found))
                else:
                    reply = bytes((body[1], 2 * len(found))) + struct.pack(f">{len(found)}H", *found)
            self.wfile.write(struct.pack(">HHHB", transaction, 0, len(reply) + 1, body[0]) + reply)


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    allow_reuse_address = True


@contextmanager
def device(answer: Answer) -> Iterator[str]:
    """Serve on loopback; yields the endpoint."""
    with _Server(("127.0.0.1", 0), _Handler) as server:
        server.answer = answer  # type: ignore[attr-defined]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()
