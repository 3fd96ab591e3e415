"""What a thread needs of a carrier: links that take frames and bring frames, and end with an error when they are lost.

A link may lose, repeat and reorder; it may not change what a frame holds. `DatagramLink` is for carriers of bytes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from fieldtwin.gateway.core.errors import Desync, Unreachable
from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import Frame, FrameCodec, Schema


class Unwelcome(Unreachable):
    """The other side is there and does not want us: our password or certificate, or what we may do. To wait is no help."""


class Link(ABC):
    """A way to the other side, until it is lost. One reader and one writer."""

    trouble = ""
    """Why nothing gets through now although the link is not lost; empty when all is well."""
    quiet = "nothing came"
    """What it means when nothing ever comes over it, for whoever waits."""
    ack_delay_ns = 0
    """How long an ACK may wait for others: one that takes a second on the way serves for many frames."""

    linger_ns = 0
    """How long events may wait for others: a frame that takes a second on the way had better be full."""

    @abstractmethod
    async def send(self, frame: Frame) -> None:
        """Hand a frame over, waiting for room. Raises `Unreachable` when the link is lost."""

    @abstractmethod
    async def receive(self) -> Frame:
        """The next frame. Raises `Unreachable` when the link is lost. What is no frame is counted and left out."""

    @abstractmethod
    def fit(self, tag: bytes, events: Sequence[Event]) -> int:
        """How many of these events go into one frame; at least one."""

    @abstractmethod
    def knows(self, schema: bytes) -> bool:
        """Whether events of this schema can be read here."""

    @abstractmethod
    async def aclose(self) -> None:
        """Give the link up."""


class Carrier(ABC):
    """Opens links, one at a time."""

    name: str

    @abstractmethod
    async def open(self) -> Link:
        """A link to the other side, waiting for it where it is the one who comes. Raises `Unreachable`."""

    async def aclose(self) -> None:
        """Open no more."""
        return


class DatagramLink(Link):
    """A link that carries datagrams of at most `mtu` bytes."""

    def __init__(self, schemas: Sequence[Schema], mtu: int) -> None:
        self._codec = FrameCodec(schemas, mtu)
        self.garbled = 0
        self.bytes_sent = 0

    @abstractmethod
    async def send_datagram(self, data: bytes) -> None:
        """As `send`."""

    @abstractmethod
    async def receive_datagram(self) -> bytes:
        """As `receive`."""

    async def send(self, frame: Frame) -> None:
        for datagram in self._codec.encode(frame):
            self.bytes_sent += len(datagram)
            await self.send_datagram(datagram)

    async def receive(self) -> Frame:
        while True:
            try:
                frame = self._codec.decode(await self.receive_datagram())
            except Desync:
                self.garbled += 1
                continue
            if frame is not None:
                return frame

    def fit(self, tag: bytes, events: Sequence[Event]) -> int:
        return self._codec.fit(tag, events)

    def knows(self, schema: bytes) -> bool:
        return self._codec.knows(schema)
