"""Schemas DATA, COMMAND, STATUS, MEASUREMENT, RESPONSE, RECORDING."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.values import COMMAND, DATA, MEASUREMENT, RECORDING, RESPONSE, STATUS

KINDS = (DATA, COMMAND, RESPONSE, MEASUREMENT, STATUS, RECORDING)


@pytest.mark.parametrize("kind", KINDS)
@given(bits=st.binary(max_size=16))
def test_DATA_is_an_immutable_bit_sequence(kind: type[DATA], bits: bytes) -> None:
    made = kind(bits)
    assert made.data == bits
    assert made == kind(bytes(bits))
    with pytest.raises(FrozenInstanceError):
        made.data = b"other"  # type: ignore[misc]


@pytest.mark.parametrize("kind", [COMMAND, RESPONSE])
def test_COMMAND_and_RESPONSE_are_DATA(kind: type[DATA]) -> None:
    assert issubclass(kind, DATA)
    assert not issubclass(COMMAND, RESPONSE)
    assert not issubclass(RESPONSE, COMMAND)


@pytest.mark.parametrize("kind", [MEASUREMENT, STATUS])
def test_RESPONSE_is_a_MEASUREMENT_or_a_STATUS_and_never_both(kind: type[DATA]) -> None:
    assert issubclass(kind, RESPONSE)
    other = STATUS if kind is MEASUREMENT else MEASUREMENT
    assert not issubclass(kind, other)
    assert kind(b"1") != other(b"1")


def test_RECORDING_is_a_RESPONSE() -> None:
    assert issubclass(RECORDING, RESPONSE)
