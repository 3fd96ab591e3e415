"""Notify systemd: READY, WATCHDOG, RELOADING, STOPPING and a status line, as datagrams (sd_notify(3)).

No library is needed: the messages are text lines to the Unix datagram socket in NOTIFY_SOCKET. A datagram that cannot be
delivered is counted and dropped: a service must not fail because its notifications are not received.
"""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress

USEC_PER_S = 1_000_000


class Notifier:
    """The sender of notifications to systemd. `watchdog_s` is the watchdog timeout of the systemd unit in seconds, 0 for none.
    Without a socket nothing is sent."""

    def __init__(self, address: str = "", watchdog_s: float = 0.0) -> None:
        self.watchdog_s = watchdog_s
        self.lost = 0
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str] = os.environ) -> Notifier:
        """Read systemd's environment variables and remove them, so that child processes do not notify in the name of this
        process.
        """
        address = environment.pop("NOTIFY_SOCKET", "")
        interval = environment.pop("WATCHDOG_USEC", "")
        meant_for = environment.pop("WATCHDOG_PID", "")
        ours = not meant_for or meant_for == str(os.getpid())
        watchdog_s = int(interval) / USEC_PER_S if ours and interval.isascii() and interval.isdigit() else 0.0
        return cls(address if address[:1] in ("/", "@") else "", watchdog_s)

    @property
    def wanted(self) -> bool:
        """Return whether systemd gave a socket."""
        return self._socket is not None

    def ready(self, status: str) -> None:
        """Notify systemd that the start or a reload is complete (READY=1)."""
        self._send("READY=1", _status(status))

    def alive(self, status: str) -> None:
        """Tell systemd's watchdog that the service is alive (WATCHDOG=1)."""
        self._send("WATCHDOG=1", _status(status))

    def status(self, status: str) -> None:
        """Send a line for `systemctl status`."""
        self._send(_status(status))

    def reloading(self, now_ns: int) -> None:
        """Notify that a reload began at `now_ns` of CLOCK_MONOTONIC, which Type=notify-reload requires; `ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={now_ns // 1000}")

    def stopping(self) -> None:
        """Notify that an orderly shutdown has begun."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket; nothing more is sent."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            self.lost += 1


def _status(text: str) -> str:
    """Return the text as one line."""
    return "STATUS=" + " ".join(text.split())[:512]
