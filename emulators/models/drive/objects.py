"""The objects and modes of operation of a CiA 402 drive that the model supports, and which of them a data sheet has.

Indices, bits and codes are those of CiA 402-2 and 402-3 (IEC 61800-7-201, -301).
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.behaviour import Objects
from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary
from fieldtwin.emulators.models.drive.homing import METHODS

ERROR_CODE, CONTROLWORD, STATUSWORD = 0x603F, 0x6040, 0x6041
ABORT_CONNECTION, QUICK_STOP_OPTION, SHUTDOWN_OPTION, DISABLE_OPTION, HALT_OPTION, FAULT_OPTION = (
    0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E,
)  # fmt: skip
MODE, MODE_DISPLAY, SUPPORTED_MODES = 0x6060, 0x6061, 0x6502
POSITION_DEMAND, POSITION_ACTUAL, VELOCITY_DEMAND, VELOCITY_ACTUAL = 0x6062, 0x6064, 0x606B, 0x606C
VELOCITY_WINDOW, VELOCITY_THRESHOLD, FOLLOWING_WINDOW, FOLLOWING_ERROR = 0x606D, 0x606F, 0x6065, 0x60F4
TARGET_TORQUE, MAX_TORQUE, TORQUE_DEMAND, TORQUE_ACTUAL = 0x6071, 0x6072, 0x6074, 0x6077
TARGET_POSITION, POSITION_LIMIT, MAX_VELOCITY = 0x607A, 0x607D, 0x607F
PROFILE_VELOCITY, ACCELERATION, DECELERATION, QUICK_DECELERATION = 0x6081, 0x6083, 0x6084, 0x6085
HOME_OFFSET, HOMING_METHOD, HOMING_SPEEDS, HOMING_ACCELERATION, SUPPORTED_METHODS = (
    0x607C,
    0x6098,
    0x6099,
    0x609A,
    0x60E3,
)
POSITION_OFFSET, VELOCITY_OFFSET, TORQUE_OFFSET, INTERPOLATION, MAX_ACCELERATION, MAX_DECELERATION = (
    0x60B0, 0x60B1, 0x60B2, 0x60C2, 0x60C5, 0x60C6,
)  # fmt: skip
DIGITAL_INPUTS, TARGET_VELOCITY = 0x60FD, 0x60FF

PROFILE_POSITION, PROFILE_SPEED, HOMING, CYCLIC_POSITION, CYCLIC_SPEED, CYCLIC_TORQUE = 1, 3, 6, 8, 9, 10
NEEDS = {
    PROFILE_POSITION: (TARGET_POSITION,),
    PROFILE_SPEED: (TARGET_VELOCITY,),
    HOMING: (HOMING_METHOD,),
    CYCLIC_POSITION: (TARGET_POSITION,),
    CYCLIC_SPEED: (TARGET_VELOCITY,),
    CYCLIC_TORQUE: (TARGET_TORQUE,),
}
"""Modes of operation of this model (6060h), and the objects that each mode requires."""

FOLLOWED = {
    PROFILE_SPEED: {TARGET_VELOCITY, ACCELERATION, DECELERATION},
    CYCLIC_POSITION: {TARGET_POSITION, POSITION_OFFSET},
    CYCLIC_SPEED: {TARGET_VELOCITY, VELOCITY_OFFSET},
    CYCLIC_TORQUE: {TARGET_TORQUE, TORQUE_OFFSET},
}
"""Modes whose target the motor follows immediately, and the objects that determine the target."""

OPTIONS = {
    ABORT_CONNECTION: range(4),
    QUICK_STOP_OPTION: range(9),
    SHUTDOWN_OPTION: range(2),
    DISABLE_OPTION: range(2),
    HALT_OPTION: range(1, 5),
    FAULT_OPTION: range(5),
    HOMING_METHOD: (0, *METHODS),
}
"""By object: the option codes that the model supports. A client that writes a different code gets an abort. For the homing
method, 0 means none.
"""


def mode_bits(objects: Objects) -> int:
    """Return 6502h: the modes of the data sheet that the model supports. Mode n is bit n - 1.

    If the data sheet gives 6502h no value, the modes are those that its objects allow.
    """
    have = sum(1 << mode - 1 for mode, needed in NEEDS.items() if all(objects.has(index) for index in needed))
    said = int(objects.factory(SUPPORTED_MODES))
    return have & said if said else have


def missing_modes(dictionary: Dictionary) -> list[int]:
    """Return the modes in the data sheet's 6502h that the model does not support, or whose objects the data sheet lacks."""
    entry = dictionary.entry(SUPPORTED_MODES, 0)
    if entry is None or not codec.is_integer(entry.data_type):
        return []
    said = int(codec.decode(entry.data_type, entry.default)) & 0xFFFF  # the upper half is manufacturer-specific
    modes = [bit + 1 for bit in range(16) if said >> bit & 1]
    return [m for m in modes if m not in NEEDS or any(dictionary.entry(index, 0) is None for index in NEEDS[m])]


def methods_of(objects: Objects) -> dict[tuple[int, int], int]:
    """Return 60E3h: the homing methods of the data sheet, with 0 in place of a method that the model lacks."""
    said = {sub: int(objects.factory(SUPPORTED_METHODS, sub)) for sub in objects.channels(SUPPORTED_METHODS)}
    return {(SUPPORTED_METHODS, sub): method if method in METHODS else 0 for sub, method in said.items()}
