"""Outputs of one device that are written together or not at all.

For example, a drive must not be started with its old setpoint because the new setpoint was refused. So the members of a
group are checked before any of them is written: when a program's value for one of them is refused, or does not exist yet, the
others are held back. Adjacent registers are written with one request, and objects that share an RPDO with one frame. All other
members are written in the group's order, each write after the previous one was confirmed. If a communication error interrupts the
writes, it is reported, and the whole group is written again.

The safe state is independent of groups: safe values are written one by one.
"""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.gateway.runtime.outputs.output import Output


class OutputGroup:
    """One group: its members are outputs of one device, in the order of the system file."""

    def __init__(self, name: str, outputs: Sequence[Output]) -> None:
        self.name = name
        self.outputs = tuple(outputs)
        self.reported: tuple[object, ...] = ()
        """The last report to the journal about values that are held back, so that each is reported once."""

    @property
    def obstacle(self) -> tuple[Output, str] | None:
        """Return the member that prevents the group from being written, and the reason; None if nothing prevents it."""
        for output in self.outputs:
            if output.not_a_number or (output.wanted is not None and output.refused == (output.wanted, output.by)):
                return output, f"{output.tag} was refused"
        for output in self.outputs:
            if output.wanted is None:
                return output, f"{output.tag} has no value yet"
        return None

    @property
    def by_programs(self) -> bool:
        """Return whether programs command the group: False while a member has its safe value, or is to get it."""
        return all(output.by in ("plc", "") for output in self.outputs)

    def differing(self) -> list[Output]:
        """Return the members whose device does not hold the wanted value."""
        return [o for o in self.outputs if o.wanted is not None and o.held != o.wanted]


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
