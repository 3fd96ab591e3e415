"""A CiA 402 drive: state machine, profile position and profile velocity mode, and a motor that follows without error.

Objects and bits after CiA 402-2 and 402-3 (IEC 61800-7-201, -301), as drive makers' manuals print them. Positions are in
increments, speeds in increments a second, accelerations in increments a second squared. What the drive cannot know by itself
(DC link voltage, torque) comes from a recording; what is recorded is never computed. An error that is present in the node,
whoever raised it, is the drive's malfunction; the reset of the fault ends it.
"""

from __future__ import annotations

from dataclasses import dataclass

from emulators.canopen.aborts import Abort
from emulators.canopen.behaviour import DeviceModel, Number, Objects, Outcome, Situation
from emulators.canopen.dictionary import Key
from emulators.models.drive_states import Cause, DriveState, Transition, command_of, transition
from emulators.models.motion import Motion, to_place, to_speed
from gateway.core.clock import NS_PER_S

ERROR_CODE, CONTROLWORD, STATUSWORD = 0x603F, 0x6040, 0x6041
ABORT_CONNECTION, QUICK_STOP_OPTION, SHUTDOWN_OPTION, DISABLE_OPTION, HALT_OPTION, FAULT_OPTION = (
    0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E,
)  # fmt: skip
MODE, MODE_DISPLAY, SUPPORTED_MODES = 0x6060, 0x6061, 0x6502
POSITION_DEMAND, POSITION_ACTUAL, VELOCITY_DEMAND, VELOCITY_ACTUAL = 0x6062, 0x6064, 0x606B, 0x606C
VELOCITY_WINDOW, VELOCITY_THRESHOLD = 0x606D, 0x606F
TARGET_POSITION, POSITION_LIMIT, MAX_VELOCITY = 0x607A, 0x607D, 0x607F
PROFILE_VELOCITY, ACCELERATION, DECELERATION, QUICK_DECELERATION = 0x6081, 0x6083, 0x6084, 0x6085
TARGET_VELOCITY = 0x60FF

PROFILE_POSITION, PROFILE_SPEED = 1, 3
"""Modes of operation that this model has; 6502h says them by bit (mode - 1)."""

NEW_SET_POINT, AT_ONCE, RELATIVE, HALT = 1 << 4, 1 << 5, 1 << 6, 1 << 8
"""Bits of the controlword in profile position mode; halt is every mode's."""

VOLTAGE, REMOTE, REACHED, LIMITED, BIT_12 = 1 << 4, 1 << 9, 1 << 10, 1 << 11, 1 << 12
"""Bits of the statusword. Bit 12 is set-point acknowledge, or in profile velocity mode "speed is zero"."""

HEARTBEAT_LOST, BUS_OFF = 0x8130, 0x8140
_COMMUNICATION = frozenset({HEARTBEAT_LOST, BUS_OFF})
_REACTIONS = {1: Cause.ERROR, 2: Cause.DISABLE_VOLTAGE, 3: Cause.QUICK_STOP}
"""Abort connection option code 6007h: what the loss of the connection does."""

_SPAN = 1 << 32


@dataclass(frozen=True, slots=True)
class _SetPoint:
    position: int
    velocity: float
    acceleration: float
    deceleration: float


