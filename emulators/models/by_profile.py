"""Which model stands behind a data sheet: the device profile in the low word of 1000h says it (CiA 301, 7.5.2.1)."""

from __future__ import annotations

from collections.abc import Callable

from emulators.canopen import codec
from emulators.canopen.behaviour import DeviceModel
from emulators.canopen.dictionary import Dictionary
from emulators.models.drive import Drive
from emulators.models.encoder import Encoder
from emulators.models.inclinometer import Inclinometer
from emulators.models.io_module import IoModule
from emulators.models.measuring_device import MeasuringDevice

MODELS: dict[int, Callable[[], DeviceModel]] = {
    401: IoModule,
    402: Drive,
    404: MeasuringDevice,
    406: Encoder,
    410: Inclinometer,
}


def model_for(dictionary: Dictionary) -> DeviceModel | None:
    """A new model for the device that the data sheet describes; None for a profile without one."""
    entry = dictionary.entry(0x1000, 0)
    if entry is None or not codec.is_number(entry.data_type):
        return None
    make = MODELS.get(int(codec.decode(entry.data_type, entry.default)) & 0xFFFF)
    return make() if make else None
