"""Function blocks for programs: the standard's blocks (IEC 61131-3, 6.6.3.5) and blocks that every plant needs."""

from fieldtwin.plc.blocks.alarm import ALARM
from fieldtwin.plc.blocks.block import MS, SECOND, FunctionBlock
from fieldtwin.plc.blocks.control import HYSTERESIS, PID, RAMP
from fieldtwin.plc.blocks.counters import CTD, CTU, CTUD, VARIANTS
from fieldtwin.plc.blocks.edges import F_TRIG, R_TRIG, RS, SR
from fieldtwin.plc.blocks.timers import TOF, TON, TP

BLOCKS: dict[str, type[FunctionBlock]] = {
    block.__name__: block
    for block in (R_TRIG, F_TRIG, SR, RS, TON, TOF, TP, CTU, CTD, CTUD, HYSTERESIS, RAMP, PID, ALARM)
} | VARIANTS
"""Every block by its name."""

__all__ = [
    "ALARM",
    "BLOCKS",
    "CTD",
    "CTU",
    "CTUD",
    "F_TRIG",
    "HYSTERESIS",
    "MS",
    "PID",
    "RAMP",
    "RS",
    "R_TRIG",
    "SECOND",
    "SR",
    "TOF",
    "TON",
    "TP",
    "FunctionBlock",
]
