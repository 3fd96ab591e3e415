"""Lists the resources of this computer that a prototype would use, beyond its own run directory and the loopback interface.

An untrusted prototype file may use the plant's own bus, name a CAN interface of the kernel, or listen on the network.
The user is informed before it runs. Nothing is opened here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePosixPath

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.system import System

OUR_BUS = "fieldtwin"
"""The name of the software CAN bus. Every other CAN interface may be a real one."""


def reach(system: System, prototype: Prototype) -> tuple[str, ...]:
    """Return one sentence for each resource that the user must agree to, in the files' order; none if the prototype
    uses no such resource.
    """
    return tuple(dict.fromkeys(_reach(system, prototype)))


def _reach(system: System, prototype: Prototype) -> Iterator[str]:
    for name, bus in prototype.buses.items():
        if bus.listen is None:
            yield f"it opens {system.buses[name].endpoint}, as the plant does (bus {name})"
        else:
            yield from _listening(bus.listen, f"bus {name}")
    for device in prototype.devices.values():
        if device.form.far is not None:
            yield from _listening(Endpoint.parse(device.form.far), f"topside end of {device.name}")
    for section, servers in (("serve", system.serving.serve), ("bridge", system.serving.bridges)):
        for server in servers:
            yield from _listening(server.listen, f"{section} {server.name}")
    for separate in system.serving.listening:
        yield from _reachable(separate.host, f"serve {separate.name}")
    for mqtt in system.serving.mqtt:
        if not _is_loopback(mqtt.broker.host):
            yield f"it publishes the values of all tags at {mqtt.url} (serve {mqtt.name})"


def _listening(at: Endpoint, what: str) -> Iterator[str]:
    if at.is_can:
        if at.interface != OUR_BUS:
            yield f"it sends on {at}, an interface of this computer ({what})"
            return
        host = at.path.rpartition(":")[0]
    elif at.scheme == "pty":
        path = PurePosixPath(at.path)
        if path.is_absolute() or ".." in path.parts:
            yield f"it makes a link at {at.path}, outside of its run directory ({what})"
        return
    elif at.is_serial:
        return  # opened at its mapped endpoint, or refused
    else:
        host = at.host
    yield from _reachable(host, what)


def _reachable(host: str, what: str) -> Iterator[str]:
    if not _is_loopback(host):
        yield f"it listens on {host}, where other computers can reach it ({what})"


def _is_loopback(host: str) -> bool:
    """Return whether `host` is a loopback address.

    No name except localhost counts as one, because the operating system may resolve any other name to another address.
    """
    bare = host.strip("[]")
    return bare in ("localhost", "::1") or (
        bare.startswith("127.") and bare.count(".") == 3 and bare.replace(".", "").isdigit()
    )
