"""The first write of an output: the gateway reads the device first, and does not write a value that it already holds.

This applies only before the first write, and only to a device that was not lost meanwhile. A device that returns after a loss may
hold a default that equals the wanted value by chance, so the value is written again. A reading that is not good is not used.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.runtime.outputs.output import SAFE, Output

READ_BACK_NS = 2 * NS_PER_S
"""The time for which the first write of an output waits for the first reading of its value, once its device is online."""


def waits_for_reading(output: Output, current: TagValue, now_ns: int) -> bool:
    """Return whether the first write has to wait for the first reading. A safe value does not wait."""
    if output.due_since_ns is None:
        output.due_since_ns = now_ns
    if is_known(output, current) or output.by.startswith(SAFE) or not output.read_back:
        return False
    was_asked = current.quality is Quality.BAD and current.reason is not Reason.NEVER_READ
    return not was_asked and now_ns - output.due_since_ns < READ_BACK_NS


def is_known(output: Output, current: TagValue) -> bool:
    """Return whether `current` is the value that the device holds.

    Writing a node's configuration may change its values, so only a later reading counts."""
    if current.quality is not Quality.GOOD or output.due_since_ns is None:
        return False
    driver = output.driver
    written = isinstance(driver, CanopenDriver) and driver.config.canopen.configuration is not None
    return not written or current.t_ns > output.due_since_ns
