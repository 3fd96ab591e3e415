"""A point that moves with piecewise constant acceleration: its position, and the ramps to a given speed or position.

The position is a closed formula of time, so it can be computed for any time and never drifts. The caller chooses the units of
length; time is in seconds. This module depends on no drive and reads no clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Ramp = tuple[float, float]
"""A ramp: its duration in seconds, and its acceleration."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A motion from position `x` with speed `v` through `ramps`, which then continues with the final speed."""

    x: float = 0.0
    v: float = 0.0
    ramps: tuple[Ramp, ...] = ()

    @property
    def duration_s(self) -> float:
        """Return the total duration of the ramps in seconds."""
        return sum(duration for duration, _ in self.ramps)

    def at(self, t_s: float) -> tuple[float, float]:
        """Return position and speed `t_s` seconds after the start."""
        x, v = self.x, self.v
        for duration, a in self.ramps:
            t = min(t_s, duration)
            x, v = x + v * t + a * t * t / 2, v + a * t
            t_s -= t
            if t_s <= 0:
                return x, v
        return x + v * t_s, v


def to_speed(v: float, target: float, acceleration: float, deceleration: float) -> tuple[Ramp, ...]:
    """Return ramps from speed `v` to `target`. A change of direction brakes first. Accelerations are above 0."""
    ramps: list[Ramp] = []
    if v * target < 0:
        ramps.append((abs(v) / deceleration, -math.copysign(deceleration, v)))
        v = 0.0
    if v != target:
        a = acceleration if abs(target) > abs(v) else deceleration
        ramps.append((abs(target - v) / a, math.copysign(a, target - v)))
    return tuple(ramps)


def to_place(distance: float, v: float, cruise: float, acceleration: float, deceleration: float) -> tuple[Ramp, ...]:
    """Return ramps that cover `distance` from speed `v` to a stop, no faster than `cruise`. All three rates are above 0.

    A point that moves in the wrong direction, or too fast to stop in time, brakes to a stop first and returns.
    """
    ramps: list[Ramp] = []
    braking = v * abs(v) / (2 * deceleration)
    if v and (v * distance < 0 or abs(braking) > abs(distance) * (1 + 1e-12)):
        ramps.append((abs(v) / deceleration, -math.copysign(deceleration, v)))
        distance, v = distance - braking, 0.0
    if distance == 0 and v == 0:
        return tuple(ramps)
    sign = math.copysign(1.0, distance if distance else v)
    way, speed = abs(distance), abs(v)
    if speed > cruise:
        ramps.append(((speed - cruise) / deceleration, -sign * deceleration))
        way -= (speed * speed - cruise * cruise) / (2 * deceleration)
        speed = cruise
    # Up to the peak speed and down again: the area under the two ramps is the distance.
    peak_squared = (2 * acceleration * deceleration * way + deceleration * speed * speed) / (
        acceleration + deceleration
    )
    peak = min(cruise, math.sqrt(max(0.0, peak_squared)))
    peak = max(peak, speed)
    up, down = (peak * peak - speed * speed) / (2 * acceleration), peak * peak / (2 * deceleration)
    ramps += [((peak - speed) / acceleration, sign * acceleration)]
    if way - up - down > 0:
        ramps.append(((way - up - down) / peak, 0.0))
    ramps.append((peak / deceleration, -sign * deceleration))
    return tuple(ramp for ramp in _positive(ramps))


def _positive(ramps: Sequence[Ramp]) -> list[Ramp]:
    return [(duration, a) for duration, a in ramps if duration > 0]


def by_torque(v: float, acceleration: float, friction: float, fastest: float) -> tuple[Ramp, ...]:
    """Return ramps from speed `v` under a torque that alone gives `acceleration`, against dry `friction`.

    Both are in units per second squared. A torque that is weaker than the friction does not move a motor at rest. The
    speed stays within `fastest`, which is above 0.
    """
    ramps: list[Ramp] = []
    if abs(v) > fastest:
        ramps.append(((abs(v) - fastest) / friction, -math.copysign(friction, v)))
        v = math.copysign(fastest, v)
    if v:
        net = acceleration - math.copysign(friction, v)
        if v * net < 0:
            ramps.append((abs(v / net), net))
            v = 0.0
        elif net:
            return (*ramps, *_positive([((fastest - abs(v)) / abs(net), net)]))
        else:
            return tuple(ramps)
    if abs(acceleration) > friction:
        net = acceleration - math.copysign(friction, acceleration)
        ramps.append((fastest / abs(net), net))
    return tuple(ramps)
