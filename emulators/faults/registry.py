"""The list of all faults, by name."""

from __future__ import annotations

from importlib import import_module

from fieldtwin.emulators.faults.fault import Fault
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean

_MODULES = """
loss.drop timing.delay timing.jitter loss.duplicate timing.reorder timing.split timing.pause timing.coalesce
damage.corrupt_bits damage.corrupt_crc damage.corrupt_length modbus.wrong_unit modbus.wrong_function modbus.wrong_transaction
modbus.fewer_registers damage.truncate damage.garbage damage.noise damage.echo timing.late_reply modbus.exception modbus.busy
loss.silence loss.half_open loss.reset loss.disconnect damage.wrong_baud damage.wrong_parity damage.collision
canopen.lost_frame canopen.error_frame canopen.bus_off canopen.duplicate_node canopen.sdo_abort canopen.sdo_toggle
canopen.lost_segment canopen.heartbeat_loss canopen.heartbeat_late canopen.emcy_burst canopen.sync_jitter canopen.boot_storm
canopen.late_frame canopen.short_frame canopen.odd_sdo canopen.odd_heartbeat values.stuck values.drift values.spike
values.nan values.out_of_range values.set_value
"""


def _load() -> dict[str, type[Fault]]:
    found: dict[str, type[Fault]] = {}
    for name in _MODULES.split():
        module = import_module(f"fieldtwin.emulators.faults.{name}")
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, Fault) and kind.__module__ == module.__name__:
                found[kind.name] = kind
    return found


FAULTS: dict[str, type[Fault]] = _load()
"""The fault classes by name, in the order in which ``fieldtwin faults`` lists them."""


def fault_class(name: str) -> type[Fault]:
    """Return the class of a fault. Raises `UsageError`, which suggests the nearest name."""
    found = FAULTS.get(name)
    if found is None:
        hint = did_you_mean(name, FAULTS, otherwise="`fieldtwin faults` lists them")
        raise UsageError(f"no fault {name!r}", expected=", ".join(FAULTS), hint=hint)
    return found
