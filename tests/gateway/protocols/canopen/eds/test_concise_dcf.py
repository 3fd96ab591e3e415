"""The concise DCF: its bytes, its generation from a DCF, TPDOs and date of a DCF, and errors in one."""

from __future__ import annotations

import pytest
from dcf_texts import TPDO1, dcf, record, var
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import Desync, FileInvalid, UsageError
from fieldtwin.gateway.protocols.canopen.configure import tpdos_of
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import (
    Setting,
    configuration_date,
    decode_concise,
    encode_concise,
    settings_of,
)
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping


def test_the_bytes_are_those_of_the_standard() -> None:
    data = encode_concise([Setting(0x1017, 0, b"\xe8\x03"), Setting(0x1800, 1, b"\x85\x01\0\0")])
    assert data.hex(" ") == "02 00 00 00 17 10 00 02 00 00 00 e8 03 00 18 01 04 00 00 00 85 01 00 00"
    assert decode_concise(data) == (Setting(0x1017, 0, b"\xe8\x03"), Setting(0x1800, 1, b"\x85\x01\0\0"))


SETTINGS = st.lists(
    st.builds(Setting, st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(max_size=20)), max_size=10
)


@given(SETTINGS, st.data())
def test_values_round_trip_and_none_is_truncated(settings: list[Setting], data: st.DataObject) -> None:
    block = encode_concise(settings)
    assert decode_concise(block) == tuple(settings)
    cut = data.draw(st.integers(0, len(block) - 1))
    with pytest.raises(Desync):
        decode_concise(block[:cut])
    with pytest.raises(Desync):
        decode_concise(block + b"\0")


@given(st.binary(max_size=60))
def test_any_bytes_are_settings_or_an_error(data: bytes) -> None:
    try:
        settings = decode_concise(data)
    except Desync:
        return
    assert encode_concise(settings) == data


def test_too_many_entries_are_refused() -> None:
    with pytest.raises(UsageError):
        encode_concise([Setting(0, 0, b"")] * 65_536)


def test_only_settings_of_the_dcf_are_written_pdos_by_their_procedure_and_last() -> None:
    dictionary = dcf(
        var("1000", 7, "ro", "0x2019A", "0x2019A"),  # read-only
        var("1010", 7, "rw", "0", "1"),  # a command
        TPDO1,
        var("2000", 5, "rw", "7"),  # a default is not a setting
        var("2001", 6, "rw", "0", "0x1234"),
        var("2002", 3, "rw", "0", "-2"),
        var("2003", 9, "rw", "", "text"),
    )
    assert [str(s) for s in settings_of(dictionary)] == [
        "2001h:00 = 34 12",
        "2002h:00 = fe ff",
        "2003h:00 = 74 65 78 74",
        "1800h:01 = 85 01 00 c0",
        "1A00h:00 = 00",
        "1A00h:01 = 10 00 01 20",
        "1A00h:02 = 10 00 02 20",
        "1A00h:00 = 02",
        "1800h:02 = 01",
        "1800h:05 = 64 00",
        "1800h:01 = 85 01 00 40",
    ]


def test_a_mapping_alone_switches_its_pdo_off_and_on_with_the_identifier_that_it_has() -> None:
    communication = record("1400", [(5, "const", "2", ""), (7, "rw", "$NODEID+0x200", ""), (5, "rw", "255", "")])
    dictionary = dcf(communication, record("1600", [(5, "rw", "0", "1"), (7, "rw", "0", "0x20000008")]))
    assert [str(s) for s in settings_of(dictionary)] == [
        "1400h:01 = 05 02 00 80",
        "1600h:00 = 00",
        "1600h:01 = 08 00 00 20",
        "1600h:00 = 01",
        "1400h:01 = 05 02 00 00",
    ]


def test_the_date_is_that_of_1020h() -> None:
    with_date = record("1020", [(5, "const", "2", ""), (7, "rw", "0", "15000"), (7, "rw", "0", "0x4D2")])
    assert configuration_date(dcf(with_date, var("2001", 6, "rw", "0", "1"))) == (15000, 1234)
    assert settings_of(dcf(with_date)) == ()  # it is written separately, last
    assert configuration_date(dcf(var("2001", 6, "rw", "0", "1"))) is None


def test_a_value_that_its_type_cannot_hold_is_reported_with_section_and_key() -> None:
    with pytest.raises(FileInvalid, match=r"node5\.dcf.*\[2001sub0\] ParameterValue") as told:
        settings_of(dcf(var("2001", 5, "rw", "0", "256")))
    assert "UNSIGNED8" in str(told.value)


def test_tpdos_as_the_dcf_has_them() -> None:
    (tpdo,) = tpdos_of(dcf(TPDO1))
    assert (tpdo.number, tpdo.cob_id, tpdo.enabled, tpdo.transmission_type, tpdo.event_ms) == (1, 0x185, True, 1, 100)
    assert tpdo.mapping == PdoMapping.of([(0x2001, 0, 16), (0x2002, 0, 16)])
    bad = record("1A00", [(5, "rw", "", "2"), (7, "rw", "", "0x20010040"), (7, "rw", "", "0x20020008")])
    communication = record("1800", [(5, "const", "2", ""), (7, "rw", "$NODEID+0x180", ""), (5, "rw", "255", "")])
    with pytest.raises(FileInvalid, match=r"\[1A00\]: the mapping of TPDO 1"):
        tpdos_of(dcf(communication, bad))
