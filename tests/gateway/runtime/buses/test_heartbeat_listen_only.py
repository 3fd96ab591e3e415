"""A heartbeat consumer that does not write the node's producer time: `heartbeat: {consumer_ms: N}`.

Defects: the gateway could monitor a node only by writing its heartbeat producer time (1017h). A plant with configured nodes
had to allow that write or go without monitoring. With a heartbeat in the system file, values of a change-driven TPDO never
became stale, even from a node without a heartbeat, whose loss would not be detected.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from gateway_canopen_rig import NODE, SDO_TO_NODE, rig
from pydantic import ValidationError
from support import eventually, run

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.devices.config import Heartbeat
from fieldtwin.gateway.protocols.canopen.nmt.heartbeat import HeartbeatConsumer
from fieldtwin.twin.site.schema import HeartbeatForm

LISTEN = Heartbeat(None, 150)


def producer_writes(frames: list[CanFrame]) -> list[CanFrame]:
    """SDO downloads to 1017h."""
    return [f for f in frames if f.can_id == SDO_TO_NODE and f.data[0] >> 5 == 1 and f.data[1:3] == b"\x17\x10"]


def test_a_node_that_produces_heartbeats_is_watched_and_its_producer_time_is_not_written(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, heartbeat=LISTEN) as r:
            node = r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none") and r.status.online)
            assert not r.status.driver.is_watched  # the node's own producer time is 0
            operator = r.server.attach("operator")  # another NMT master configures the node
            await operator.send(CanFrame(SDO_TO_NODE, bytes.fromhex("2B 17 10 00 28 00 00 00")))
            await eventually(lambda: r.status.driver.is_watched)
            await operator.aclose()
            assert len(producer_writes(r.frames)) == 1  # the operator's
            assert node.counters is not None
            await r.unplug_node()
            await eventually(lambda: r.quality("slope_long") == ("bad", "heartbeat lost"))
            assert not r.status.online

    run(main())


def test_a_node_that_produces_no_heartbeat_does_not_count_as_monitored(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, heartbeat=LISTEN) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none") and r.status.online)
            driver = r.status.driver
            driver._by_change = frozenset({"slope_long"})  # as with a TPDO that is sent on change only
            assert driver.stale_after_ms(driver.profile.tags["slope_long"]) == 400
            await r.unplug_node()
            await eventually(lambda: r.quality("slope_long")[0] == "bad")
            assert r.quality("slope_long") != ("bad", "heartbeat lost")
            assert producer_writes(r.frames) == []

    run(main())


def test_a_node_is_watched_from_its_first_heartbeat_on() -> None:
    consumer = HeartbeatConsumer()
    consumer.monitor(NODE, 150)
    assert not consumer.is_watched(NODE)
    consumer.observe(NODE, b"\x00", 0)  # a boot-up is not a heartbeat
    assert not consumer.is_watched(NODE)
    consumer.observe(NODE, b"\x05", 1)
    assert consumer.is_watched(NODE)
    consumer.check(10**9)
    assert consumer.is_lost(NODE)
    assert consumer.is_watched(NODE)
    consumer.monitor(NODE, 0)
    assert not consumer.is_watched(NODE)


def test_the_system_file_takes_a_consumer_time_alone() -> None:
    form = HeartbeatForm.model_validate({"consumer_ms": 1500})
    assert (form.producer_ms, form.consumer_ms) == (None, 1500)
    with pytest.raises(ValidationError, match="consumer_ms"):
        HeartbeatForm.model_validate({"producer_ms": 500})
