"""The acceptance filter of a node's CAN controller, which every real controller has in hardware.

On a bus with a hundred nodes, almost all frames concern other nodes. The filter must never reject a frame that the node
would act on. It passes all identifiers in the communication objects, including those on which the node sends (a second
sender there is an error), and all extended and error frames.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.service import Core
from fieldtwin.emulators.canopen.sync import DEFAULT_COB_ID
from fieldtwin.gateway.core.canframe import CanFrame

NMT, LSS = 0x000, 0x7E5
SDO_RESPONSE, SDO_REQUEST, ERROR_CONTROL = 0x580, 0x600, 0x700
_SINGLE = (0x1005, 0x1012, 0x1014)
_SDO_SERVERS, _PDOS = range(0x1200, 0x1280), (range(0x1400, 0x1600), range(0x1800, 0x1A00))
_CONSUMER_HEARTBEAT = 0x1016


class Acceptance:
    """The filter: a callable that takes a frame and returns whether the node receives it.

    It follows changes of communication objects and of the node ID.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._version = -1
        self._ids: frozenset[int] = frozenset()

    def __call__(self, frame: CanFrame) -> bool:
        if self._version != self._core.data.version:
            self._version = self._core.data.version
            self._ids = self._identifiers()
        return frame.can_id in self._ids or frame.extended or frame.error

    def _identifiers(self) -> frozenset[int]:
        data, node_id = self._core.data, self._core.node_id
        ids = {NMT, LSS, *(base + node_id for base in (SDO_RESPONSE, SDO_REQUEST, ERROR_CONTROL))}
        if not data.has(0x1005):
            ids.add(DEFAULT_COB_ID)
        for index, found in data.dictionary.objects.items():
            if index in _SINGLE:
                ids.add(data.number(index) & 0x7FF)
            elif index in _SDO_SERVERS:
                ids |= {data.number(index, sub) & 0x7FF for sub in (1, 2)}
            elif any(index in pdos for pdos in _PDOS):
                ids.add(data.number(index, 1) & 0x7FF)
            elif index == _CONSUMER_HEARTBEAT:
                ids |= {ERROR_CONTROL + (data.number(index, sub) >> 16 & 0x7F) for sub in found.entries if sub}
        return frozenset(ids)
