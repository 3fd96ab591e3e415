"""SPEC part 2, row 1: the driver cannot tell an emulator from the device.

The same drivers and the same observatory.yaml against two targets: our emulators, and independent implementations of the same
devices (libmodbus, a socket that speaks a table of bytes, python-can). Both conversations are captured and compared field by
field; tolerances.yaml says what may differ. A difference planted in an independent device must be found, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from compare import Comparison, Tolerances, compare, load_tolerances
from conftest import Held

pytestmark = [pytest.mark.interop, pytest.mark.slow, pytest.mark.timeout(120)]

DEVICES = ["ctd", "modem", "inclinometer"]


@pytest.fixture(scope="module")
def tolerances() -> Tolerances:
    return load_tolerances(yaml.safe_load((Path(__file__).parent / "tolerances.yaml").read_text(encoding="utf-8")))


def differences(a: Held, b: Held, rules: Tolerances) -> dict[str, list[str]]:
    found = {d: [str(x) for x in compare(a.talks[d], b.talks[d], rules[d])] for d in DEVICES}
    return {d: x for d, x in found.items() if x}


def test_the_script_went_through_with_both(with_emulators: Held, with_strangers: Held) -> None:
    for held in (with_emulators, with_strangers):
        assert not held.run.stuck
        assert len(held.run.refused) == 10
        assert all(held.run.refused.values()), held.run.refused
    assert with_emulators.run.refused == with_strangers.run.refused


def test_every_device_is_compared_with_the_same_file(tolerances: Tolerances, with_emulators: Held) -> None:
    assert set(tolerances) == set(DEVICES) == set(with_emulators.run.system.devices)


@pytest.mark.parametrize("device", DEVICES)
def test_the_driver_cannot_tell_an_emulator_from_the_device(
    device: str, tolerances: Tolerances, with_emulators: Held, with_strangers: Held
) -> None:
    comparison = Comparison(with_emulators.talks[device], with_strangers.talks[device], tolerances[device])
    assert [str(d) for d in comparison.differences] == []
    assert comparison.compared >= {"ctd": 15, "modem": 15, "inclinometer": 40}[device]


@pytest.mark.parametrize(
    ("plants", "what"),
    [
        ({"ctd": "exception"}, "refusal: expected exception 02h, got exception 03h"),
        ({"modem": "byte"}, "length: expected 17 bytes, got 18 bytes"),
        ({"ctd": "swapped"}, "bytes: expected 01 04 14"),
        ({"inclinometer": "abort"}, "refusal: expected abort 06020000h, got abort 05040000h"),
    ],
    ids=["another exception code", "one byte more", "swapped words", "another abort code"],
)
def test_a_planted_difference_is_found(
    plants: dict[str, str],
    what: str,
    tolerances: Tolerances,
    with_emulators: Held,
    against_strangers: Callable[..., Held],
) -> None:
    found = differences(with_emulators, against_strangers(plants, patience_s=6.0), tolerances)
    (device,) = plants
    print(found)
    assert any(what in d for d in found[device]), found
