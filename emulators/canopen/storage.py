"""Store parameters (1010h) and restore default parameters (1011h): CiA 301 v4.2, 7.5.2.13 and 14.

Stored values last as long as the emulated node. Restored defaults take effect at the next reset.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.node_data import ParameterGroup
from fieldtwin.emulators.canopen.service import Core, NodeService

STORE, RESTORE = 0x1010, 0x1011
_SIGNATURES = {STORE: b"save", RESTORE: b"load"}
_ON_COMMAND = 1
"""The value that a client reads: the device stores parameters on command, not autonomously."""


class Storage(NodeService):
    """The service of 1010h and 1011h.

    It accepts only the signatures ``save`` and ``load``; reads return the supported functions.
    """

    def __init__(self, core: Core) -> None:
        self._core = core

    def owns(self, index: int) -> bool:
        return index in _SIGNATURES

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        if raw != _SIGNATURES[index] or subindex not in {int(group) for group in ParameterGroup}:
            raise abort(index, subindex, Abort.NOT_STORED)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        self._announce()  # a read returns the supported functions, not the signature
        if index == STORE:
            self._core.data.store(ParameterGroup(subindex))
        else:
            self._core.data.forget(ParameterGroup(subindex))

    def reset(self, now_ns: int) -> None:
        self._announce()

    def _announce(self) -> None:
        for index in _SIGNATURES:
            for group in ParameterGroup:
                self._core.data.put_number(index, group, _ON_COMMAND)
