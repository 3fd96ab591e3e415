"""Boot a node as CiA 302-2 describes: check that it is the expected node, and that it holds the required configuration.

The procedures use a master. They use objects of the standards only, and are independent of particular devices. The caller decides
whether writing is allowed, and how to react to an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import SdoAborted
from fieldtwin.gateway.protocols.canopen.configure import (
    DEVICE_TYPE,
    IDENTITY,
    read_number,
    verify_number,
    write_number,
)
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import CONFIGURATION_DATE, Setting
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster

STORE_PARAMETERS = 0x1010
SAVE = b"save"
STORE_TIMEOUT_S = 5.0
"""Non-volatile memory is slow, so storing gets a longer timeout, in seconds."""

_U32 = DataType.UNSIGNED32


@dataclass(frozen=True, slots=True)
class ExpectedIdentity:
    """The identity that a node has to report (1F84h to 1F88h). A field that is None is not checked."""

    device_type: int | None = None
    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: int | None = None

    @property
    def objects(self) -> dict[str, tuple[int, int, int]]:
        """Return the expected fields as name -> (index, subindex, value), in the order in which CiA 302 checks them."""
        every = {
            "device_type": (DEVICE_TYPE, 0, self.device_type),
            "vendor": (IDENTITY, 1, self.vendor),
            "product": (IDENTITY, 2, self.product),
            "revision": (IDENTITY, 3, self.revision),
            "serial": (IDENTITY, 4, self.serial),
        }
        return {name: (index, sub, value) for name, (index, sub, value) in every.items() if value is not None}


@dataclass(frozen=True, slots=True)
class Configuration:
    """The configuration that a node has to hold.

    `date` is the expected configuration date and time (1F26h, 1F27h); if it is None, the configuration is written at every boot.
    With `store` the node saves the configuration (1010h:01), so that it need not be written again after the node's next start.
    """

    settings: tuple[Setting, ...]
    date: tuple[int, int] | None = None
    store: bool = False


async def identity_differences(master: CanopenMaster, node: int, expected: ExpectedIdentity) -> dict[str, str]:
    """Read the expected parts of the node's identity; return name -> "expected X, got Y" for those that differ.

    An object that the node does not have counts as different. Raises the errors of a read if the node does not answer.
    """
    wrong: dict[str, str] = {}
    for name, (index, sub, value) in expected.objects.items():
        try:
            held = await read_number(master, node, index, sub, _U32)
        except SdoAborted as e:
            wrong[name] = f"expected {value:X}h, got an abort with {e.code:08X}h"
            continue
        if held != value:
            wrong[name] = f"expected {value:X}h, got {held:X}h"
    return wrong


async def holds_configuration(master: CanopenMaster, node: int, date: tuple[int, int] | None) -> bool:
    """Return whether the node reports that it was configured on `date` (1020h:01 and :02); False if `date` is None."""
    if date is None or date == (0, 0):
        return False
    try:
        held = [await read_number(master, node, CONFIGURATION_DATE, sub, _U32) for sub in (1, 2)]
    except SdoAborted:
        return False  # the node has no 1020h
    return (held[0], held[1]) == date


async def download_configuration(master: CanopenMaster, node: int, configuration: Configuration) -> bool:
    """Write the configuration unless the node holds it; return whether it was written. Call it in PRE-OPERATIONAL.

    Date and time are written last, so that a node whose configuration was interrupted does not appear configured.
    Raises `SdoAborted` for the first object that the node refuses, `VerifyFailed` if it does not keep the date.
    """
    if await holds_configuration(master, node, configuration.date):
        return False
    await write_settings(master, node, configuration.settings)
    if configuration.date is not None:
        for sub, value in enumerate(configuration.date, 1):
            await write_number(master, node, CONFIGURATION_DATE, sub, _U32, value)
        for sub, value in enumerate(configuration.date, 1):
            await verify_number(master, node, CONFIGURATION_DATE, sub, _U32, value)
    if configuration.store:
        await master.sdo_download(node, STORE_PARAMETERS, 1, SAVE, STORE_TIMEOUT_S)
    return True


async def write_settings(master: CanopenMaster, node: int, settings: Sequence[Setting]) -> None:
    """Write objects one after the other, in the order of the concise DCF."""
    for setting in settings:
        await master.sdo_download(node, setting.index, setting.subindex, setting.data)
