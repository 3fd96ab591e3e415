"""`identify` of Modbus units: the correct profile first, and never certain of a wrong one."""

from __future__ import annotations

from pathlib import Path

import pytest
from commissioning_rig import Wired, bank, loop, run_virtually, unit
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.cli.device.identify_command import command, known_profiles
from fieldtwin.commissioning.identify.matching import Candidate, ModbusClues, Sureness, rate_modbus, summary
from fieldtwin.commissioning.identify.modbus import ModbusIdentity, identify_modbus
from fieldtwin.commissioning.identify.sunspec import next_model
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitParts
from fieldtwin.emulators.models.modbus.recorded_device import load_replay
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile

URL = "tcp://192.0.2.1:502"
SHIPPED = [load_profile(path) for path in sorted(Path("profiles/devices").glob("*.yaml"))]
RECORDED = ["aqualabo-c4e", "delta-vfd-e", "eastron-sdm630", "renogy-rover", "sunspec-inverter-103"]
MADE_UP = """
device: acme/thermo
source: made up
protocol: modbus
numbering: sent
identification: {0: ACME, 1: T-1000, 2: "1.0"}
server_id: "01020304ff"
tags:
  temperature: {at: "holding:0", type: int16}
"""


async def identify(device: ModbusUnit, number: int, profiles: list[DeviceProfile]) -> ModbusIdentity:
    wire = Wired(device, number)
    found = await identify_modbus(URL, number, profiles, connector=wire, clock=loop(), timeout_s=0.2)
    assert all(pdu[0] in (1, 2, 3, 4, 0x11, 0x2B) for pdu in wire.requests), "only reads"
    return found


def levels(found: ModbusIdentity) -> dict[str, Sureness]:
    return {c.profile: c.sureness for c in found.candidates}


@pytest.mark.parametrize("name", RECORDED)
def test_a_shipped_device_is_matched_with_its_own_profile_first(name: str) -> None:
    """A replayed device has no separate identity, so nothing may be certain, except if a SunSpec map identifies it."""

    async def main() -> None:
        profile = next(p for p in SHIPPED if Path(p.path).stem == name)
        replay, number = load_replay(profile, Path(f"recordings/{name}.jsonl"))
        found = await identify(ReplayUnit(replay, number, name), number, SHIPPED)
        best = found.candidates[0]
        told = levels(found)
        assert found.answers
        assert told[profile.name] is best.sureness, (best, found.candidates)
        assert told[profile.name] is not Sureness.RULED_OUT
        assert found.certain == (profile.name if name.startswith("sunspec") else None)
        assert best.reasons

    run_virtually(main())


def test_a_units_own_identification_is_certain_and_excludes_other_profiles(tmp_path: Path) -> None:
    path = tmp_path / "thermo.yaml"
    path.write_text(MADE_UP)
    thermo = load_profile(path)

    async def main() -> None:
        spans = [CellSpan("holding", 0, 4)]
        said = UnitParts(identification=Identification({0: b"ACME", 1: b"T-1000", 2: b"2.1"}))
        same = await identify(ModbusUnit(bank(spans), **said), 1, [*SHIPPED, thermo])
        assert same.certain == "acme/thermo"
        assert same.clues.objects == {0: "ACME", 1: "T-1000", 2: "2.1"}
        assert "certain" in same.summary
        other = UnitParts(identification=Identification({0: b"ACME", 1: b"T-2000", 2: b"2.1"}))
        sister = await identify(ModbusUnit(bank(spans), **other), 1, [thermo])
        assert levels(sister) == {"acme/thermo": Sureness.RULED_OUT}
        assert "product code is 'T-2000'" in sister.candidates[0].against[0]
        server = await identify(ModbusUnit(bank(spans), server_id=bytes.fromhex("01020304ff")), 1, [thermo])
        assert levels(server) == {"acme/thermo": Sureness.LIKELY}
        mute = await identify(ModbusUnit(bank(spans)), 1, [thermo])
        assert levels(mute)["acme/thermo"] is Sureness.RULED_OUT, "an integer that can be read says nothing"

    run_virtually(main())


