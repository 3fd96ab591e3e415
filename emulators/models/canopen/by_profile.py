"""Select the model for a data sheet: by the device profile in the low word of 1000h (CiA 301, 7.5.2.1), or by the user."""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.emulators.canopen.behaviour import DeviceModel
from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary
from fieldtwin.emulators.models.canopen.encoder import Encoder
from fieldtwin.emulators.models.canopen.inclinometer import Inclinometer
from fieldtwin.emulators.models.canopen.io_module import IoModule
from fieldtwin.emulators.models.canopen.measuring_device import MeasuringDevice
from fieldtwin.emulators.models.drive.drive import Drive

MODELS: dict[int, Callable[[], DeviceModel]] = {
    401: IoModule,
    402: Drive,
    404: MeasuringDevice,
    406: Encoder,
    410: Inclinometer,
}


NO_MODEL = "none"
"""The value by which a user asks for a node without a model, in place of a number of `MODELS`."""


def model_for(dictionary: Dictionary, chosen: str | None = None) -> DeviceModel | None:
    """Return a new model for the device that the data sheet describes; None for a device profile without a model.

    `chosen` is the user's choice: a number of `MODELS` as text, or `NO_MODEL`.
    """
    if chosen is not None:
        return None if chosen == NO_MODEL else MODELS[int(chosen)]()
    entry = dictionary.entry(0x1000, 0)
    if entry is None or not codec.is_number(entry.data_type):
        return None
    make = MODELS.get(int(codec.decode(entry.data_type, entry.default)) & 0xFFFF)
    return make() if make else None
