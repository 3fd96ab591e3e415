"""Reading and writing by name or address: requests, refusals before anything is sent, restored values."""

from __future__ import annotations

from pathlib import Path

import pytest
from canopen_slave_rig import RICH
from commissioning_rig import CAN_URL, URL, Wired, bank, can_bus, loop, run_virtually, unit

from fieldtwin.commissioning.access.address import RawForm, tags_of, with_care
from fieldtwin.commissioning.access.reading import DeviceTarget, dry_point, point_at, row_of, target_of, text_of
from fieldtwin.commissioning.access.writing import before, carry_out, check_broadcast, plan_write, plan_writes, restore
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.gateway.core.errors import CheckFailed, NotAllowed, UsageError, VerifyFailed
from fieldtwin.gateway.core.files.profile_file import load_profile

ROOT = Path(__file__).parents[3]
SDM = load_profile(ROOT / "profiles/devices/eastron-sdm630.yaml")
FLOATS = [0x4366, 0x8000, 0x42C8, 0x0000]  # 230.5, 100.0


def test_raw_addresses_names_and_patterns_are_tags() -> None:
    tags = tags_of(["40101", "input:0"], "modbus", RawForm("float32", "CDAB", count=2))
    assert [(t.name, t.type, t.order) for t in tags] == [
        (name, "float32", "CDAB") for name in ("holding:100", "holding:102", "input:0", "input:2")
    ]
    assert [t.name for t in tags_of(["voltage_*", "frequency"], "modbus", profile=SDM)] == [
        "voltage_l1", "voltage_l2", "voltage_l3", "frequency",
    ]  # fmt: skip
    assert tags_of(["coil:3"], "modbus")[0].type == "bool"
    assert tags_of(["0x6041", "1018h:01"], "canopen")[1].object == (0x1018, 1)


