"""All faults by name."""

from __future__ import annotations

from importlib import import_module

from fieldtwin.emulators.faults.fault import Fault
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.nearest import did_you_mean

_FILES = """
drop delay jitter duplicate reorder split pause coalesce corrupt_bits corrupt_crc corrupt_length wrong_unit wrong_function
wrong_transaction fewer_registers
truncate garbage noise echo late_reply exception busy silence half_open reset disconnect wrong_baud wrong_parity
collision lost_frame error_frame bus_off duplicate_node sdo_abort sdo_toggle lost_segment heartbeat_loss heartbeat_late emcy_burst
sync_jitter boot_storm late_frame short_frame odd_sdo odd_heartbeat stuck drift spike nan out_of_range set_value
"""


def _load() -> dict[str, type[Fault]]:
    found: dict[str, type[Fault]] = {}
    for file in _FILES.split():
        module = import_module(f"fieldtwin.emulators.faults.{file}")
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, Fault) and kind.__module__ == module.__name__:
                found[kind.name] = kind
    return found


FAULTS: dict[str, type[Fault]] = _load()
"""The faults by name, in the order of the list of faults."""


def fault_class(name: str) -> type[Fault]:
    """Return the class of a fault. Raises `UsageError`, which suggests the nearest name."""
    found = FAULTS.get(name)
    if found is None:
        hint = did_you_mean(name, FAULTS, otherwise="`fieldtwin faults` lists them")
        raise UsageError(f"no fault {name!r}", expected=", ".join(FAULTS), hint=hint)
    return found
