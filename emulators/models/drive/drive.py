"""A CiA 402 drive: state machine, profile modes, homing and cyclic synchronous modes, with a motor that follows without
error.

Objects and bits follow CiA 402-2 and 402-3 (IEC 61800-7-201, -301), as printed in drive makers' manuals. Positions are in
increments, speeds in increments per second, accelerations in increments per second squared, torques in thousandths of the rated
torque. A value that the model cannot compute (DC link voltage) comes from a recording; a recorded object is never computed. Every
error that is present in the node puts the drive into the fault state; the fault reset clears the error.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.emulators.canopen.aborts import Abort
from fieldtwin.emulators.canopen.behaviour import DeviceModel, ModelOutput, Number, Objects, Situation
from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.models.drive import objects as od
from fieldtwin.emulators.models.drive.homing import METHODS, DriveAxis, HomingPath, Speeds, plan
from fieldtwin.emulators.models.drive.motion import Motion, by_torque, to_place, to_speed
from fieldtwin.emulators.models.drive.states import DriveState, DriveTransition, TransitionCause, command_of, transition
from fieldtwin.gateway.core.clock import NS_PER_S

NEW_SET_POINT, AT_ONCE, RELATIVE, HALT = 1 << 4, 1 << 5, 1 << 6, 1 << 8
"""Bits of the controlword in profile position mode; halt exists in every mode."""

VOLTAGE, REMOTE, REACHED, LIMITED, BIT_12, BIT_13 = 1 << 4, 1 << 9, 1 << 10, 1 << 11, 1 << 12, 1 << 13
"""Bits of the statusword. Bit 12 is set-point acknowledge (profile position), speed is zero (profile velocity), homing
attained, or that the drive follows the command (cyclic modes). Bit 13 is a homing error, or a following error (cyclic
position).
"""

HEARTBEAT_LOST, BUS_OFF = 0x8130, 0x8140
_COMMUNICATION = frozenset({HEARTBEAT_LOST, BUS_OFF})
_REACTIONS = {1: TransitionCause.ERROR, 2: TransitionCause.DISABLE_VOLTAGE, 3: TransitionCause.QUICK_STOP}
"""The effect of a lost connection, by the abort connection option code 6007h."""

_SPAN = 1 << 32
_USUAL, _UNLIMITED = 10_000.0, 10_000_000.0
"""Accelerations in increments per second squared for a node without the object that states them: the usual one of a profile, and
that of a motor without limits.
"""
_FASTEST = 10_000_000.0
"""The final speed, in increments per second, of a motor that a torque accelerates without limit."""


@dataclass(frozen=True, slots=True)
class _SetPoint:
    position: int
    velocity: float
    acceleration: float
    deceleration: float


class Drive(DeviceModel):
    """One axis.

    `self_test_s` is the time in seconds after power-on for which the drive is not ready to switch on; `coasting` is the
    deceleration of an unpowered motor by its friction; `rated` is the acceleration that the rated torque gives without
    friction; both are in increments per second squared. `axis` holds the positions of the switches.
    """

    def __init__(
        self,
        *,
        self_test_s: float = 0.02,
        coasting: float = 20_000.0,
        rated: float = 500_000.0,
        axis: DriveAxis | None = None,
    ) -> None:
        self._rated, self._axis = rated, axis or DriveAxis()
        self._zero = 0.0  # the place where 6064h is 0
        self._exists: dict[Key, Number] = {}
        """The values of 6502h and 60E3h: the modes and homing methods of the data sheet that the model supports."""
        self._self_test_ns = round(self_test_s * NS_PER_S)
        self._coasting = coasting
        self._motion = Motion()
        self._began_ns = 0
        self._restart(0)

    def _restart(self, now_ns: int) -> None:
        self.state = DriveState.NOT_READY
        self.transitions: list[int] = []
        """The standard's numbers of the last transitions, oldest first; at most 64."""
        self._ready_ns: int | None = now_ns + self._self_test_ns
        self._controlword = 0
        self._mode = 0
        self._target: _SetPoint | None = None
        self._queue: _SetPoint | None = None
        self._acknowledge = False
        self._limited = False
        self._homing: HomingPath | None = None
        self._homed = 0  # bits of the statusword in homing mode
        self._wanted: int | None = None  # the demand value of cyclic synchronous position
        self._torque: float | None = None  # the demand value of cyclic synchronous torque; None before its first use
        self._seen: frozenset[int] = frozenset()

    # -- interface for the mechanics of a twin ------------------------------------------------------------------------

    def position(self, now_ns: int) -> float:
        """Return the position in increments since the first power-on, without the wrap of 6064h's 32 bits."""
        return self._motion.at((now_ns - self._began_ns) / NS_PER_S)[0]

    def velocity(self, now_ns: int) -> float:
        """Return the speed in increments per second."""
        return self._motion.at((now_ns - self._began_ns) / NS_PER_S)[1]

    # -- interface for the node ---------------------------------------------------------------------------------------

    def power_on(self, situation: Situation) -> None:
        self._ramp(situation.now_ns, 0.0, self._coasting)
        self._restart(situation.now_ns)
        objects = situation.objects
        self._exists = {(od.SUPPORTED_MODES, 0): od.mode_bits(objects), **od.methods_of(objects)}

    def refuse(self, key: Key, value: Number, objects: Objects) -> Abort | None:
        if key == (od.MODE, 0):
            return None if _supported(int(value), objects) else Abort.VALUE
        codes = od.OPTIONS.get(key[0]) if key[1] == 0 else None
        return None if codes is None or int(value) in codes else Abort.VALUE

    def step(self, situation: Situation) -> ModelOutput:
        now_ns, objects = situation.now_ns, situation.objects
        self._by_itself(now_ns, objects)
        self._mind_errors(situation)
        if (od.MODE, 0) in situation.written or (self._mode == 0 and _supported(objects.whole(od.MODE), objects)):
            self._change_mode(now_ns, objects)
        new_target = any(key[0] in od.FOLLOWED.get(self._mode, ()) for key in situation.written)
        if (od.CONTROLWORD, 0) in situation.written:
            self._obey(now_ns, objects)
        if new_target and self.state is DriveState.OPERATION_ENABLED:
            self._follow(now_ns, objects)
        clears = (
            situation.errors if self.state is DriveState.SWITCH_ON_DISABLED and self.transitions[-1:] == [15] else ()
        )
        return self._outcome(situation, tuple(code for code in clears if code not in _COMMUNICATION))

    # -- state machine ------------------------------------------------------------------------------------------------

    def _by_itself(self, now_ns: int, objects: Objects) -> None:
        """Process the events that have become due since the last step, without a command: the end of the self-test, and the
        end of a ramp.
        """
        if self._ready_ns is not None and now_ns >= self._ready_ns:
            self._ready_ns = None
            self._go(TransitionCause.INITIALISED, now_ns, objects)
        if now_ns < self._end_ns():
            return
        if self.state is DriveState.QUICK_STOP:
            self._go(TransitionCause.STOPPED, now_ns, objects)
        elif self.state is DriveState.FAULT_REACTION:
            self._go(TransitionCause.REACTED, now_ns, objects)
        elif self._homing is not None:
            self._arrive(self._homing, objects)
        elif self._queue is not None and self._in(od.PROFILE_POSITION) and not self._controlword & HALT:
            queued, self._queue = self._queue, None
            self._acknowledge = bool(self._controlword & NEW_SET_POINT)
            self._move_to(queued, now_ns)

    def _mind_errors(self, situation: Situation) -> None:
        present = frozenset(situation.errors)
        arisen, self._seen = present - self._seen, present
        for code in sorted(arisen):
            cause: TransitionCause | None = TransitionCause.ERROR
            if code in _COMMUNICATION:
                cause = _REACTIONS.get(situation.objects.whole(od.ABORT_CONNECTION, default=1))
            if cause is not None:
                self._go(cause, situation.now_ns, situation.objects)

    def _obey(self, now_ns: int, objects: Objects) -> None:
        """Carry out a new controlword. It can trigger two transitions together: switch on and enable operation."""
        before, self._controlword = self._controlword, objects.whole(od.CONTROLWORD)
        command = command_of(self._controlword, before)
        if command is TransitionCause.FAULT_RESET and self._disconnected(objects):
            return  # the cause of the fault is still present
        for _ in range(2):
            if command is None or self._go(command, now_ns, objects) is None:
                break
        if self.state is not DriveState.OPERATION_ENABLED:
            return
        if (self._controlword ^ before) & HALT:
            self._halt_or_go_on(now_ns, objects)
        if self._mode == od.PROFILE_POSITION:
            self._take_set_point(before, now_ns, objects)
        if self._mode == od.HOMING and (self._controlword ^ before) & NEW_SET_POINT:
            self._begin_homing(now_ns, objects)

    def _disconnected(self, objects: Objects) -> bool:
        return bool(self._seen & _COMMUNICATION) and objects.whole(od.ABORT_CONNECTION, default=1) == 1

    def _go(self, cause: TransitionCause, now_ns: int, objects: Objects) -> DriveTransition | None:
        """Take the transition that `cause` triggers in this state, if there is one, with its effect on the motor."""
        option = objects.whole(od.QUICK_STOP_OPTION, default=2)
        taken = transition(self.state, cause, stays_stopped=option >= 5)
        if taken is None:
            return None
        powered, self.state = self.state.powered, taken.target
        self.transitions = [*self.transitions[-63:], taken.number]
        if taken.number in (4, 16):
            self._take_up(now_ns, objects)
        elif taken.number == 5:
            self._slow_down(objects.whole(od.DISABLE_OPTION, default=1), now_ns, objects)
        elif taken.number == 8:
            self._slow_down(objects.whole(od.SHUTDOWN_OPTION), now_ns, objects)
        elif taken.number == 11:
            self._slow_down(option - 4 if option >= 5 else option, now_ns, objects)
            if option == 0:
                self._go(TransitionCause.STOPPED, now_ns, objects)
        elif taken.number == 13:
            if powered:
                self._slow_down(objects.whole(od.FAULT_OPTION, default=2), now_ns, objects)
            if not powered or objects.whole(od.FAULT_OPTION, default=2) == 0:
                self._go(TransitionCause.REACTED, now_ns, objects)
        elif taken.number in (9, 12):
            self._ramp(now_ns, 0.0, self._coasting)
        return taken

    # -- motion -------------------------------------------------------------------------------------------------------

    def _in(self, mode: int) -> bool:
        return self._mode == mode and self.state is DriveState.OPERATION_ENABLED

    def _end_ns(self) -> int:
        """Return the time at which the present ramps end."""
        return self._began_ns + round(self._motion.duration_s * NS_PER_S)

    def _ramp(self, now_ns: int, speed: float, acceleration: float, deceleration: float = 0.0) -> None:
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        self._move(Motion(x, v, to_speed(v, speed, acceleration, deceleration or acceleration)), now_ns)

    def _move(self, motion: Motion, now_ns: int) -> None:
        """Start a motion now. It interrupts homing."""
        self._motion, self._began_ns, self._homing = motion, now_ns, None

    def _slow_down(self, option: int, now_ns: int, objects: Objects) -> None:
        """Stop the motor according to an option code (605Ah to 605Eh).

        0: the motor coasts. 1: the ramp of the profile. 2: the ramp of the quick stop. 3: the current limit, which is
        the maximum torque. 4: the voltage limit, to which the friction adds.
        """
        strongest = self._rated * objects.number(od.MAX_TORQUE, default=1000) / 1000
        rates = {
            0: self._coasting,
            1: _rate(objects, od.DECELERATION),
            3: max(1.0, strongest),
            4: max(1.0, strongest + self._coasting),
        }
        self._ramp(now_ns, 0.0, rates.get(option, _rate(objects, od.QUICK_DECELERATION)))
        self._target = self._queue = None

    def _take_up(self, now_ns: int, objects: Objects) -> None:
        """Start or resume operation: from now on the mode of operation controls the motor."""
        self._target = self._queue = self._wanted = None
        self._acknowledge = self._limited = False
        self._homed = 0
        if self._mode in od.FOLLOWED and not self._controlword & HALT:
            self._follow(now_ns, objects)
        else:
            self._ramp(now_ns, 0.0, _rate(objects, od.DECELERATION))

    def _change_mode(self, now_ns: int, objects: Objects) -> None:
        mode = objects.whole(od.MODE)
        if not _supported(mode, objects) or mode == self._mode:
            return  # an RPDO cannot be refused: the display keeps the present mode
        self._mode = mode
        if self.state is DriveState.OPERATION_ENABLED:
            self._take_up(now_ns, objects)

    def _follow(self, now_ns: int, objects: Objects) -> None:
        """Follow the target in a mode whose target takes effect immediately."""
        if self._controlword & HALT:
            return
        most = _fastest(objects)
        if self._mode == od.CYCLIC_POSITION:
            self._follow_position(most, now_ns, objects)
        elif self._mode == od.CYCLIC_TORQUE:
            self._follow_torque(most, now_ns, objects)
        else:
            cyclic = self._mode == od.CYCLIC_SPEED
            wanted = objects.number(od.TARGET_VELOCITY) + (objects.number(od.VELOCITY_OFFSET) if cyclic else 0)
            self._limited = abs(wanted) > most
            up, down = (od.MAX_ACCELERATION, od.MAX_DECELERATION) if cyclic else (od.ACCELERATION, od.DECELERATION)
            usual = _UNLIMITED if cyclic else _USUAL
            speed = max(-most, min(most, wanted))
            self._ramp(now_ns, speed, _rate(objects, up, usual), _rate(objects, down, usual))

    def _follow_position(self, most: float, now_ns: int, objects: Objects) -> None:
        """Cyclic synchronous position: reach the target at the end of the interpolation period (60C2h), within the limits."""
        place = objects.whole(od.TARGET_POSITION) + objects.whole(od.POSITION_OFFSET)
        inside = _inside(place, objects)
        self._wanted = _wrapped(inside)
        period_s = max(1, objects.whole(od.INTERPOLATION, 1, 1)) * 10.0 ** objects.whole(od.INTERPOLATION, 2, -3)
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        distance = self._distance(self._wanted, x)
        up, down = (_rate(objects, index, _UNLIMITED) for index in (od.MAX_ACCELERATION, od.MAX_DECELERATION))
        # A motor that cannot stop at the target first brakes, and then has a longer way back.
        back = abs(distance - v * abs(v) / (2 * down))
        speed = max(abs(distance), back) / period_s
        self._limited = inside != place or abs(distance) / period_s > most
        self._move(Motion(x, v, to_place(distance, v, max(min(speed, most), 1e-9), up, down)), now_ns)

    def _follow_torque(self, most: float, now_ns: int, objects: Objects) -> None:
        """Cyclic synchronous torque: the torque accelerates the motor against its friction, up to the maximum speed."""
        wanted = objects.number(od.TARGET_TORQUE) + objects.number(od.TORQUE_OFFSET)
        strongest = objects.number(od.MAX_TORQUE, default=1000)
        self._torque = max(-strongest, min(strongest, wanted))
        self._limited = self._torque != wanted
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        ramps = by_torque(v, self._torque / 1000 * self._rated, self._coasting, min(most, _FASTEST))
        self._move(Motion(x, v, ramps), now_ns)

    # -- homing -------------------------------------------------------------------------------------------------------

    def _begin_homing(self, now_ns: int, objects: Objects) -> None:
        """Start homing when bit 4 of the controlword rises, and interrupt it when the bit falls."""
        method, most = objects.whole(od.HOMING_METHOD), _fastest(objects)
        acceleration = _rate(objects, od.HOMING_ACCELERATION)
        if not self._controlword & NEW_SET_POINT or self._controlword & HALT:
            if self._homing is not None:
                self._ramp(now_ns, 0.0, acceleration)
            return
        self._homed = 0
        if method not in METHODS:
            self._homed = BIT_13 if method else 0
            return
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        search, zero = (max(1.0, min(most, objects.number(od.HOMING_SPEEDS, sub, 1_000))) for sub in (1, 2))
        way = plan(method, self._axis, x, v, Speeds(search, zero, acceleration))
        self._move(way.motion, now_ns)
        self._homing = way

    def _arrive(self, way: HomingPath, objects: Objects) -> None:
        """Finish homing: the home position gets the value of the home offset (607Ch)."""
        self._homing, self._homed = None, BIT_12 if way.home is not None else BIT_13
        if way.home is not None:
            self._zero = way.home - objects.number(od.HOME_OFFSET)

    def _halt_or_go_on(self, now_ns: int, objects: Objects) -> None:
        if self._controlword & HALT:
            kept = self._target, self._queue
            self._slow_down(objects.whole(od.HALT_OPTION, default=1), now_ns, objects)
            self._target, self._queue = kept
        elif self._mode in od.FOLLOWED:
            self._follow(now_ns, objects)
        elif self._target is not None:
            self._move_to(self._target, now_ns)

    def _take_set_point(self, before: int, now_ns: int, objects: Objects) -> None:
        """Handle set-points of profile position mode: bit 4 offers a set-point, bit 12 acknowledges it until bit 4 is cleared.

        One further set-point can wait.
        """
        if not self._controlword & NEW_SET_POINT:
            self._acknowledge = self._queue is not None
            return
        if before & NEW_SET_POINT or self._acknowledge:
            return
        self._acknowledge = True
        set_point = self._set_point(now_ns, objects)
        idle = now_ns >= self._end_ns()
        if (self._controlword & AT_ONCE or idle) and not self._controlword & HALT:
            self._queue = None
            self._move_to(set_point, now_ns)
        elif self._controlword & HALT and self._target is None:
            self._target = set_point
        else:
            self._queue = set_point

    def _set_point(self, now_ns: int, objects: Objects) -> _SetPoint:
        place = objects.whole(od.TARGET_POSITION)
        if self._controlword & RELATIVE:
            place += self._target.position if self._target else _wrapped(self.position(now_ns) - self._zero)
        inside = _inside(place, objects)
        self._limited = inside != place
        speed = min(objects.number(od.PROFILE_VELOCITY), _fastest(objects))
        return _SetPoint(_wrapped(inside), speed, _rate(objects, od.ACCELERATION), _rate(objects, od.DECELERATION))

    def _move_to(self, to: _SetPoint, now_ns: int) -> None:
        self._target = to
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        ramps = to_place(self._distance(to.position, x), v, max(to.velocity, 1e-9), to.acceleration, to.deceleration)
        self._move(Motion(x, v, ramps), now_ns)

    def _distance(self, position: int, x: float) -> float:
        """Return the distance from the motor's position `x` to a value of 6064h."""
        shown = x - self._zero
        return position - (shown if abs(shown) < _SPAN / 2 else _wrapped(shown))

    # -- values of the objects ----------------------------------------------------------------------------------------

    def _outcome(self, situation: Situation, clears: tuple[int, ...]) -> ModelOutput:
        now_ns, objects = situation.now_ns, situation.objects
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        in_fault = self.state in (DriveState.FAULT, DriveState.FAULT_REACTION)
        error = situation.errors[-1] if in_fault and situation.errors else 0
        states: dict[Key, Number] = {
            (od.STATUSWORD, 0): self._statusword(now_ns, v, objects),
            (od.MODE_DISPLAY, 0): self._mode,
            (od.ERROR_CODE, 0): error,
        }
        states = {**states, **self._exists}
        place, speed = _wrapped(x - self._zero), round(v)
        demand = self._wanted if self._wanted is not None and self._in(od.CYCLIC_POSITION) else place
        readings = {
            (od.POSITION_ACTUAL, 0): place, (od.POSITION_DEMAND, 0): demand, (od.FOLLOWING_ERROR, 0): demand - place,
            (od.VELOCITY_ACTUAL, 0): speed, (od.VELOCITY_DEMAND, 0): speed, (od.DIGITAL_INPUTS, 0): self._axis.inputs(x),
        }  # fmt: skip
        if self._torque is not None:
            torque = round(self._torque) if self._in(od.CYCLIC_TORQUE) and not self._controlword & HALT else 0
            readings |= {(od.TORQUE_ACTUAL, 0): torque, (od.TORQUE_DEMAND, 0): torque}
        recorded = situation.played.keys()
        end_ns = self._end_ns()
        wakes = [t for t in (self._ready_ns, end_ns if end_ns > now_ns else None) if t is not None]
        return ModelOutput(
            {key: value for key, value in states.items() if key not in recorded},
            {key: value for key, value in readings.items() if key not in recorded},
            clears,
            min(wakes, default=None),
        )

    def _statusword(self, now_ns: int, v: float, objects: Objects) -> int:
        word = self.state.value | VOLTAGE | REMOTE | (LIMITED if self._limited else 0)
        moving = now_ns < self._end_ns()
        if self.state is DriveState.QUICK_STOP or (self._controlword & HALT and self.state.powered):
            return word | (0 if moving else REACHED)
        if self._in(od.PROFILE_POSITION):
            reached = not moving and self._queue is None
            return word | (REACHED if reached else 0) | (BIT_12 if self._acknowledge else 0)
        if self._in(od.PROFILE_SPEED):
            off = abs(v - objects.number(od.TARGET_VELOCITY))
            reached = off <= objects.number(od.VELOCITY_WINDOW) or (self._limited and not moving)
            still = abs(v) <= objects.number(od.VELOCITY_THRESHOLD)
            return word | (REACHED if reached else 0) | (BIT_12 if still else 0)
        if self._in(od.HOMING):
            return word | self._homed | (0 if moving else REACHED)
        if self._in(od.CYCLIC_POSITION):
            return word | BIT_12 | (BIT_13 if self._lags(now_ns, objects) else 0)
        return word | (BIT_12 if self.state is DriveState.OPERATION_ENABLED and self._mode in od.FOLLOWED else 0)

    def _lags(self, now_ns: int, objects: Objects) -> bool:
        """Return whether the following error exceeds its window (6065h); FFFFFFFFh switches the supervision off."""
        window = objects.whole(od.FOLLOWING_WINDOW, default=_SPAN - 1)
        if self._wanted is None or window == _SPAN - 1:
            return False
        return abs(self._distance(self._wanted, self.position(now_ns))) > window


