"""A modem's connection to the acoustic channel: it sends messages from the outbox registers and receives those for the inbox."""

from __future__ import annotations

from fieldtwin.emulators.wires.acoustic import AcousticMedium


class AcousticLink:
    """The link of the modem `name` to `medium`, in both directions (`packet_link.PacketSource` and `packet_link.PacketSink`).

    Each packet is sent `times` times, `every_ns` apart, because the modem gets no acknowledgements and the channel may lose any
    of these copies. `resent` counts the additional copies.
    """

    def __init__(self, medium: AcousticMedium, name: str, *, times: int = 1, every_ns: int = 0) -> None:
        self.sent = self.resent = self.delivered = 0
        self._medium = medium
        self._name = name
        self._times = times
        self._every_ns = every_ns

    def submit(self, payload: bytes, now_ns: int) -> bool:
        taken = self._medium.transmit(self._name, payload, now_ns, times=self._times, every_ns=self._every_ns)
        if taken:
            self.sent += 1
            self.resent += self._times - 1
        return taken

    def arrived(self, now_ns: int) -> bytes | None:
        payload = self._medium.take(self._name, now_ns)
        self.delivered += payload is not None
        return payload
