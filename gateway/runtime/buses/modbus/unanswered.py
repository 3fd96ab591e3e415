"""Counts the requests of a connection that stay unanswered, to decide when the connection is useless.

A firewall or a crash can leave a TCP connection half open: everything that is sent on it is lost without an error (TG
4.2.2). This module only reads the counters of a `ModbusClient`; it does not use the connection.
"""

from __future__ import annotations

from fieldtwin.gateway.protocols.modbus.client import ModbusClient

MOST_UNANSWERED = 5
"""After this number of successive timeouts a connection is useless."""


class Unanswered:
    """The timeouts of `client` since its latest reply.

    Timeouts of requests with a shortened timeout (`UnitTiming.shorten_timeout`) count only while no device is online: devices
    that are away may be probed often while an online device is rarely polled, and their silence shows nothing about the
    connection. A shortened timeout counts as the fraction that it is of the unit's own timeout.
    """

    def __init__(self, client: ModbusClient) -> None:
        self._client = client
        self._answered = 0
        self._others = 0
        self._waited = 0.0

    def too_many(self, any_online: bool) -> bool:
        """Return whether the connection should be closed and opened again.

        `any_online` says whether at least one device is online.
        """
        client, counters = self._client, self._client.counters
        answered = counters.replies + counters.exceptions
        others, waited = (
            counters.timeouts - client.units.shortened_timeouts,
            counters.timeouts - client.units.not_waited,
        )
        if answered != self._answered:
            self._answered, self._others, self._waited = answered, others, waited
            return False
        if others - self._others >= MOST_UNANSWERED:
            return True
        return not any_online and waited - self._waited >= MOST_UNANSWERED
