"""The topside modem of a network, on its own socket: it sends the commands of the topside controller."""

from __future__ import annotations

from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.schema import SHIP
from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.ports import Listening, Ports
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.modbus.acoustic_link import AcousticLink
from fieldtwin.emulators.models.modbus.emulated_modbus import unit_limits
from fieldtwin.emulators.models.modbus.mailbox_modem import MailboxModem
from fieldtwin.emulators.wires.acoustic import AcousticMedium
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.run.processes.topside import Scripted, script

MOST_CLIENTS = 4
FIRST_S = 1.0
BASE_S = 10
"""The default command of the topside modem: a sample period of 10 s, sent `FIRST_S` after the start."""
ENDLESS_S = 20.0
"""The time in seconds over which the commands of a run without an end are spread."""


def scripted_commands(network: Network, commands: tuple[int, ...] | None, duration_s: float) -> list[Scripted]:
    """Return the commands of the topside modem in a run, spread over `duration_s` seconds (0: `ENDLESS_S`).

    `commands` are sample periods in seconds; None stands for the default command. A network without a topside modem has no
    commands.
    """
    if network.ship is None:
        return []
    if commands is None:
        return [Scripted(FIRST_S, BASE_S)]
    return script(commands, duration_s or ENDLESS_S) if commands else []


class TopsideModem:
    """The topside modem, served over Modbus TCP at the endpoint that ``await modem.open(ports)`` returns.

    It has the same device profile and unit ID as the modem of the first system.
    """

    def __init__(self, network: Network, medium: AcousticMedium, clock: Clock) -> None:
        assert network.ship is not None
        self.like = next(iter(network.members.values()))
        self._clock = clock
        link = AcousticLink(medium, SHIP, times=network.ship.says, every_ns=round(network.ship.every_s * NS_PER_S))
        self._unit = ModbusUnit(
            MailboxModem(self.like.profile, link, link), unit_limits(self.like.profile), name="ship's modem"
        )
        self._listener: Listening | None = None

    async def open(self, ports: Ports) -> Endpoint:
        """Start to listen and return the endpoint. Raises `EndpointBusy`."""
        server = MbapServer({self.like.system.devices[self.like.modem].address: self._unit})
        self._listener = await ports.listen(
            Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, server, self._clock, 0.0), MOST_CLIENTS
        )
        return self._listener.bound

    async def aclose(self) -> None:
        if self._listener is not None:
            await self._listener.aclose()
