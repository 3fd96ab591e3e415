"""The process image: the data that gateway and PLC share, laid out in memory that the caller provides.

There are normally two regions: `INPUTS`, written by the gateway, and `OUTPUTS`, written by the PLC. Each publication carries a
counter and a time, which show the other process that the writer is alive. Both processes compare a hash of the layout. This
module has no mmap, no file and no clock: the caller provides the memory and the time.

Messages (the contents of a modem's mailbox) go through ring buffers, one for each message tag of a region. The *other* region
holds the sequence of the last message that has been handled: the gateway publishes ``<tag>.taken`` for every message tag of
OUTPUTS, the PLC ``<tag>.consumed`` for every message tag of INPUTS. So neither process overwrites messages that were not handled,
and a mailbox is acknowledged only up to the messages that were consumed.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.layout import LINE, RegionLayout, RegionShape, TagKind, TagSpec, message_tag
from fieldtwin.gateway.core.image.region import Heartbeat, NotEncodable, RegionReader, RegionWriter
from fieldtwin.gateway.core.image.snapshot import Message, RegionFlag, Snapshot

__all__ = [
    "INPUTS",
    "OUTPUTS",
    "Image",
    "ImageLayout",
    "Message",
    "NotEncodable",
    "RegionFlag",
    "RegionLayout",
    "RegionReader",
    "RegionShape",
    "RegionWriter",
    "Snapshot",
    "TagKind",
    "TagSpec",
    "consumed_name",
    "message_tag",
    "process_image",
    "taken_name",
]

INPUTS = "inputs"
OUTPUTS = "outputs"
FORMAT = 1
_HEADER = struct.Struct("<8sI4x32s")
_MAGIC = b"ftimage\0"


def taken_name(tag: str) -> str:
    """Return the INT tag of INPUTS that holds the sequence of the last message of output `tag` that the gateway took."""
    return f"{tag}.taken"


def consumed_name(tag: str) -> str:
    """Return the INT tag of OUTPUTS that holds the sequence of the last message of input `tag` that the PLC consumed."""
    return f"{tag}.consumed"


@dataclass(frozen=True, slots=True)
class ImageLayout:
    """The regions of an image, in order."""

    regions: tuple[RegionLayout, ...]

    def __post_init__(self) -> None:
        names = [region.name for region in self.regions]
        if len(set(names)) != len(names):
            raise FileInvalid("two regions of a process image have the same name", got=", ".join(names))

    @property
    def size(self) -> int:
        """Return the number of bytes of memory that the image needs."""
        return LINE + sum(RegionShape(region).size for region in self.regions)

    @property
    def digest(self) -> bytes:
        """Return 32 bytes that differ between layouts, even if only names of tags or units differ.

        The names of values do not count: a reload changes them while both processes keep the image.
        """
        layout = self.describe()
        for region in layout["regions"]:
            for tag in region["tags"]:
                tag.pop("value_names", None)
        text = json.dumps([FORMAT, layout], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).digest()

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able description; the inverse of `from_description`."""
        return {"regions": [region.describe() for region in self.regions]}

    @classmethod
    def from_description(cls, text: Mapping[str, Any]) -> ImageLayout:
        """Return the layout that `describe` described. Raises `FileInvalid` if the description is invalid."""
        try:
            return cls(tuple(RegionLayout.from_description(region) for region in text["regions"]))
        except (KeyError, TypeError) as e:
            raise FileInvalid("not the description of a process image", expected="regions") from e

    def format(self, memory: memoryview) -> None:
        """Make an empty image in `memory` (writable bytes, at least `size` of them). Call it once, when the memory is
        created.
        """
        self._check_size(memory)
        memory[: self.size] = bytes(self.size)
        memory[: _HEADER.size] = _HEADER.pack(_MAGIC, FORMAT, self.digest)

    def attach(self, memory: memoryview, *, private: bool = False) -> Image:
        """Use the image in `memory`. Raises `FileInvalid` if it holds no image, or one with a different layout.

        `private`: no other `Image` uses this memory, so that a publication may stay outside of it (`Heartbeat`).
        """
        self._check_size(memory)
        magic, version, digest = _HEADER.unpack_from(memory)
        if magic != _MAGIC or version != FORMAT:
            raise FileInvalid("not a process image", expected=f"format {FORMAT}", got=f"{magic!r}, format {version}")
        if digest != self.digest:
            raise FileInvalid(
                "the process image has a different layout",
                expected=self.digest.hex()[:16],
                got=digest.hex()[:16],
                hint="gateway and PLC were started from different system files",
            )
        return Image(self, memory, private=private)

    def _check_size(self, memory: memoryview) -> None:
        if memory.nbytes < self.size:
            raise FileInvalid(
                "memory too small for the process image", expected=f"{self.size} bytes", got=f"{memory.nbytes}"
            )


class Image:
    """An attached image, which provides writers and readers. `release` (or leaving ``with``) gives the memory back."""

    def __init__(self, layout: ImageLayout, memory: memoryview, *, private: bool = False) -> None:
        self.layout = layout
        self._heartbeats = {region.name: Heartbeat() for region in layout.regions} if private else {}
        self._given: list[RegionWriter | RegionReader] = []
        self._regions: dict[str, tuple[RegionShape, memoryview]] = {}
        offset = LINE
        for region in layout.regions:
            shape = RegionShape(region)
            view = memory[offset : offset + shape.size]
            self._regions[region.name] = shape, view
            offset += shape.size

    def writer(self, region: str) -> RegionWriter:
        """Return the region's writer. The caller guarantees that a region has only one writer in the whole system."""
        shape, view = self._region(region)
        writer = RegionWriter(view, shape, self._heartbeats.get(region))
        self._given.append(writer)
        return writer

    def reader(self, region: str) -> RegionReader:
        """Return a new reader of the region."""
        shape, view = self._region(region)
        reader = RegionReader(view, shape, self._heartbeats.get(region))
        self._given.append(reader)
        return reader

    def _region(self, name: str) -> tuple[RegionShape, memoryview]:
        if name not in self._regions:
            raise FileInvalid(f"no region {name!r} in the process image", expected=", ".join(self._regions))
        return self._regions[name]

    def release(self) -> None:
        """Release the memory, including that of all writers and readers. A second call does nothing."""
        for part in self._given:
            part.release()
        self._given.clear()
        for _, view in self._regions.values():
            view.release()
        self._regions.clear()

    def __enter__(self) -> Image:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.release()


def process_image(inputs: Sequence[TagSpec], outputs: Sequence[TagSpec]) -> ImageLayout:
    """Return the layout that gateway and PLC share.

    INPUTS gets a `taken` tag for each message of OUTPUTS, and OUTPUTS a `consumed` tag for each message of INPUTS.
    """
    taken = [TagSpec(taken_name(t.name), TagKind.INT) for t in outputs if t.kind is TagKind.MESSAGE]
    consumed = [TagSpec(consumed_name(t.name), TagKind.INT) for t in inputs if t.kind is TagKind.MESSAGE]
    return ImageLayout((RegionLayout(INPUTS, (*inputs, *taken)), RegionLayout(OUTPUTS, (*outputs, *consumed))))
