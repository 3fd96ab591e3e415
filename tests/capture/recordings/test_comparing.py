"""Rules of equality: tolerances by tag and by word, increased counters, latencies, messages of a CAN bus."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packets import read, values

from fieldtwin.capture.recordings.comparing import Comparer, Comparison, Rules, Tolerance, pairs_of, request_of
from fieldtwin.capture.recordings.comparing_can import compare_logs
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange

MS = 1_000_000


def asked(request: bytes, reply: bytes | None, latency_s: float = 0.01) -> RecordedExchange:
    return RecordedExchange(0.0, 1, request, reply, latency_s, None if reply is not None else "timeout")


def compared(
    one: list[RecordedExchange],
    two: list[RecordedExchange],
    rules: Rules | None = None,
    profile: DeviceProfile | None = None,
) -> Comparison:
    comparer = Comparer(rules, profile)
    for a, b in pairs_of(one, two, request_of):
        comparer.add(a, b)
    return comparer.result()


@pytest.mark.parametrize(
    ("tolerance", "other", "alike"),
    [
        (Tolerance(), 1000, True), (Tolerance(), 1001, False), (Tolerance(2), 1002, True), (Tolerance(2), 1003, False),
        (Tolerance(share=0.01), 990, True), (Tolerance(share=0.01), 989, False), (Tolerance(20, 0.01), 1020, True),
    ],
)  # fmt: skip
def test_words_are_equal_within_their_tolerance(tolerance: Tolerance, other: int, alike: bool) -> None:
    result = compared([asked(read(5), values(1000))], [asked(read(5), values(other))], Rules(tolerance))
    assert result.met is alike
    assert [(d.where, d.recorded, d.other) for d in result.differences] == (
        [] if alike else [("holding:5", "1000", str(other))]
    )


def test_tags_have_separate_tolerances_and_counters_may_have_increased(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(
        'device: a/b\nsource: ""\nprotocol: modbus\ntags:\n'
        '  volts: {at: "holding:0", type: float32}\n  energy: {at: "holding:2", type: uint32, counter: true}\n'
        '  name: {at: "holding:4", type: string, registers: 2}\n'
    )
    profile = load_profile(path)

    def meter(volts: float, energy: int, name: bytes, other: int = 0) -> list[RecordedExchange]:
        return [asked(read(0, 7), b"\x03\x0e" + struct.pack(">fI4sH", volts, energy, name, other))]

    rules = Rules(tags={"volts": Tolerance(0.5)})
    then = meter(230.0, 70_000, b"abcd")
    assert compared(then, meter(230.4, 70_001, b"abcd"), rules, profile).met
    for now, where in (
        (meter(230.6, 70_000, b"abcd"), "volts"), (meter(230.0, 69_999, b"abcd"), "energy"),
        (meter(230.0, 70_000, b"abce"), "name"), (meter(230.0, 70_000, b"abcd", 1), "holding:6"),
        (meter(float("nan"), 70_000, b"abcd"), "volts"),
    ):  # fmt: skip
        result = compared(then, now, rules, profile)
        assert (result.met, [d.where for d in result.differences]) == (False, [where])


@pytest.mark.parametrize(("latency_s", "met"), [(0.012, True), (0.03, True), (0.05, False)])
def test_latencies_are_compared_by_median_and_90_percent(latency_s: float, met: bool) -> None:
    one = [asked(read(n), values(n), 0.01) for n in range(20)]
    two = [asked(read(n), values(n), latency_s) for n in range(20)]
    result = compared(one, two)
    assert (result.values, result.met) == (1.0, met)
    assert result.timing == pytest.approx(0.011 / (latency_s + 0.001))
    assert compared(one, two, Rules(latency=None)).met


def test_wire_counters_are_not_compared_and_an_empty_comparison_is_not_a_match() -> None:
    request = bytes.fromhex("08000b0000")
    assert compared([asked(request, request)], [asked(request, bytes.fromhex("08000b0007"))]).met
    assert not compared([], []).met


@settings(max_examples=50)
@given(st.lists(st.integers(0, 3), max_size=30), st.randoms())
def test_pairs_lose_nothing_and_keep_the_order_of_each_request(requests: list[int], random: object) -> None:
    one = [(r, n) for n, r in enumerate(requests)]
    two = list(one)
    random.shuffle(two)  # type: ignore[attr-defined]
    two.sort(key=lambda pair: 0 if pair[0] else 1)
    two = sorted(two[: len(two) // 2], key=lambda p: p[1]) + two[len(two) // 2 :]
    pairs = list(pairs_of(one, two, lambda pair: pair[0]))
    assert sorted(a for a, _ in pairs if a is not None) == sorted(one)
    assert sorted(b for _, b in pairs if b is not None) == sorted(one)
    for key in range(4):
        assert [b for a, b in pairs if a and a[0] == key and b] == [b for b in two if b[0] == key]


# -- CAN ------------------------------------------------------------------------------------------------------------------


def upload(t_ms: float, index: int, value: int | None, *, abort: int = 0) -> list[tuple[int, CanFrame]]:
    head = index.to_bytes(2, "little") + b"\0"
    answer = (
        b"\x80" + head + abort.to_bytes(4, "little") if value is None else b"\x4b" + head + value.to_bytes(4, "little")
    )
    return [
        (round(t_ms * MS), CanFrame(0x605, b"\x40" + head + bytes(4))),
        (round((t_ms + 2) * MS), CanFrame(0x585, answer)),
    ]


def beats(count: int, every_ms: int = 100) -> list[tuple[int, CanFrame]]:
    return [(n * every_ms * MS, CanFrame(0x705, b"\x05")) for n in range(count)]


def by_time(*parts: list[tuple[int, CanFrame]]) -> list[tuple[int, CanFrame]]:
    return sorted((frame for part in parts for frame in part), key=lambda pair: pair[0])


def test_a_node_is_compared_by_its_transfers_and_the_kinds_of_its_messages() -> None:
    status, gone = [*upload(1, 0x6041, 5), *upload(50, 0x6041, 6)], upload(90, 0x1018, None, abort=0x06020000)
    log = by_time(status, gone, beats(10))
    assert compare_logs(log, log).met
    for other, kind in (
        (by_time(upload(1, 0x6041, 5), upload(50, 0x6041, 7), gone, beats(10)), "value"),
        (by_time(status, upload(90, 0x1018, None, abort=0x08000000), beats(10)), "abort"),
        (by_time(status, beats(10)), "missing"),
        (by_time(status, gone), "missing"),
        (by_time(status, gone, beats(10, 200)), "message"),
    ):
        result = compare_logs(log, other)
        assert (result.met, result.by_kind) == (False, {kind: 1})
    near = by_time(upload(1, 0x6041, 5), upload(50, 0x6041, 7), gone, beats(10))
    assert compare_logs(log, near, Rules(Tolerance(1))).met
