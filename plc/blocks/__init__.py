"""Function blocks for programs: the standard's (IEC 61131-3, 6.6.3.5) and those that every plant needs."""

from plc.blocks.alarm import ALARM
from plc.blocks.block import MS, SECOND, FunctionBlock
from plc.blocks.control import HYSTERESIS, PID, RAMP
from plc.blocks.counters import CTD, CTU, CTUD, VARIANTS
from plc.blocks.edges import F_TRIG, R_TRIG, RS, SR
from plc.blocks.timers import TOF, TON, TP

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
