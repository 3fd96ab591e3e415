"""The models of CiA 401, 404, 406 and 410: conversion of values recorded with factory settings to current settings."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, load_eds, parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.models.canopen.by_profile import MODELS, model_for
from fieldtwin.emulators.models.canopen.io_module import IoModule
from fieldtwin.emulators.models.canopen.measuring_device import ZERO
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

DEVICES = Path(__file__).parents[3] / "profiles" / "devices"
NODE = 5


class Rig:
    """A started node whose replayed values the test sets, by object and as numbers."""

    def __init__(self, name: str) -> None:
        self.dictionary = load_eds(DEVICES / f"{name}.eds")
        self.played: dict[tuple[int, int], float] = {}
        self.model = model_for(self.dictionary)
        self.node = CanopenNode(self.dictionary, NODE, NodeContext(source=self._source, model=self.model))
        self.now_ns = NS_PER_S
        self.node.start(self.now_ns)

    def _source(self, now_ns: int) -> dict[tuple[int, int], bytes]:
        return {key: codec.encode(self._type(*key), value) for key, value in self.played.items()}

    def _type(self, index: int, sub: int) -> int:
        entry = self.dictionary.entry(index, sub)
        assert entry is not None
        return entry.data_type

    def start(self) -> None:
        self.feed(0, bytes([1, NODE]))

    def feed(self, can_id: int, data: bytes) -> list[CanFrame]:
        return self.node.feed(CanFrame(can_id, data), self.now_ns)

    def run(self, ms: int) -> list[CanFrame]:
        """Return the frames that the node sends by itself in that time."""
        until_ns, sent = self.now_ns + ms * NS_PER_MS, []
        while (wake_ns := self.node.wake_at_ns()) is not None and wake_ns <= until_ns:
            self.now_ns = wake_ns
            sent += self.node.tick(wake_ns)
        self.now_ns = until_ns
        return sent

    def write(self, index: int, value: float, sub: int = 0) -> int:
        raw = codec.encode(self._type(index, sub), value)
        request = bytes([0x23 | (4 - len(raw)) << 2]) + index.to_bytes(2, "little") + bytes([sub]) + raw.ljust(4, b"\0")
        reply = self.feed(0x600 + NODE, request)[0].data
        return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0

    def read(self, index: int, sub: int = 0) -> float:
        reply = self.feed(0x600 + NODE, b"\x40" + index.to_bytes(2, "little") + bytes([sub, 0, 0, 0, 0]))[0].data
        return codec.decode(self._type(index, sub), reply[4 : 8 - (reply[0] >> 2 & 3)])


def test_the_device_type_selects_the_model() -> None:
    for name, number in (("io-cia401", 401), ("drive-cia402", 402), ("measuring-cia404", 404), ("encoder-cia406", 406),
                         ("inclinometer-cia410", 410)):  # fmt: skip
        assert type(model_for(load_eds(DEVICES / f"{name}.eds"))) is MODELS[number]
    plain = "[1000]\nParameterName=type\nObjectType=7\nDataType=7\nAccessType=ro\nDefaultValue={}\n"
    assert model_for(parse_eds(plain.format("0x12345678"))) is None
    assert isinstance(model_for(parse_eds(plain.format("0x00030191"))), IoModule)
    without: Dictionary = parse_eds(plain.format(0).replace("1000", "2000"))
    assert model_for(without) is None


# -- CiA 401 -----------------------------------------------------------------------------------------------------------


def test_inputs_change_by_themselves_and_the_masks_decide_which_interrupt() -> None:
    rig = Rig("io-cia401")
    rig.played = {(0x6000, 1): 0b0000, (0x6000, 2): 0}
    rig.start()
    rig.run(20)
    rig.played[0x6000, 1] = 0b0101
    assert [f.data for f in rig.run(20) if f.can_id == 0x185] == [b"\x05\x00"]
    rig.write(0x6006, 0, sub=1)  # no interrupt by any change,
    rig.write(0x6007, 0b0010, sub=1)  # only by the rise of input 2
    rig.played[0x6000, 1] = 0b0001
    assert [f for f in rig.run(20) if f.can_id == 0x185] == []
    rig.played[0x6000, 1] = 0b0011
    assert [f.data for f in rig.run(20) if f.can_id == 0x185] == [b"\x03\x00"]
    rig.write(0x6008, 0b0010, sub=1)  # and by its fall
    rig.played[0x6000, 1] = 0
    assert [f.data for f in rig.run(20) if f.can_id == 0x185] == [b"\x00\x00"]
    rig.write(0x6005, 0)
    rig.played[0x6000, 1] = 0b0010
    assert [f for f in rig.run(20) if f.can_id == 0x185] == []
    assert rig.read(0x6000, 1) == 0b0010  # it can be read on request


def test_polarity_turns_inputs_and_outputs_round() -> None:
    rig = Rig("io-cia401")
    assert isinstance(rig.model, IoModule)
    rig.played = {(0x6000, 1): 0b0101}
    rig.write(0x6002, 0b1111, sub=1)
    assert rig.read(0x6000, 1) == 0b1010
    rig.start()
    rig.feed(0x205, b"\x03\x00")
    assert rig.model.digital_outputs == {1: 0x03, 2: 0}
    rig.write(0x6202, 0xFF, sub=1)
    assert rig.model.digital_outputs[1] == 0xFC


def test_outputs_fall_to_their_error_values_without_commands() -> None:
    rig = Rig("io-cia401")
    assert isinstance(rig.model, IoModule)
    rig.write(0x6206, 0x0F, sub=1)  # the upper four keep what they have
    rig.write(0x6207, 0x05, sub=1)
    rig.write(0x6444, -7, sub=1)
    rig.write(0x6443, 0, sub=2)
    rig.start()
    rig.feed(0x205, b"\xff\xff")
    rig.feed(0x305, struct.pack("<hh", 1000, 2000))
    assert rig.model.analogue_outputs == {1: 1000, 2: 2000}
    rig.feed(0, bytes([2, NODE]))
    assert rig.model.digital_outputs == {1: 0xF5, 2: 0x00}
    assert rig.model.analogue_outputs == {1: -7, 2: 2000}
    rig.start()
    assert rig.model.digital_outputs == {1: 0xFF, 2: 0xFF}


def test_analogue_inputs_interrupt_when_enabled() -> None:
    rig = Rig("io-cia401")
    rig.played = {(0x6401, n): 0 for n in (1, 2, 3, 4)}
    rig.start()
    rig.run(20)

    def told(value: int) -> list[int]:
        rig.played[0x6401, 1] = value
        return [int.from_bytes(f.data[:2], "little", signed=True) for f in rig.run(20) if f.can_id == 0x285]

    assert told(100) == []  # 6423h is off by default
    rig.write(0x6423, 1)
    rig.write(0x6426, 50, sub=1)
    assert told(151) == [151]
    assert told(190) == []  # less than delta away from the last sent value
    assert told(202) == [202]
    rig.write(0x6421, 1, sub=1)  # at or above the upper limit only
    rig.write(0x6424, 300, sub=1)
    assert told(280) == []
    assert told(300) == [300]


# -- CiA 404 -----------------------------------------------------------------------------------------------------------


def test_a_process_value_in_three_forms_and_its_current() -> None:
    rig = Rig("measuring-cia404")
    rig.played = {(0x6130, 1): 100.0, (0x6130, 2): 21.5}
    assert rig.read(0x6130, 1) == 100.0
    assert (rig.read(0x9130, 1), rig.read(0x7130, 2)) == (10_000, 2150)
    assert rig.read(0x6100, 1) == pytest.approx(8.0)  # mA of 4 to 20, a quarter of the way
    rig.write(0x6132, 1, sub=1)
    assert rig.read(0x9130, 1) == 1000


def test_other_scaling_shows_the_same_current_as_another_value() -> None:
    rig = Rig("measuring-cia404")
    rig.played = {(0x6130, 1): 100.0}
    rig.write(0x6123, 800.0, sub=1)
    assert rig.read(0x6130, 1) == pytest.approx(200.0)
    assert rig.read(0x6100, 1) == pytest.approx(8.0)
    assert rig.write(0x6122, 4.0, sub=1) == 0x06040043  # the two points would be above one another


def test_taring_wants_the_four_letters() -> None:
    rig = Rig("measuring-cia404")
    rig.played = {(0x6130, 1): 3.5}
    assert rig.write(0x6125, 1, sub=1) == 0x08000020
    assert rig.write(0x6125, ZERO, sub=1) == 0
    assert rig.read(0x6130, 1) == 0.0
    assert rig.read(0x6124, 1) == -3.5
    rig.played[0x6130, 1] = 13.5
    assert rig.read(0x6130, 1) == 10.0
    rig.write(0x6124, 1.0, sub=1)
    assert rig.read(0x6130, 1) == 14.5


def test_outside_the_span_and_switched_off_the_status_shows_it() -> None:
    rig = Rig("measuring-cia404")
    rig.played = {(0x6130, 1): 401.0, (0x6130, 2): -41.0}
    assert (rig.read(0x6150, 1), rig.read(0x6150, 2)) == (2, 4)
    rig.write(0x6112, 0, sub=1)
    assert (rig.read(0x6150, 1), rig.read(0x6130, 1)) == (1, 0.0)


# -- CiA 406 -----------------------------------------------------------------------------------------------------------

STEPS, TURNS = 8192, 4096


def test_an_encoder_shows_its_shaft_and_goes_round() -> None:
    rig = Rig("encoder-cia406")
    rig.played = {(0x6004, 0): 5 * STEPS + 17}
    assert rig.read(0x6004) == 5 * STEPS + 17
    rig.write(0x6000, 1)  # counter-clockwise
    assert rig.read(0x6004) == TURNS * STEPS - 5 * STEPS - 17
    assert rig.read(0x6500) == 1


def test_scaling_and_range() -> None:
    rig = Rig("encoder-cia406")
    rig.played = {(0x6004, 0): 5 * STEPS + STEPS // 2}
    rig.write(0x6001, 360)
    assert rig.read(0x6004) == 5 * STEPS + STEPS // 2  # scaling is off by default
    rig.write(0x6000, 4)
    assert rig.read(0x6004) == 5 * 360 + 180
    rig.write(0x6002, 720)
    assert rig.read(0x6004) == (5 * 360 + 180) % 720
    assert rig.write(0x6001, STEPS + 1) == 0x06090031
    assert rig.write(0x6000, 8) == 0x06090030


def test_a_preset_moves_the_position_each_time_it_is_written() -> None:
    rig = Rig("encoder-cia406")
    rig.played = {(0x6004, 0): 100_000}
    rig.write(0x6003, 500)
    assert (rig.read(0x6004), rig.read(0x6509)) == (500, -99_500)
    rig.played[0x6004, 0] = 100_010
    assert rig.read(0x6004) == 510
    rig.write(0x6003, 500)  # the same value is written again: the object does not change, but it is a preset
    assert rig.read(0x6004) == 500
    assert rig.write(0x6003, STEPS * TURNS) == 0x06090031


def test_speed_in_turns_a_minute_across_the_end_of_the_range() -> None:
    rig = Rig("encoder-cia406")
    rig.played = {(0x6004, 0): STEPS * TURNS - STEPS // 20}
    rig.now_ns += 100 * NS_PER_MS
    rig.read(0x6030, 1)
    rig.now_ns += 100 * NS_PER_MS
    rig.played[0x6004, 0] = STEPS // 20
    assert rig.read(0x6030, 1) == 60  # a tenth of a turn in a tenth of a second


def test_a_simulated_speed_of_an_encoder_is_not_replaced_by_one_computed_from_the_position() -> None:
    rig = Rig("encoder-cia406")
    rig.played = {(0x6004, 0): 0, (0x6030, 1): 24}
    rig.read(0x6030, 1)
    rig.now_ns += 100 * NS_PER_MS
    rig.played[0x6004, 0] = STEPS // 20
    assert rig.read(0x6030, 1) == 24


# -- CiA 410 -----------------------------------------------------------------------------------------------------------


def test_an_inclinometer_inverts_and_takes_presets_when_scaling_is_on() -> None:
    rig = Rig("inclinometer-cia410")
    rig.played = {(0x6010, 0): 1234, (0x6020, 0): -500}
    assert (rig.read(0x6010), rig.read(0x6020)) == (1234, -500)
    rig.write(0x6011, 1)
    assert rig.read(0x6010) == -1234
    rig.write(0x6021, 2)
    rig.write(0x6024, 30)
    assert rig.read(0x6020) == -470
    rig.write(0x6022, 0)
    assert (rig.read(0x6020), rig.read(0x6023)) == (0, 470)
    rig.write(0x6023, 100)
    assert rig.read(0x6020) == -370
    rig.write(0x6021, 0)
    assert rig.read(0x6020) == -500
