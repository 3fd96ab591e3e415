"""Counts the requests of each client of an emulated bus, and their replies.

A prototype run (the gateway with emulated devices) compares the requests that its gateway
sent with those that its emulators received. A third-party program that reads an emulator must not disturb this comparison.
The requests of each client are therefore counted separately, by the address from which the client connects. This module does
not depend on a protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

MOST_CLIENTS = 1024
"""The number of addresses that are kept in addition to those of open connections. The counts of older addresses are kept as a
sum.
"""
OLDER = "older clients"


@dataclass(slots=True)
class ClientTraffic:
    """Requests that reached a device, and their replies. While the client is connected (`open`), its counts are kept."""

    requests: int = 0
    replies: int = 0
    open: bool = False


class ClientCounts:
    """The counts of one bus, by client: ``HOST:PORT`` as the emulator sees it."""

    def __init__(self) -> None:
        self._by_client: dict[str, ClientTraffic] = {}

    def of(self, client: str) -> ClientTraffic:
        """Return the counts of a client, for the caller to increase.

        The object stays the same while the client is remembered.
        """
        found = self._by_client.get(client)
        if found is None:
            self._forget_oldest()
            found = self._by_client[client] = ClientTraffic()
        return found

    def add(self, client: str, requests: int, replies: int) -> None:
        """Add numbers of requests and replies to the counts of a client."""
        counts = self.of(client)
        counts.requests += requests
        counts.replies += replies

    def describe(self) -> dict[str, dict[str, int]]:
        """Return JSON-able counts: by client, its requests and replies."""
        return {name: {"requests": c.requests, "replies": c.replies} for name, c in self._by_client.items()}

    def _forget_oldest(self) -> None:
        if len(self._by_client) > MOST_CLIENTS:
            name = next((name for name, c in self._by_client.items() if name != OLDER and not c.open), None)
            if name is not None:
                gone = self._by_client.pop(name)
                self.add(OLDER, gone.requests, gone.replies)


class CountDifference:
    """Assigns the traffic of a serial line to its clients, of which only one is connected at a time.

    `totals` returns the numbers of requests and replies of all devices on the line so far. The increase since the last call is
    added to the counts of the present client.
    """

    def __init__(self, clients: ClientCounts, totals: Callable[[], tuple[int, int]]) -> None:
        self._clients = clients
        self._totals = totals
        self._last = totals()
        self._client = ""

    def change(self, client: str) -> None:
        """Assign the traffic of the line to `client` from now on. An empty name means that no client is connected."""
        self.settle()
        self._client = client

    def settle(self) -> None:
        """Add the traffic since the last call to the counts of the present client."""
        requests, replies = self._totals()
        if self._client and (requests, replies) != self._last:
            self._clients.add(self._client, requests - self._last[0], replies - self._last[1])
        self._last = requests, replies
