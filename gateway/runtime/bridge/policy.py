"""The allow-list of a bridge: which client networks and roles may use which units, functions and address ranges. Every
other request is refused.

The addresses and roles of clients are text, and requests are `ServerRequest`. This module does no I/O.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.modbus.server.analysis import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    NO_PATH,
    READ_FUNCTIONS,
    ServerRequest,
)

Network = IPv4Network | IPv6Network

LINE = "line"
"""The address of the client on a serial line, which has no network address."""

ALLOWED = 0


def network(text: str) -> Network:
    """Return the network that a text such as ``10.0.0.0/24``, ``10.0.0.7`` or ``fd00::/8`` describes. Raises `UsageError`."""
    try:
        return ip_network(text)
    except ValueError as e:
        raise UsageError("a network of clients", expected="an address, or one such as 10.0.0.0/24", got=text) from e


LOOPBACK = (network("127.0.0.0/8"), network("::1/128"))
EVERYONE = (network("0.0.0.0/0"), network("::/0"))


@lru_cache(maxsize=1024)
def within(peer: str, networks: tuple[Network, ...]) -> bool:
    """Return whether a client's address is in one of `networks`; an IPv4 address in IPv6 form counts as IPv4."""
    try:
        address = ip_address(peer.partition("%")[0])
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return any((mapped or address) in net for net in networks)


@dataclass(frozen=True)
class AllowRule:
    """A rule for the requests of clients in `networks`.

    `units` are unit IDs as the client sends them; None: every unit. `addresses` holds first and last address by table; None:
    every address. If it is given, a table that it does not name is not allowed, nor is a function without register addresses.
    `roles` limits the rule to clients whose certificate has one of these roles (MBTLS 8.4); None: every client, with or without a
    certificate.
    """

    networks: tuple[Network, ...] = LOOPBACK
    units: frozenset[int] | None = None
    functions: frozenset[int] = READ_FUNCTIONS
    addresses: Mapping[str, tuple[tuple[int, int], ...]] | None = None
    roles: frozenset[str] | None = None

    def admits(self, peer: str) -> bool:
        return peer == LINE or within(peer, self.networks)

    def is_for(self, role: str) -> bool:
        return self.roles is None or role in self.roles

    def check(self, unit: int, asked: ServerRequest) -> int:
        """Return `ALLOWED`, or the exception code of the first check that fails: unit, function, address."""
        if self.units is not None and unit not in self.units:
            return NO_PATH
        if asked.function not in self.functions or (asked.changes and not self.functions - READ_FUNCTIONS):
            return ILLEGAL_FUNCTION
        if self.addresses is None:
            return ALLOWED
        if not asked.accesses:
            return ILLEGAL_FUNCTION
        for access in asked.accesses:
            last = access.address + access.count - 1
            ranges = self.addresses.get(access.table, ())
            if not any(low <= access.address and last <= high for low, high in ranges):
                return ILLEGAL_ADDRESS
        return ALLOWED


_FARTHEST = (ILLEGAL_ADDRESS, ILLEGAL_FUNCTION, NO_PATH)


@dataclass(frozen=True)
class Policy:
    """An allow-list: a request passes when one rule allows all of it.

    Without `allow_writes`, no request that may change a unit passes, even if a rule allows it.
    """

    rules: tuple[AllowRule, ...] = (AllowRule(),)
    allow_writes: bool = False

    def admits(self, peer: str) -> bool:
        """Return whether a client from `peer` may connect at all."""
        return any(rule.admits(peer) for rule in self.rules)

    def check(self, peer: str, unit: int, asked: ServerRequest, role: str = "") -> int:
        """Return `ALLOWED`, or the exception code to answer with: 0A for a unit, 01 for a function or a role (MBTLS
        8.5), 02 for an address."""
        verdicts = {
            rule.check(unit, asked) if rule.is_for(role) else ILLEGAL_FUNCTION
            for rule in self.rules
            if rule.admits(peer)
        }
        if ALLOWED in verdicts:
            return ALLOWED if self.allow_writes or not asked.changes else ILLEGAL_FUNCTION
        return next((code for code in _FARTHEST if code in verdicts), NO_PATH)