def _supported(mode: int, objects: Objects) -> bool:
    """Return whether the drive has this mode according to 6502h. Mode 0 ("no mode") is always accepted."""
    return mode == 0 or (mode > 0 and bool(od.mode_bits(objects) >> (mode - 1) & 1))


def _rate(objects: Objects, index: int, usual: float = _USUAL) -> float:
    """Return the value of an acceleration object, or `usual` if the node lacks it.

    It is at least 1, because a ramp with 0 never ends.
    """
    return max(1.0, float(objects.number(index, default=usual)))


def _fastest(objects: Objects) -> float:
    """Return the maximum profile velocity (607Fh), which limits every mode; there is no limit if it is absent or 0."""
    return float(objects.number(od.MAX_VELOCITY)) or float("inf")


def _inside(place: int, objects: Objects) -> int:
    """Limit a target to the software position limits (607Dh), which apply if the lower one is below the upper one."""
    low, high = objects.whole(od.POSITION_LIMIT, 1), objects.whole(od.POSITION_LIMIT, 2)
    return min(max(place, low), high) if low < high else place


def _wrapped(place: float) -> int:
    """Wrap a position to the 32 bits of 6064h, which a continuously turning drive exceeds."""
    return (round(place) + _SPAN // 2) % _SPAN - _SPAN // 2
