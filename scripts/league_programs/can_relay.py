"""Join a program to a software CAN bus of fieldtwin: ``can_relay.py CHANNEL PROGRAM ARGUMENT...``.

The program runs in its own environment without fieldtwin and speaks lines on a TCP connection, as `can_line.py` does. CHANNEL
is ``HOST:PORT`` of the bus, or ``-`` for that of ``FIELDTWIN_CHANNEL``.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading

from can_line import from_line, to_line

from fieldtwin.gateway.connections.soft_bus import SoftBus


def main() -> int:
    channel = os.environ["FIELDTWIN_CHANNEL"] if sys.argv[1] == "-" else sys.argv[1]
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        environment = {**os.environ, "FIELDTWIN_CAN_LINE": f"127.0.0.1:{port}"}
        program = subprocess.Popen(sys.argv[2:], env=environment)
        signal.signal(signal.SIGTERM, lambda *_: program.terminate())
        listener.settimeout(20)
        connection, _ = listener.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    bus = SoftBus(channel=channel)

    def to_bus() -> None:
        for line in connection.makefile("r"):
            bus.send(from_line(line))

    def to_program() -> None:
        while True:
            message = bus.recv(1.0)
            if message is not None and not message.is_error_frame:
                connection.sendall(to_line(message).encode() + b"\n")

    for relay in (to_bus, to_program):
        threading.Thread(target=relay, daemon=True).start()
    status = program.wait()
    os._exit(max(status, 0))


if __name__ == "__main__":
    main()
