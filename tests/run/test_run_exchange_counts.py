"""The summary of a prototype run compares the exchanges that the gateway counted with those that the emulators counted."""

from __future__ import annotations

from typing import Any

import pytest

from fieldtwin.run.live.summary import exchange_checks, unanswered_at_stop


def counts(
    requests: int, replies: int, emulated_replies: int, *, timeouts: int = 0, devices: int = 2
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "gateway": {"requests": requests, "replies": replies},
        "emulators": {"requests": requests, "replies": emulated_replies},
        "timeouts": timeouts,
        "crc_errors": 0,
    }
    return row | {"unanswered_at_stop": unanswered_at_stop(row, devices)}


def test_reply_in_transit_when_the_gateway_stops_is_not_an_error() -> None:
    assert exchange_checks({"can0": counts(236, 235, 236)}) == []


@pytest.mark.parametrize("devices", [1, 2])
def test_more_unanswered_requests_than_devices_is_an_error(devices: int) -> None:
    (error,) = exchange_checks({"can0": counts(236, 230, 236, devices=devices)})
    assert error == "can0: the gateway counted 230 replies, the emulators 236"


def test_reply_without_a_request_of_the_gateway_is_an_error() -> None:
    (error,) = exchange_checks({"can0": counts(235, 235, 236)})
    assert error == "can0: the gateway counted 235 replies, the emulators 236"


def test_request_that_timed_out_is_not_counted_as_under_way() -> None:
    assert unanswered_at_stop(counts(236, 235, 235, timeouts=1), 2) == 0
