"""The properties of a CAN endpoint that can be determined without joining its bus, opening it or sending frames."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable


@dataclass(frozen=True, slots=True)
class CanFacts:
    """Properties of a CAN endpoint.

    `bitrate` is that of the medium in bit/s, 0 if unknown. `needs_bitrate` says that the endpoint has to name a bit rate (an
    adapter). `listen_only` says that the interface is in listen-only mode, `can_listen_only` that ``?listen=1`` is possible.
    `state`, `tx_errors` and `rx_errors` are those of the controller, if the driver reports them.
    """

    interface: str
    bitrate: int = 0
    needs_bitrate: bool = False
    listen_only: bool = False
    can_listen_only: bool = False
    state: str = ""
    tx_errors: int = 0
    rx_errors: int = 0


def can_facts(endpoint: Endpoint) -> CanFacts:
    """Return the properties of an endpoint, from the kernel or from the URL.

    Raises `Unreachable` for a kernel interface that does not exist."""
    interface = endpoint.interface
    if interface == "fieldtwin":
        return CanFacts(interface)
    if interface == "socketcan":
        return _of_kernel(endpoint)
    from fieldtwin.gateway.connections.can.adapter import RATELESS, can_listen_only

    said = endpoint.param("bitrate", "")
    return CanFacts(
        interface,
        bitrate=int(said) if said.isascii() and said.isdigit() else 0,
        needs_bitrate=interface not in RATELESS,
        listen_only=endpoint.param("listen") == "1",
        can_listen_only=can_listen_only(endpoint),
    )


def _of_kernel(endpoint: Endpoint) -> CanFacts:
    from fieldtwin.gateway.connections.can.netlink import query_link

    try:
        link = query_link(endpoint.path)
    except (OSError, AttributeError) as e:  # AttributeError: an operating system without netlink
        text = getattr(e, "strerror", None) or str(e)
        raise Unreachable(
            f"no such CAN interface: {text}", where=str(endpoint), hint="ip -brief link show type can"
        ) from e
    return CanFacts(
        "socketcan",
        bitrate=link.bitrate,
        listen_only=link.listen_only,
        state=link.state,
        tx_errors=link.tx_errors,
        rx_errors=link.rx_errors,
    )
