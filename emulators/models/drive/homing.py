"""Homing of a CiA 402 drive: the path and the home position of each method (CiA 402-2, IEC 61800-7-201, 6098h).

Methods 1 to 14 search for a switch and then for an index pulse, 17 to 30 do the same without the index pulse, 33 and 34
use the next index pulse, 35 and 37 the present position. The whole path is computed when homing begins, so that the
drive stays a function of time. A search brakes after the edge of the switch, like a real drive, which cannot know where
the edge is. This module does not depend on CANopen objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fieldtwin.emulators.models.drive.motion import Motion, Ramp, to_place, to_speed

METHODS = (*range(1, 15), *range(17, 31), 33, 34, 35, 37)
"""Homing methods of this model, as 60E3h lists them."""

_LEFT, _RIGHT = -1, 1
_LIMIT = {1: _LEFT, 2: _RIGHT}
"""For each method that uses a limit switch: the side of the switch. The index pulse is on the opposite side of its edge."""
_POSITIVE_HOME = {3: _LEFT, 4: _RIGHT}
"""For each method that uses the lower edge of the home switch, as if it were active from there on: the side of the index pulse.
"""
_NEGATIVE_HOME = {5: _RIGHT, 6: _LEFT}
"""For each method that uses the upper edge of the home switch, as if it were active up to there: the side of the index pulse.
"""
_BETWEEN = {
    7: (_RIGHT, "lower", _LEFT), 8: (_RIGHT, "lower", _RIGHT), 9: (_RIGHT, "upper", _LEFT), 10: (_RIGHT, "upper", _RIGHT),
    11: (_LEFT, "upper", _RIGHT), 12: (_LEFT, "upper", _LEFT), 13: (_LEFT, "lower", _RIGHT), 14: (_LEFT, "lower", _LEFT),
}  # fmt: skip
"""For each method between two limit switches: the side where the search begins, the edge of the home switch, and the side of the
index pulse.
"""


@dataclass(frozen=True, slots=True)
class DriveAxis:
    """The positions of the switches of the axis, in increments from the position at the first power-on.

    The limit switches are active beyond `negative` and `positive`, the home switch from `home_from` to `home_to`. Index
    pulses are at `index` and every `turn` from there.
    """

    negative: float = -200_000.0
    positive: float = 200_000.0
    home_from: float = 40_000.0
    home_to: float = 75_000.0
    index: float = 2_500.0
    turn: float = 10_000.0

    def inputs(self, x: float) -> int:
        """Return the value of 60FDh, the digital inputs: bit 0 negative limit switch, bit 1 positive limit switch, bit 2 home
        switch.
        """
        x = round(x)  # a path ends at an edge only up to rounding errors
        return (x <= self.negative) | (x >= self.positive) << 1 | (self.home_from <= x <= self.home_to) << 2

    def index_beside(self, x: float, side: int) -> float:
        """Return the nearest index pulse on this side of `x`, not at `x` itself."""
        turns = (x - self.index) / self.turn
        whole = math.ceil(turns) - 1 if side == _LEFT else math.floor(turns) + 1
        return self.index + whole * self.turn


@dataclass(frozen=True, slots=True)
class Speeds:
    """The speeds and acceleration of homing.

    6099h: `search` for the switch and `zero` for the edge or the index pulse, in increments per second. 609Ah: `acceleration`.
    """

    search: float
    zero: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class HomingPath:
    """The motion of the drive, and the home position, which is None if the search ended at a limit switch (a homing error)."""

    motion: Motion
    home: float | None


def plan(method: int, axis: DriveAxis, x: float, v: float, speeds: Speeds) -> HomingPath:
    """Return the path of the drive during homing by `method`, which is one of `METHODS`. The drive begins at position `x` with
    speed `v`."""
    if method in (35, 37):
        stop = Motion(x, v, to_speed(v, 0.0, speeds.acceleration, speeds.acceleration))
        return HomingPath(stop, stop.at(stop.duration_s)[0])
    edges, place, found = _search(method, axis, x)
    ramps: list[Ramp] = []
    at, speed = x, v
    for edge in edges:
        more = _until(edge - at, speed, speeds)
        ramps += more
        at, speed = Motion(at, speed, more).at(sum(duration for duration, _ in more))
    if not found:
        return HomingPath(Motion(x, v, tuple(ramps)), None)
    ramps += to_place(place - at, speed, speeds.zero, speeds.acceleration, speeds.acceleration)
    return HomingPath(Motion(x, v, tuple(ramps)), place)


def _search(method: int, axis: DriveAxis, x: float) -> tuple[list[float], float, bool]:
    """Return the edges that the search passes in order, the home position, and whether the search finds it."""
    if method in (33, 34):
        return [], axis.index_beside(x, _LEFT if method == 33 else _RIGHT), True
    with_index = method < 17
    kind = method if with_index else method - 16
    found = True
    if kind in _LIMIT:
        side = _LIMIT[kind]
        edge = axis.negative if side == _LEFT else axis.positive
        edges = [edge] if (edge - x) * side > 0 else []
        index_side = -side
    elif kind in _BETWEEN:
        first, name, index_side = _BETWEEN[kind]
        edge = axis.home_from if name == "lower" else axis.home_to
        edges = [edge]
        missed = x > axis.home_to if first == _RIGHT else x < axis.home_from
        limit = axis.positive if first == _RIGHT else axis.negative
        if missed and (limit - x) * first > 0:
            edges = [limit, edge]
    else:
        lower = kind in _POSITIVE_HOME
        edge, index_side = (axis.home_from, _POSITIVE_HOME[kind]) if lower else (axis.home_to, _NEGATIVE_HOME[kind])
        found = x <= axis.home_to if lower else x >= axis.home_from
        edges = [edge] if found else [axis.positive if lower else axis.negative]
    return edges, axis.index_beside(edge, index_side) if with_index else edge, found


def _until(distance: float, v: float, speeds: Speeds) -> tuple[Ramp, ...]:
    """Return ramps that pass an edge at the search speed and then brake to a stop.

    A motor that moves away from the edge brakes first.
    """
    a = speeds.acceleration
    ramps: list[Ramp] = []
    if v * distance < 0:
        ramps.append((abs(v) / a, -math.copysign(a, v)))
        distance, v = distance - v * abs(v) / (2 * a), 0.0
    side = math.copysign(1.0, distance)
    speed, way = abs(v), abs(distance)
    reached = min(speeds.search, math.sqrt(speed * speed + 2 * a * way))
    if reached > speed:
        ramps.append(((reached - speed) / a, side * a))
        way -= (reached * reached - speed * speed) / (2 * a)
    elif speed > speeds.search:
        slower = max(speeds.search, math.sqrt(max(0.0, speed * speed - 2 * a * way)))
        ramps.append(((speed - slower) / a, -side * a))
        way, reached = way - (speed * speed - slower * slower) / (2 * a), slower
    if way > 0 and reached > 0:
        ramps.append((way / reached, 0.0))
    ramps.append((reached / a, -side * a))
    return tuple(ramp for ramp in ramps if ramp[0] > 0)
