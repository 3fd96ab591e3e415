"""The text for OpenPLC decides as sampling.st does, from the two registers of the sensor: run here, on our own PLC."""

from __future__ import annotations

import struct

import pytest

DEPTHS = [(10.0, 5), (80.25, 1), (45.5, 1), (3.3, 5), (45.5, 5), (float("nan"), 5), (50.01, 1), (-2.0, 1), (39.99, 5)]
"""Consecutive pressures, and the period after each. An invalid depth changes nothing."""


@pytest.mark.fieldtwin(plc="openplc.st")
def test_a_pressure_from_two_registers(plc):
    for pressure, period in DEPTHS:
        high, low = struct.unpack(">HH", struct.pack(">f", pressure))
        assert plc.set(high=high, low=low).scan()["period_s"] == period, pressure


@pytest.mark.fieldtwin(plc="sampling.st")
def test_our_own_program_decides_the_same(plc):
    for pressure, period in DEPTHS:
        if 0 < pressure < 1000:
            assert plc.set(pressure=pressure).scan()["period_s"] == period, pressure
