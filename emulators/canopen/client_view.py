"""The object dictionary as an SDO client sees it. Generic rules apply first, then those of the object's service.

This module must not depend on SDO frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.canopen.pdo.tpdo import Tpdos
from fieldtwin.emulators.canopen.service import Core, NodeService


class ClientView:
    """An `ObjectAccess` to the live values. `refusals` are objects that the device refuses for device-specific reasons."""

    def __init__(
        self, core: Core, services: Iterable[NodeService], tpdos: Tpdos, refusals: Mapping[Key, Abort] | None = None
    ) -> None:
        self._core = core
        self._services = tuple(services)
        self._tpdos = tpdos
        self._refusals = dict(refusals or {})

    def add(self, service: NodeService) -> None:
        """Add the service of the SDO servers, which are created after this view because they use it."""
        self._services += (service,)

    def read(self, index: int, subindex: int, now_ns: int) -> bytes:
        self._check_refusal((index, subindex))  # first: a recorded device may refuse an object that no data sheet has
        entry = self._core.data.find(index, subindex)
        if not entry.readable:
            raise abort(index, subindex, Abort.WRITE_ONLY)
        for service in self._owners(index):
            service.check_read(index, subindex)
        self._core.answer(entry.key, now_ns)
        if self._core.given is not None:
            self._core.given((entry.key,), now_ns)
        return self._core.data.get(index, subindex)

    def begin_write(self, index: int, subindex: int, size: int | None) -> int | None:
        entry = self._core.data.find(index, subindex)
        if not entry.writable:
            raise abort(index, subindex, Abort.READ_ONLY)
        self._check_refusal(entry.key)
        if size is not None:
            self._core.data.check_size(entry, size)
        return entry.size

    def write(self, index: int, subindex: int, raw: bytes, now_ns: int) -> None:
        entry = self._core.data.find(index, subindex)
        self._core.data.check_value(entry, raw)
        owners = self._owners(index)
        for service in owners:
            service.check_write(index, subindex, raw)
        changed = self._core.data.put(index, subindex, raw)
        self._core.note(now_ns, "write", index, subindex, raw)
        for service in owners:
            service.wrote(index, subindex, now_ns)
        if changed:
            self._tpdos.changed([entry.key], now_ns)

    def _check_refusal(self, key: Key) -> None:
        if key in self._refusals:
            raise abort(*key, self._refusals[key])

    def _owners(self, index: int) -> list[NodeService]:
        return [service for service in self._services if service.owns(index)]