@pytest.mark.parametrize(
    ("item", "protocol", "says"),
    [
        ("voltage_l9", "modbus", "did you mean 'voltage_l"),
        ("holding:65536", "modbus", "exceeds the table"),
        ("holding:x", "modbus", "such as holding:100"),
        ("9", "modbus", "an address such as"),
        ("60", "canopen", "6041h:00"),
    ],
)
def test_an_invalid_address_is_refused_with_a_valid_example(item: str, protocol: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        tags_of([item], protocol, profile=SDM if protocol == "modbus" else None)


def test_values_come_in_the_fewest_requests_and_a_hole_is_an_answer() -> None:
    async def main() -> None:
        wire = Wired(unit(bank([CellSpan("input", 0, 4), CellSpan("input", 6, 2)], {"input": {0: FLOATS}})))
        async with point_at(DeviceTarget(URL, 1), connector=wire, clock=loop()) as point:
            tags = tags_of(["input:0"], "modbus", RawForm("float32", count=4))
            answers = await point.read(tags)
            assert [answers[t.name].value.value for t in tags] == [230.5, 100.0, None, 0.0]
            assert "02h" in answers["input:4"].problem
            asked = len(wire.requests)
            await point.read(tags)
            assert len(wire.requests) - asked == 2  # a learned fact persists: the missing one is not asked again
        assert [f.replace(" ", "")[-8:] for f in dry_point(DeviceTarget(URL, 1)).read_frames(tags[:2])] == ["00000004"]

    run_virtually(main())


def test_a_profiles_limits_and_names_are_kept() -> None:
    async def main() -> None:
        made = bank(
            [CellSpan("input", 0, 80), CellSpan("holding", 0, 30)], {"holding": {10: [0x4040, 0]}, "input": {0: FLOATS}}
        )
        wire = Wired(unit(made, functions=frozenset({3, 4, 16})))
        target = DeviceTarget(URL, 1, SDM)
        async with point_at(target, connector=wire, clock=loop()) as point:
            tags = tags_of(["system_type", "voltage_l1"], "modbus", profile=SDM)
            answers = await point.read(tags)
            assert text_of(tags[0], answers["system_type"]) == "3 (3p4w)"
            assert row_of(tags[1], answers["voltage_l1"])["value"] == 230.5
            write = plan_write(SDM.tags["demand_period"], "15")
            done = await carry_out(point, write, await before(point, write))
            assert done.after == bytes.fromhex("41700000")
            assert wire.requests[-2][:1] == b"\x10"
            sent = len(wire.requests)
            again = await carry_out(point, write, await before(point, write))
            assert again.same  # stored in memory with limited writes: not written again
            assert [r[0] for r in wire.requests[sent:]] == [3]

    run_virtually(main())


def test_errors_that_need_no_device_are_reported_before_anything_is_sent() -> None:
    refused = {
        "voltage_l1": ("5", "read-only"),
        "demand_period": ("61", "outside its limits"),
        "unit_id": ("3", "loses contact"),
        "parity_stop": ("8N9", "8N1"),
    }
    for name, (value, says) in refused.items():
        with pytest.raises(UsageError, match=says):
            plan_write(SDM.tags[name], value, i_know=name == "parity_stop")
    assert plan_write(SDM.tags["parity_stop"], "8E1", i_know=True).value == 1
    with pytest.raises(NotAllowed, match="second write"):
        plan_write(SDM.tags["demand_period"], "15", restore=True)
    with pytest.raises(NotAllowed, match="given twice"):
        plan_writes([(SDM.tags["demand_period"], "15"), (SDM.tags["demand_period"], "16")])
    raw = tags_of(["holding:2"], "modbus", RawForm("float32"), SDM)[0]
    assert with_care(raw, SDM).nonvolatile  # a plain address does not bypass it
    with pytest.raises(NotAllowed, match="loses contact"):
        plan_write(with_care(tags_of(["holding:20"], "modbus")[0], SDM), "1")
    with pytest.raises(NotAllowed, match="broadcast to all units"):
        check_broadcast(dry_point(DeviceTarget("rtu:/dev/ttyS9", 0)), i_know=False)
    check_broadcast(dry_point(DeviceTarget(URL, 0)), i_know=False)  # on TCP unit 0 is the device itself
    with pytest.raises(NotAllowed, match="stores parameters"):
        plan_write(tags_of(["1010h:01"], "canopen", RawForm("uint32"))[0], "0x65766173")


def test_a_value_is_restored_and_one_that_is_not_held_is_reported() -> None:
    async def main() -> None:
        made = bank([CellSpan("holding", 0, 4), CellSpan("coil", 0, 2)], {"holding": {1: [7]}})
        wire = Wired(unit(made))
        async with point_at(DeviceTarget(URL, 1), connector=wire, clock=loop()) as point:
            for item, text, held in (("holding:1", "9", 7), ("coil:1", "on", 0)):
                write = plan_write(tags_of([item], "modbus")[0], text)
                done = await carry_out(point, write, await before(point, write))
                assert done.after != done.before
                await restore(point, done)
                table, _, address = item.partition(":")
                assert made.read(table, int(address), 1, 0)[0] == held  # type: ignore[arg-type]
            made._on_write = lambda table, address, values, now_ns: made.poke("holding", 1, 7)
            with pytest.raises(CheckFailed, match="nothing is written"):
                await before(point, plan_write(tags_of(["holding:9"], "modbus")[0], "1"))

    run_virtually(main())


@pytest.mark.parametrize(("order", "words"), [("ABCD", [0x5075, 0x6D70, 0]), ("BADC", [0x7550, 0x706D, 0])])
def test_text_is_written_too(order: str, words: list[int]) -> None:
    async def main() -> None:
        made = bank([CellSpan("holding", 0, 3)])
        async with point_at(DeviceTarget(URL, 1), connector=Wired(unit(made)), clock=loop()) as point:
            tag = tags_of(["holding:0"], "modbus", RawForm("string", order, registers=3))[0]
            write = plan_write(tag, "Pump")
            await carry_out(point, write, await before(point, write))
            assert list(made.read("holding", 0, 3, 0)) == words
            assert (await point.read([tag]))[tag.name].value.value == "Pump"
            with pytest.raises(NotAllowed, match="too long"):
                plan_write(tag, "Pumping")

    run_virtually(main())


def test_a_device_that_acknowledges_and_forgets_fails_the_verification() -> None:
    async def main() -> None:
        made = bank([CellSpan("holding", 0, 1)])
        wire = Wired(unit(made))
        async with point_at(DeviceTarget(URL, 1), connector=wire, clock=loop()) as point:
            write = plan_write(tags_of(["holding:0"], "modbus")[0], "5")
            old = await before(point, write)
            read, made.read = made.read, lambda *a: (0,)  # type: ignore[method-assign,assignment]
            with pytest.raises(VerifyFailed, match="different"):
                await carry_out(point, write, old)
            made.read = read  # type: ignore[method-assign]

    run_virtually(main())


def test_objects_of_a_node_by_address_by_name_and_back() -> None:
    async def main() -> None:
        node = CanopenNode(parse_eds(RICH, "x"), 5, NodeContext())
        async with (
            can_bus(node) as connector,
            point_at(DeviceTarget(CAN_URL, 5), connector=connector, clock=loop()) as point,
        ):
            tags = tags_of(["1008", "1005h:00", "2FFF"], "canopen")
            answers = await point.read(tags)
            assert answers["1008h:00"].value.value == "a node for tests"
            assert answers["1005h:00"].value.value == 0x80
            assert "06020000h" in answers["2FFFh:00"].problem
            write = plan_write(tags_of(["1006"], "canopen", RawForm("uint32"))[0], "20000")
            done = await carry_out(point, write, await before(point, write))
            assert done.after == (20000).to_bytes(4, "little")
            await restore(point, done)
            assert (await point.read([write.tag]))["1006h:00"].value.value == 0

    run_virtually(main())


def test_a_profile_brings_its_line_and_its_address(tmp_path: Path) -> None:
    target = target_of("rtu:/dev/ttyUSB9", profile_name="eastron-sdm630", folders=[ROOT / "profiles"])
    assert target.url == "rtu:/dev/ttyUSB9?baudrate=9600&frame=8N1"
    assert target.address == 1
    with pytest.raises(UsageError, match="modbus device"):
        target_of("can:socketcan/can0", profile_name="eastron-sdm630", folders=[ROOT / "profiles"])
    drive = target_of("can:socketcan/can0", profile_name="drive-cia402", folders=[ROOT / "profiles"])
    assert drive.dictionary is not None
    assert tags_of(["6041"], "canopen", profile=drive.profile)[0].name == "statusword"
