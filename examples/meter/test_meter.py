"""The driver's tests, against an emulated meter; run them with `pytest`."""

from __future__ import annotations

import pytest
from meter import Meter, MeterError

pytestmark = pytest.mark.fieldtwin(device="eastron-sdm630", on="tcp", values={"voltage_l1": 230.5})


@pytest.fixture
def meter(device):
    with Meter(device.host, device.port, device.unit) as connected:
        yield connected


def test_it_reads_the_voltage(meter, device):
    assert meter.voltage() == pytest.approx(230.5)
    device.set("voltage_l1", 207.0)
    assert meter.voltage() == pytest.approx(207.0)


@pytest.mark.requirement("METER-3")
def test_it_writes_once(meter, device, wire):
    meter.set_demand_period(15)
    assert device.held("demand_period") == 15
    wire.expect(times=1, access="write")


@pytest.mark.requirement("METER-7")
def test_it_asks_twice_and_no_more(meter, wire):
    with wire.fault("silence"), pytest.raises(MeterError, match="no reply"):
        meter.voltage()
    wire.expect(times=2, problem="no reply", within_s=0.3)
    assert meter.voltage() == pytest.approx(230.5)


def test_it_waits_for_an_answer_that_comes_late(meter, wire):
    with wire.fault("delay", by_ms=100):
        assert meter.voltage() == pytest.approx(230.5)
