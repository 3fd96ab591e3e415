"""The interface between a thread and its carrier: links that send and receive frames, and raise an error when they are
lost.

A link may lose, repeat and reorder frames; it must not change their contents. `DatagramLink` is for carriers of bytes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from fieldtwin.gateway.core.errors import Desync, Unreachable
from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import Frame, FrameCodec, Schema


class Unwelcome(Unreachable):
    """The other side refuses this one, because of its password, certificate or permissions. A later attempt would be refused
    too.
    """


class Link(ABC):
    """A connection to the other side, until it is lost. It has one reader and one writer."""

    trouble = ""
    """The reason why no frames are exchanged now although the link is not lost; empty if there is no problem."""
    quiet = "nothing came"
    """The explanation that the user gets if nothing is ever received over this link."""
    ack_delay_ns = 0
    """The time (ns) by which an ACK may be delayed. On a link with seconds of latency, one ACK serves for many frames."""

    linger_ns = 0
    """The time (ns) that events may wait for further events that fill the frame. On a link with seconds of latency, frames
    should be full.
    """

    @abstractmethod
    async def send(self, frame: Frame) -> None:
        """Send a frame, waiting for room. Raises `Unreachable` if the link is lost."""

    @abstractmethod
    async def receive(self) -> Frame:
        """Return the next frame. Raises `Unreachable` if the link is lost. Invalid frames are counted and skipped."""

    @abstractmethod
    def fit(self, tag: bytes, events: Sequence[Event]) -> int:
        """Return how many of these events go into one frame; at least one."""

    @abstractmethod
    def knows(self, schema: bytes) -> bool:
        """Return whether events of this schema can be decoded."""

    @abstractmethod
    async def aclose(self) -> None:
        """Close the link."""


class Carrier(ABC):
    """The factory of links to the other side. Only one link is open at a time."""

    name: str

    @abstractmethod
    async def open(self) -> Link:
        """Return a link to the other side. A listening side waits for it. Raises `Unreachable`."""

    async def aclose(self) -> None:
        """Close the carrier: it opens no more links."""
        return


class DatagramLink(Link):
    """A link that carries datagrams of at most `mtu` bytes."""

    def __init__(self, schemas: Sequence[Schema], mtu: int) -> None:
        self._codec = FrameCodec(schemas, mtu)
        self.garbled = 0
        self.bytes_sent = 0

    @abstractmethod
    async def send_datagram(self, data: bytes) -> None:
        """Send one datagram. Waits and raises like `send`."""

    @abstractmethod
    async def receive_datagram(self) -> bytes:
        """Return the next datagram. Raises like `receive`."""

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
