"""Outputs of one device that are written together or not at all.

A drive that is started with its old setpoint because the new one was refused is worse than one that is not started. So
the members of a group are checked before any of them is written: when a program's value for one of them is refused, or
does not exist yet, the others are held back. Adjacent registers are written with one request, and objects that share an
RPDO with one frame. All other members are written in the group's order, each write after the previous one was
confirmed. If a communication error interrupts the writes, it is reported, and the whole group is written again.

The safe state is independent of groups: safe values are written one by one, whatever the programs want.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.devices.register_device import Progress, RegisterDriver
from fieldtwin.gateway.runtime.buses.modbus_bus import Job, ModbusBus
from fieldtwin.gateway.runtime.outputs.output import Output
from fieldtwin.gateway.runtime.outputs.refusals import HeldBack

Ended = Callable[[Output, FieldtwinError | None], None]
"""Called once for each member with the result of its write."""


class OutputGroup:
    """The members of one group, in the order of the system file. They are outputs of one device."""

    def __init__(self, name: str, outputs: Sequence[Output]) -> None:
        self.name = name
        self.outputs = tuple(outputs)
        self.told: tuple[object, ...] = ()
        """The last report to the journal about values that are held back, so that each is reported once."""

    @property
    def obstacle(self) -> tuple[Output, str] | None:
        """The member that prevents the group from being written, and the reason; None if nothing prevents it."""
        for output in self.outputs:
            if output.not_a_number or (output.wanted is not None and output.refused == (output.wanted, output.by)):
                return output, f"{output.tag} was refused"
        for output in self.outputs:
            if output.wanted is None:
                return output, f"{output.tag} has no value yet"
        return None

    @property
    def by_programs(self) -> bool:
        """Whether programs command the group: False while a member is at its safe value or on the way to it."""
        return all(output.by in ("plc", "") for output in self.outputs)

    def differing(self) -> list[Output]:
        """Return the members whose device does not hold the wanted value."""
        return [o for o in self.outputs if o.wanted is not None and o.held != o.wanted]

    def submit(self, commands: Sequence[COMMAND], ended: Ended) -> None:
        """Write all members. `commands` are the members' commands, in the same order."""
        first = self.outputs[0]
        if isinstance(first.driver, RegisterDriver) and isinstance(first.bus, ModbusBus):
            self._submit_registers(first.driver, first.bus, commands, ended)
        else:
            _InOrder(self.outputs, commands, ended).next()

    def _submit_registers(
        self, driver: RegisterDriver, bus: ModbusBus, commands: Sequence[COMMAND], ended: Ended
    ) -> None:
        progress = Progress()

        def done(error: FieldtwinError | None) -> None:
            for output in self.outputs:
                if output.local in progress.confirmed:
                    ended(output, None)
                else:
                    unsent = bool(progress.sent) and output.local not in progress.sent
                    ended(output, _not_sent(output) if unsent else error)

        bus.submit(Job(driver, partial(driver.write_together, commands, progress), done))


class _InOrder:
    """Writes outputs one after another, and those that share a frame together. After a failed write the rest are not
    sent."""

    def __init__(self, outputs: Sequence[Output], commands: Sequence[COMMAND], ended: Ended) -> None:
        self._ended = ended
        self._steps: list[list[tuple[Output, COMMAND]]] = []
        frames: dict[object, list[tuple[Output, COMMAND]]] = {}
        for output, command in zip(outputs, commands, strict=True):
            frame = output.frame
            step = frames.get(frame) if frame is not None else None
            if step is None:
                self._steps.append(step := [])
                if frame is not None:
                    frames[frame] = step
            step.append((output, command))
        self._open = 0
        self._error: FieldtwinError | None = None

    def next(self) -> None:
        """Start the next step, or end the remaining steps after a failure."""
        if self._error is not None:
            rest, self._steps = self._steps, []
            for output, _ in (item for step in rest for item in step):
                self._ended(output, _not_sent(output))
        elif self._steps:
            step = self._steps.pop(0)
            self._open = len(step)
            for output, command in step:
                output.submit(command, partial(self._done, output))

    def _done(self, output: Output, error: FieldtwinError | None) -> None:
        self._error = self._error or error
        self._ended(output, error)
        self._open -= 1
        if not self._open:
            self.next()


def _not_sent(output: Output) -> HeldBack:
    return HeldBack("not sent: the write of another member of its group failed", where=output.driver.config.where)


def groups_of(outputs: Sequence[Output]) -> list[OutputGroup]:
    """Return the groups that the devices of `outputs` declare."""
    found = []
    by_tag = {output.tag: output for output in outputs}
    for config in {id(o.driver): o.driver.config for o in outputs}.values():
        for name, tags in config.write_groups.items():
            members = [by_tag[tag] for tag in (f"{config.name}.{local}" for local in tags) if tag in by_tag]
            if members:
                found.append(OutputGroup(name, members))
    return found