class Drive(DeviceModel):
    """One axis. `self_test_s` is how long it is not ready to switch on; `coasting` how an unpowered motor slows down."""

    def __init__(self, *, self_test_s: float = 0.02, coasting: float = 20_000.0) -> None:
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
        self._seen: frozenset[int] = frozenset()

    # -- what the mechanics of a twin ask -----------------------------------------------------------------------------

    def position(self, now_ns: int) -> float:
        """Increments since the first power-on, without the wrap of 6064h's 32 bits."""
        return self._motion.at((now_ns - self._began_ns) / NS_PER_S)[0]

    def velocity(self, now_ns: int) -> float:
        """Increments a second."""
        return self._motion.at((now_ns - self._began_ns) / NS_PER_S)[1]

    # -- what the node asks -------------------------------------------------------------------------------------------

    def power_on(self, situation: Situation) -> None:
        self._ramp(situation.now_ns, 0.0, self._coasting)
        self._restart(situation.now_ns)

    def refuse(self, key: Key, value: Number, objects: Objects) -> Abort | None:
        return None if key != (MODE, 0) or _supported(int(value), objects) else Abort.VALUE

    def step(self, situation: Situation) -> Outcome:
        now_ns, objects = situation.now_ns, situation.objects
        self._by_itself(now_ns, objects)
        self._mind_errors(situation)
        if (MODE, 0) in situation.written or (self._mode == 0 and _supported(objects.whole(MODE), objects)):
            self._change_mode(now_ns, objects)
        if (CONTROLWORD, 0) in situation.written:
            self._obey(now_ns, objects)
        if self._in(PROFILE_SPEED) and {(TARGET_VELOCITY, 0), (ACCELERATION, 0), (DECELERATION, 0)} & set(
            situation.written
        ):
            self._follow_speed(now_ns, objects)
        clears = (
            situation.errors if self.state is DriveState.SWITCH_ON_DISABLED and self.transitions[-1:] == [15] else ()
        )
        return self._outcome(situation, tuple(code for code in clears if code not in _COMMUNICATION))

    # -- state machine ------------------------------------------------------------------------------------------------

    def _by_itself(self, now_ns: int, objects: Objects) -> None:
        """What fell due since it was asked last: the self-test, the end of a ramp."""
        if self._ready_ns is not None and now_ns >= self._ready_ns:
            self._ready_ns = None
            self._go(Cause.INITIALISED, now_ns, objects)
        if now_ns < self._end_ns():
            return
        if self.state is DriveState.QUICK_STOP:
            self._go(Cause.STOPPED, now_ns, objects)
        elif self.state is DriveState.FAULT_REACTION:
            self._go(Cause.REACTED, now_ns, objects)
        elif self._queue is not None and self._in(PROFILE_POSITION) and not self._controlword & HALT:
            queued, self._queue = self._queue, None
            self._acknowledge = bool(self._controlword & NEW_SET_POINT)
            self._move_to(queued, now_ns)

    def _mind_errors(self, situation: Situation) -> None:
        present = frozenset(situation.errors)
        arisen, self._seen = present - self._seen, present
        for code in sorted(arisen):
            cause: Cause | None = Cause.ERROR
            if code in _COMMUNICATION:
                cause = _REACTIONS.get(situation.objects.whole(ABORT_CONNECTION, default=1))
            if cause is not None:
                self._go(cause, situation.now_ns, situation.objects)

    def _obey(self, now_ns: int, objects: Objects) -> None:
        """A controlword came. The same one can take two arrows: switch on and enable operation in one."""
        before, self._controlword = self._controlword, objects.whole(CONTROLWORD)
        command = command_of(self._controlword, before)
        if command is Cause.FAULT_RESET and self._disconnected(objects):
            return  # what made it a fault is still there
        for _ in range(2):
            if command is None or self._go(command, now_ns, objects) is None:
                break
        if self.state is not DriveState.OPERATION_ENABLED:
            return
        if (self._controlword ^ before) & HALT:
            self._halt_or_go_on(now_ns, objects)
        if self._mode == PROFILE_POSITION:
            self._take_set_point(before, now_ns, objects)

    def _disconnected(self, objects: Objects) -> bool:
        return bool(self._seen & _COMMUNICATION) and objects.whole(ABORT_CONNECTION, default=1) == 1

    def _go(self, cause: Cause, now_ns: int, objects: Objects) -> Transition | None:
        """Take the arrow that `cause` means here, if there is one, with what it does to the motor."""
        option = objects.whole(QUICK_STOP_OPTION, default=2)
        taken = transition(self.state, cause, stays_stopped=option >= 5)
        if taken is None:
            return None
        powered, self.state = self.state.powered, taken.target
        self.transitions = [*self.transitions[-63:], taken.number]
        if taken.number in (4, 16):
            self._take_up(now_ns, objects)
        elif taken.number == 5:
            self._slow_down(objects.whole(DISABLE_OPTION, default=1), now_ns, objects)
        elif taken.number == 8:
            self._slow_down(objects.whole(SHUTDOWN_OPTION), now_ns, objects)
        elif taken.number == 11:
            self._slow_down(option - 4 if option >= 5 else option, now_ns, objects)
            if option == 0:
                self._go(Cause.STOPPED, now_ns, objects)
        elif taken.number == 13:
            if powered:
                self._slow_down(objects.whole(FAULT_OPTION, default=2), now_ns, objects)
            if not powered or objects.whole(FAULT_OPTION, default=2) == 0:
                self._go(Cause.REACTED, now_ns, objects)
        elif taken.number in (9, 12):
            self._ramp(now_ns, 0.0, self._coasting)
        return taken

    # -- motion -------------------------------------------------------------------------------------------------------

    def _in(self, mode: int) -> bool:
        return self._mode == mode and self.state is DriveState.OPERATION_ENABLED

    def _end_ns(self) -> int:
        """When the present ramps are over."""
        return self._began_ns + round(self._motion.duration_s * NS_PER_S)

    def _ramp(self, now_ns: int, speed: float, acceleration: float, deceleration: float = 0.0) -> None:
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        self._motion = Motion(x, v, to_speed(v, speed, acceleration, deceleration or acceleration))
        self._began_ns = now_ns

    def _slow_down(self, option: int, now_ns: int, objects: Objects) -> None:
        """Option codes: 0 the motor coasts, 1 the profile's ramp, 2 and above the quick stop's (3, 4: as fast as can be)."""
        rates = {0: self._coasting, 1: _rate(objects, DECELERATION)}
        self._ramp(now_ns, 0.0, rates.get(option, _rate(objects, QUICK_DECELERATION)))
        self._target = self._queue = None

    def _take_up(self, now_ns: int, objects: Objects) -> None:
        """Operation begins or goes on: the mode has the motor."""
        self._target = self._queue = None
        self._acknowledge = False
        if self._mode == PROFILE_SPEED and not self._controlword & HALT:
            self._follow_speed(now_ns, objects)
        else:
            self._ramp(now_ns, 0.0, _rate(objects, DECELERATION))

    def _change_mode(self, now_ns: int, objects: Objects) -> None:
        mode = objects.whole(MODE)
        if not _supported(mode, objects) or mode == self._mode:
            return  # by RPDO nobody can be refused: the display keeps the mode that is
        self._mode = mode
        if self.state is DriveState.OPERATION_ENABLED:
            self._take_up(now_ns, objects)

    def _follow_speed(self, now_ns: int, objects: Objects) -> None:
        if self._controlword & HALT:
            return
        wanted = objects.number(TARGET_VELOCITY)
        most = objects.number(MAX_VELOCITY) or float("inf")
        self._limited = abs(wanted) > most
        speed = max(-most, min(most, wanted))
        self._ramp(now_ns, speed, _rate(objects, ACCELERATION), _rate(objects, DECELERATION))

    def _halt_or_go_on(self, now_ns: int, objects: Objects) -> None:
        if self._controlword & HALT:
            kept = self._target, self._queue
            self._slow_down(objects.whole(HALT_OPTION, default=1), now_ns, objects)
            self._target, self._queue = kept
        elif self._mode == PROFILE_SPEED:
            self._follow_speed(now_ns, objects)
        elif self._target is not None:
            self._move_to(self._target, now_ns)

    def _take_set_point(self, before: int, now_ns: int, objects: Objects) -> None:
        """Profile position's handshake: bit 4 offers a set-point, bit 12 takes it until bit 4 is gone. One can wait."""
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
        place = objects.whole(TARGET_POSITION)
        if self._controlword & RELATIVE:
            place += self._target.position if self._target else _wrapped(self.position(now_ns))
        low, high = objects.whole(POSITION_LIMIT, 1), objects.whole(POSITION_LIMIT, 2)
        inside = min(max(place, low), high) if low < high else place
        self._limited = inside != place
        most = objects.number(MAX_VELOCITY) or float("inf")
        speed = min(objects.number(PROFILE_VELOCITY), most)
        return _SetPoint(_wrapped(inside), speed, _rate(objects, ACCELERATION), _rate(objects, DECELERATION))

    def _move_to(self, to: _SetPoint, now_ns: int) -> None:
        self._target = to
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        distance = to.position - (x if abs(x) < _SPAN / 2 else _wrapped(x))
        ramps = to_place(distance, v, max(to.velocity, 1e-9), to.acceleration, to.deceleration)
        self._motion, self._began_ns = Motion(x, v, ramps), now_ns

    # -- what the objects hold ----------------------------------------------------------------------------------------

    def _outcome(self, situation: Situation, clears: tuple[int, ...]) -> Outcome:
        now_ns, objects = situation.now_ns, situation.objects
        x, v = self._motion.at((now_ns - self._began_ns) / NS_PER_S)
        in_fault = self.state in (DriveState.FAULT, DriveState.FAULT_REACTION)
        error = situation.errors[-1] if in_fault and situation.errors else 0
        states = {
            (STATUSWORD, 0): self._statusword(now_ns, v, objects),
            (MODE_DISPLAY, 0): self._mode,
            (ERROR_CODE, 0): error,
        }
        place, speed = _wrapped(x), round(v)
        readings = {
            (POSITION_ACTUAL, 0): place, (POSITION_DEMAND, 0): place,
            (VELOCITY_ACTUAL, 0): speed, (VELOCITY_DEMAND, 0): speed,
        }  # fmt: skip
        recorded = situation.played.keys()
        end_ns = self._end_ns()
        wakes = [t for t in (self._ready_ns, end_ns if end_ns > now_ns else None) if t is not None]
        return Outcome(
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
        if self._in(PROFILE_POSITION):
            reached = not moving and self._queue is None
            return word | (REACHED if reached else 0) | (BIT_12 if self._acknowledge else 0)
        if self._in(PROFILE_SPEED):
            off = abs(v - objects.number(TARGET_VELOCITY))
            reached = off <= objects.number(VELOCITY_WINDOW) or (self._limited and not moving)
            still = abs(v) <= objects.number(VELOCITY_THRESHOLD)
            return word | (REACHED if reached else 0) | (BIT_12 if still else 0)
        return word


def _supported(mode: int, objects: Objects) -> bool:
    """Whether the drive has this mode: this model knows two, and 6502h may say fewer. 0 is no mode, which is always."""
    if mode == 0:
        return True
    said = objects.whole(SUPPORTED_MODES, default=-1)
    return mode in (PROFILE_POSITION, PROFILE_SPEED) and bool(said >> (mode - 1) & 1)


def _rate(objects: Objects, index: int) -> float:
    """An acceleration object; 0 would never get anywhere, so 1 is the least."""
    return max(1.0, float(objects.number(index, default=10_000)))


def _wrapped(place: float) -> int:
    """Within the 32 bits of 6064h, which a drive that turns for ever runs round."""
    return (round(place) + _SPAN // 2) % _SPAN - _SPAN // 2
