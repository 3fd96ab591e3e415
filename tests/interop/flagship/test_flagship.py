"""The driver cannot distinguish an emulator from the device.

The same drivers and the same observatory.yaml run against two targets: our emulators, and independent implementations of the
same devices (libmodbus, a socket that answers from a table of bytes, python-can). Both conversations are captured and compared
field by field; tolerances.yaml lists the permitted differences. A difference planted in an independent device must be found,
and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import yaml
from compare import TOLERANCES, Comparison, DeviceRules, Tolerances, compare, load_tolerances, reply_differences
from conversation import Conversation
from held import Held

pytestmark = [pytest.mark.interop, pytest.mark.timeout(120)]

DEVICES = ["ctd", "modem", "inclinometer"]


@pytest.fixture(scope="module")
def tolerances() -> Tolerances:
    return load_tolerances(yaml.safe_load(TOLERANCES.read_text(encoding="utf-8")))


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
    ("plants", "what", "elsewhere"),
    [
        ({"ctd": "exception"}, "refusal: expected exception 02h, got exception 03h", set()),
        # the driver refuses such a reply, so the device and all that depends on it stop
        pytest.param(
            {"modem": "byte"},
            "length: expected 17 bytes, got 18 bytes",
            {"ctd", "inclinometer"},
            marks=pytest.mark.long,
        ),
        # the modem relays the values of the ctd
        pytest.param({"ctd": "swapped"}, "bytes: expected 01 04 14", {"modem"}, marks=pytest.mark.long),
        ({"inclinometer": "abort"}, "refusal: expected abort 06020000h, got abort 05040000h", set()),
    ],
    ids=["another exception code", "one byte more", "swapped words", "another abort code"],
)
def test_a_planted_difference_is_found(
    plants: dict[str, str],
    what: str,
    elsewhere: set[str],
    tolerances: Tolerances,
    with_emulators: Held,
    against_strangers: Callable[..., Held],
) -> None:
    found = differences(with_emulators, against_strangers(plants, patience_s=6.0), tolerances)
    (device,) = plants
    assert any(what in d for d in found[device]), found
    assert set(found) - {device} <= elsewhere, found


def test_no_reply_of_the_device_could_have_been_another(tolerances: Tolerances, with_emulators: Held) -> None:
    """Every byte of every exchange, except tolerated fields, is compared."""
    for device in DEVICES:
        talk, rules = with_emulators.talks[device], tolerances[device]
        assert compare(talk, talk, rules) == []
        for i, e in enumerate(talk.exchanges):
            for request, reply in [
                *((r, e.reply) for r in flipped(e.request)),
                *((e.request, r) for r in flipped(e.reply)),
            ]:
                if tolerated(rules, talk, i, reply):
                    continue
                exchanges = [*talk.exchanges[:i], replace(e, request=request, reply=reply), *talk.exchanges[i + 1 :]]
                assert compare(talk, replace(talk, exchanges=exchanges), rules), (device, e, request.hex(), reply.hex())


def flipped(data: bytes) -> list[bytes]:
    """Return `data` with one bit changed in its last, a middle and its first byte, one byte longer, and empty."""
    if not data:
        return []
    places = {0, len(data) // 2, len(data) - 1}
    return [*(data[:i] + bytes([data[i] ^ 0x40]) + data[i + 1 :] for i in places), data + b"\0", b""]


def tolerated(rules: DeviceRules, talk: Conversation, i: int, reply: bytes) -> bool:
    """Return whether the change is inside a field that may differ, or in the last reply to a poll that may have one more."""
    exchange = talk.exchanges[i]
    rule = next((r for r in rules.polls if exchange.request.startswith(r.prefix)), None)
    if rule is None or len(reply) != len(exchange.reply):
        return False
    later = any(e.request == exchange.request and e.reply != exchange.reply for e in talk.exchanges[i + 1 :])
    last = rule.spare.most and not later
    return bool(last) or not reply_differences(exchange.reply, reply, rule.fields)
