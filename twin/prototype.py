"""The digital twin prototype: the physical twin's own software and configuration, with its devices emulated.

(SPEC rows DigitalTwinPrototype, EmulatedCommunication.) The embedded control system is the very one that runs the plant; only
the far ends of its wires differ.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.clock import Clock
from twin.embedded import EmbeddedControlSystem
from twin.physical import check_commands
from twin.prototype_file import EmulatedDevice, Prototype


@dataclass(frozen=True)
class DigitalTwinPrototype:
    """An embedded control system and what stands in for each of its devices."""

    ecs: EmbeddedControlSystem
    prototype: Prototype

    @property
    def emulated(self) -> dict[str, EmulatedDevice]:
        """The devices that are emulated, by name."""
        return self.prototype.devices

    @property
    def real(self) -> list[str]:
        """The devices that stand on a bus that the prototype file leaves to the plant. Empty for a prototype proper."""
        return [name for name in self.ecs.system.devices if name not in self.emulated]

    def check(self, clock: Clock) -> None:
        """Driver and emulator of every device accept the same commands, or nothing starts (SPEC ruling 12)."""
        drivers = self.ecs.drivers(clock)
        for name, emulated in self.emulated.items():
            check_commands(drivers[name], emulated.profile)