def test_sunspec_is_read_model_by_model() -> None:
    async def main() -> None:
        words = {40000: [0x5375, 0x6E53, 1, 66], 40070: [103, 50], 40108: [4], 40122: [0xFFFF, 0]}
        name = [int.from_bytes(b"Sunny\0"[i : i + 2], "big") for i in range(0, 6, 2)]
        device = unit(bank([CellSpan("holding", 40000, 200)], {"holding": {**words, 40004: name}}))
        found = await identify(device, 1, SHIPPED)
        spec = found.clues.sunspec
        assert spec is not None
        assert (spec.base, spec.models, spec.manufacturer) == (40000, ((1, 40002, 66), (103, 40070, 50)), "Sunny")
        assert found.certain == "sunspec/inverter-103"
        other = unit(bank([CellSpan("holding", 40000, 200)], {"holding": {**words, 40070: [101, 50], 40004: name}}))
        single_phase = await identify(other, 1, SHIPPED)
        assert levels(single_phase)["sunspec/inverter-103"] is Sureness.RULED_OUT

    run_virtually(main())


@given(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=40), st.booleans())
@settings(max_examples=25, deadline=None)
def test_any_registers_never_make_certain(pattern: list[int], zeros: bool) -> None:
    async def main() -> None:
        words = [0] * 65 if zeros else (pattern * 65)[:65]
        spans = [CellSpan(t, a, 0x1000) for t in ("holding", "input") for a in (0, 0x2000, 39936)]  # type: ignore[arg-type]
        values = {t: {a + i * 65: words for a in (0, 0x2000, 39936) for i in range(63)} for t in ("holding", "input")}
        found = await identify(unit(bank(spans, values)), 1, SHIPPED)
        sure = [c for c in found.candidates if c.sureness is Sureness.CERTAIN]
        assert not sure or found.clues.sunspec is not None
        if zeros:
            assert all(c.sureness < Sureness.LIKELY for c in found.candidates)

    run_virtually(main())


def test_silence_is_reported_as_silence() -> None:
    async def main() -> None:
        wire = Wired(unit(bank([CellSpan("holding", 0, 1)])), 9)
        found = await identify_modbus(URL, 1, SHIPPED, connector=wire, clock=loop(), timeout_s=0.1)
        assert not found.answers
        assert found.summary.startswith("unit 1 does not answer")
        assert found.candidates == []

    run_virtually(main())


def test_two_equally_good_profiles_give_no_answer() -> None:
    two = [Candidate(name, Sureness.LIKELY, ("x",)) for name in ("a/b", "c/d")]
    assert summary(two) == "2 profiles fit equally well (likely): a/b, c/d"
    assert summary([Candidate("a/b", Sureness.RULED_OUT, ())]) == "no known profile fits"


@given(st.binary(max_size=6), st.integers(0, 0xFFFF))
def test_a_chain_of_models_ends(data: bytes, address: int) -> None:
    model = next_model(data, address)
    assert model is None or model[1] + 2 + model[2] <= 0x10000


def test_without_any_reading_no_profile_is_likely() -> None:
    for profile in SHIPPED:
        if profile.protocol == "modbus":
            assert rate_modbus(profile, ModbusClues(), {}).sureness is Sureness.RULED_OUT


def test_an_exception_that_takes_600_ms_is_an_answer() -> None:
    """Defect: `identify` waited 500 ms, so a device that refuses more slowly seemed not to answer."""

    async def main() -> None:
        wire = Wired(unit(bank([CellSpan("holding", 0, 4)]), functions=frozenset({3})), 1, latency_s=0.6)
        found = await identify_modbus(URL, 1, [], connector=wire, clock=loop())
        assert found.answers
        assert (found.clues.silence["11"], found.clues.silence["2B"]) == ("exception 01h", "exception 01h")

    run_virtually(main())
    assert next(option.default for option in command.params if option.name == "timeout_s") == "1s"


def test_a_folder_of_profiles_needs_no_folder_devices(tmp_path: Path) -> None:
    text = "device: strange/meter\nsource: a test\nprotocol: modbus\ntags: {x: {at: 'holding:0'}}\n"
    (tmp_path / "strange.yaml").write_text(text)
    (tmp_path / "site.yaml").write_text("fieldtwin: 1\nsystem: site\n")
    (tmp_path / "site.prototype.yaml").write_text("prototype_of: site.yaml\n")
    found = {profile.name for profile in known_profiles([tmp_path])}
    assert "strange/meter" in found
    assert "site" not in found


def test_a_folder_without_profiles_says_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no device profile in this folder.*NAME.yaml.*devices/NAME.yaml"):
        known_profiles([tmp_path])
