"""Counts the requests of a connection that stay unanswered, to decide when the connection is useless.

A firewall or a crash can leave a TCP connection half open: everything that is sent on it is lost without an error (TG 4.2.2).
Pure: reads the counters of a `ModbusClient`, and never touches the connection.
"""

from __future__ import annotations

from fieldtwin.gateway.protocols.modbus.client import ModbusClient

MOST_UNANSWERED = 5
"""After so many timeouts in a row a socket is useless."""


class Unanswered:
    """The timeouts of `client` since its latest reply.

    Those of hurried units, which polls and probes are, count only while no device is online: devices that are away are asked
    often beside a device that is rarely polled, and their silence says nothing about the connection. A shortened timeout
    counts as the part of the unit's own timeout that it is.
    """

    def __init__(self, client: ModbusClient) -> None:
        self._client = client
        self._answered = 0
        self._others = 0
        self._waited = 0.0

    def too_many(self, any_online: bool) -> bool:
        """Return whether the connection should be made anew. `any_online`: whether a device counts as online."""
        client, counters = self._client, self._client.counters
        answered = counters.replies + counters.exceptions
        others, waited = counters.timeouts - client.hurried_timeouts, counters.timeouts - client.not_waited
        if answered != self._answered:
            self._answered, self._others, self._waited = answered, others, waited
            return False
        if others - self._others >= MOST_UNANSWERED:
            return True
        return not any_online and waited - self._waited >= MOST_UNANSWERED
