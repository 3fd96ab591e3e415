"""Contact with a field simulator: a child process on this host, or one that was started by hand or in another container.

The result is the same in both cases: a control client, the endpoint to open for each plant endpoint, and the endpoints
of the remote modems. A pseudo-terminal cannot be used from another host: a serial line of a remote field simulator is
carried over TCP, and an emulated connection (`fieldtwin link`) is started on this host.
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.run.processes.link_child import LinkChild
from fieldtwin.twin.plant.mapping import mapped_endpoint
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.system import System

DEFAULT_CONTROL_PORT = 7420
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")


class FieldContact:
    """A connected field simulator."""

    def __init__(self, client: ControlClient, mapping: dict[Endpoint, Endpoint], far: dict[str, Endpoint]) -> None:
        self.client = client
        self.mapping = mapping
        self.far = far
        self.real_buses: frozenset[str] = frozenset()
        """The buses that the prototype file sets to `plant`: their devices are real."""
        self.links: list[LinkChild] = []
        self.life = ""
        """The identity of the simulator's process: a restarted field simulator has a different one."""
        self.listening: dict[str, str] = {}
        self.reported_endpoints: dict[str, str] = {}
        """The endpoints of buses and remote modems, as the field simulator reports them."""
        self.remarks: list[str] = []
        """Differences from a node's data sheet, each with the device's name."""
        self.clients_before: dict[str, dict[str, dict[str, int]]] = {}
        """The counts for each bus and client before this run connected."""
        self.counted_before: dict[str, dict[str, int]] = {}
        """The counters of each device before this run connected, because the field simulator may have served other runs
        before.
        """

    async def aclose(self) -> None:
        await self.client.aclose()
        for link in self.links:
            await link.end()


async def contact_local(client: ControlClient, system: System, run_dir: Path) -> FieldContact:
    """Return the contact with a field simulator that is a child process of this run."""
    return await _contact(client, system, "localhost", run_dir)


async def connect_control(host_port: str, token: str) -> tuple[ControlClient, str]:
    """Connect to the control channel at ``HOST`` or ``HOST:PORT``. Return the client and the host's name."""
    host, colon, port = host_port.rpartition(":")
    if not colon:
        host, port = host_port, str(DEFAULT_CONTROL_PORT)
    if not port.isdigit():
        raise UsageError("the field simulator's address", expected="HOST or HOST:PORT", got=host_port)
    return await ControlClient.connect_tcp(host, int(port), token), host


async def contact_elsewhere(host_port: str, token: str, system: System, run_dir: Path) -> FieldContact:
    """Return the contact with a field simulator that this run did not start; `host_port` is the address of its control
    channel.
    """
    client, host = await connect_control(host_port, token)
    try:
        return await _contact(client, system, host, run_dir)
    except BaseException:
        await client.aclose()
        raise


async def _contact(client: ControlClient, system: System, host: str, run_dir: Path) -> FieldContact:
    status = await client.ask("get", FieldStatus)
    check_same(system, status)
    contact = FieldContact(client, {}, {})
    contact.life, contact.listening, contact.reported_endpoints = status.life, status.listening, status.far
    contact.clients_before = status.clients
    contact.remarks = [f"{name}: {text}" for name, device in status.devices.items() for text in device.remarks]
    contact.counted_before = {name: device.counters for name, device in status.devices.items()}
    try:
        for bus_name, url in status.listening.items():
            plant = system.buses[bus_name].endpoint
            listening = reachable(Endpoint.parse(url), host)
            if plant.is_serial and listening.scheme != "pty":
                link = LinkChild(run_dir / bus_name, listening, run_dir / f"link-{bus_name}.log")
                contact.links.append(link)
                await link.ready()
                listening = Endpoint("pty", path=str(run_dir / bus_name))
            contact.mapping[plant] = mapped_endpoint(plant, listening)
        contact.far = {device: reachable(Endpoint.parse(url), host) for device, url in status.far.items()}
    except BaseException:
        await contact.aclose()
        raise
    contact.real_buses = frozenset(system.buses) - status.listening.keys()
    for name in contact.real_buses:
        contact.mapping[system.buses[name].endpoint] = system.buses[name].endpoint
    return contact


def check_same(system: System, status: FieldStatus) -> None:
    """Raise `FileInvalid` if the status of a field simulator has a different version of the system file."""
    if status.system_hash != system.hash:
        raise FileInvalid(
            f"the field simulator runs a different version of {system.name!r}",
            path=str(system.path),
            expected=f"the same file (hash {system.hash})",
            got=f"{status.system!r} (hash {status.system_hash})",
        )


def reachable(listening: Endpoint, host: str) -> Endpoint:
    """Return the endpoint as this host can reach it: a wildcard address is replaced by the host of the field simulator.

    The host stays a name: a restarted field simulator (for example a container) may have a different address.
    """
    if listening.scheme == "pty":
        if host not in LOCAL_HOSTS:
            raise UsageError(
                "a virtual serial port cannot be used from another host",
                where=str(listening),
                hint="use a tcp:// endpoint for that bus in the prototype file",
            )
        return listening
    if listening.is_can and listening.interface != "fieldtwin":
        return listening
    bound, port = listening.address
    if bound in ("0.0.0.0", "::"):
        return listening.with_address(host, port)
    if bound in LOCAL_HOSTS and host not in LOCAL_HOSTS:
        raise UsageError(
            f"the field simulator listens only on its own loopback: {listening}",
            hint="use an endpoint on 0.0.0.0 for that bus in the prototype file",
        )
    return listening
