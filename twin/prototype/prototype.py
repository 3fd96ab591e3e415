"""The digital twin prototype: the physical twin's own software and configuration, with every device emulated.

This is the only module that combines the two sides of the connection: it checks that each emulator accepts its driver's
commands, and makes the simulated field devices. The controlling side is `fieldtwin.twin.plant.physical`, which is unchanged and
does not depend on this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fieldtwin.emulators.emulator import EmulatedCommunication
from fieldtwin.emulators.endpoints.ports import Ports
from fieldtwin.emulators.models.modbus.packet_link import ModemEnd
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.physical import EmbeddedControlSystem
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.system import System


class DigitalTwinPrototype:
    """The paper's DigitalTwinPrototype. Raises `CommandListMismatch` if the command lists of an emulator and its driver
    differ (paper.md, ruling 12).

    `ecs` is the physical twin's class, made from the same system file; `model` is a separate instance. `real` names the
    devices that are not emulated, on buses that the prototype file marks `plant`; a complete prototype has none.
    """

    def __init__(self, system: System, prototype: Prototype, clock: Clock) -> None:
        self.ecs = EmbeddedControlSystem(system)
        self.model = DigitalModel(declared_variables(system))
        self.prototype = prototype
        self.real = tuple(name for name in system.devices if name not in prototype.devices)
        self._clock = clock
        driver_commands = self.ecs.command_lists(clock)
        self.communications = {
            name: EmulatedCommunication(name, driver_commands[name], emulated.profile.command_list)
            for name, emulated in prototype.devices.items()
        }
        for communication in self.communications.values():
            communication.check()

    def field(
        self, run_dir: Path, ports: Ports | None = None, water: Mapping[str, ModemEnd] | None = None
    ) -> FieldSimulator:
        """Return the emulators on their connections, not opened yet.

        The connections are the operating system's unless other `ports` are given. The symbolic links of virtual serial ports
        are created in `run_dir`. `water`: the acoustic connections of transmitters that are in a network.
        """
        return FieldSimulator(self.ecs.system, self.prototype, run_dir, self._clock, ports, water)
