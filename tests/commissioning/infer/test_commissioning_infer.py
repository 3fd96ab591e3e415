"""Hidden maps, dumped over time: certain claims of the tool must be true, and it must be certain of most changing values.

The test packs its values with a separate codec: words of `struct`, put in order by hand.
"""

from __future__ import annotations

import math
import random
import struct
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest
from commissioning_rig import URL, Wired, bank, loop, run_virtually, unit
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.commissioning.access.address import tags_of
from fieldtwin.commissioning.access.reading import DeviceTarget, point_at
from fieldtwin.commissioning.dump.dump import DumpJob
from fieldtwin.commissioning.dump.file import load_dump
from fieldtwin.commissioning.dump.session import dump, register_spans
from fieldtwin.commissioning.infer.costs import NUMBERS, cost, orders_of
from fieldtwin.commissioning.infer.draft import checked, draft_profile
from fieldtwin.commissioning.infer.fields import Interpretation, Level, infer_run, run_of
from fieldtwin.commissioning.infer.infer import Series, infer, series_of, without_repetitions
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile

START_S = 1_790_000_000.0
FORMS = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}


def words(kind: str, order: str, value: float) -> list[int]:
    raw = struct.pack(">" + FORMS[kind], value if "float" in kind else round(value))
    pairs = [raw[i : i + 2] for i in range(0, len(raw), 2)]
    if len(pairs) > 1 and order in ("CDAB", "DCBA"):
        pairs = pairs[::-1]
    if len(pairs) > 1 and order in ("BADC", "DCBA"):
        pairs = [bytes((p[1], p[0])) for p in pairs]
    return [p[0] << 8 | p[1] for p in pairs]


@dataclass
class Hidden:
    """A field that the test knows."""

    address: int
    kind: str
    order: str
    rows: list[list[int]]

    @property
    def moves(self) -> bool:
        return len({tuple(row) for row in self.rows}) >= 6

    def is_read_by(self, reading: Interpretation) -> bool:
        kinds = {reading.type, reading.type[1:]} if reading.sign_open else {reading.type}
        single = len(self.rows[0]) == 1
        here = (reading.address, reading.registers) == (self.address, len(self.rows[0]))
        return here and self.kind in kinds and (single or reading.order == self.order)


def text_words(text: str) -> list[int]:
    raw = text.encode("ascii") + b"\0" * (len(text) % 2)
    return [raw[i] << 8 | raw[i + 1] for i in range(0, len(raw), 2)]


def hidden_device(seed: int, passes: int) -> list[Hidden]:
    """A typical device: one word order for nearly everything, measurements, counters, settings, states, a name."""
    r = random.Random(seed)
    order = r.choice(["ABCD", "ABCD", "CDAB", "BADC", "DCBA"])
    fields: list[Hidden] = []
    address = 0

    def put(kind: str, rows: list[list[int]]) -> None:
        nonlocal address
        fields.append(Hidden(address, kind, order, rows))
        address += len(rows[0])

    for _ in range(r.randint(4, 8)):
        base, noise = 10 ** r.uniform(-1, 4) * r.choice((1, 1, -1)), 10 ** r.uniform(-3.5, -1)
        put("float32", [words("float32", order, base * (1 + r.gauss(0, noise))) for _ in range(passes)])
    for _ in range(r.randint(1, 3)):
        energy, step = int(10 ** r.uniform(1, 8)), int(10 ** r.uniform(0, 4.5))
        put("uint32", [words("uint32", order, energy + i * step + r.randint(0, step)) for i in range(passes)])
    for _ in range(r.randint(2, 5)):
        centre, wide = r.randint(-400, 9000), r.choice((3, 20, 200))
        put("int16", [words("int16", order, max(-30000, r.gauss(centre, wide))) for _ in range(passes)])
    if r.random() < 0.5:
        value = 10 ** r.uniform(0, 3)
        put("float64", [words("float64", order, value * (1 + r.gauss(0, 0.01))) for _ in range(passes)])
    for _ in range(r.randint(2, 6)):
        put("uint16", [[r.choice((0, 1, 60, 1000, 9600))]] * passes)
    put("string", [text_words(r.choice(("ACME 3000", "Flow meter", "SN 20260117")))] * passes)
    return fields


def series_of_fields(fields: list[Hidden], every_s: float = 10.0) -> Series:
    cells = {f.address + i: [row[i] for row in f.rows] for f in fields for i in range(len(f.rows[0]))}
    times = tuple(START_S + every_s * i for i in range(len(fields[0].rows)))
    return Series(times, {"holding": cells})


@pytest.mark.parametrize("passes", [8, 20])
def test_certain_claims_are_true_and_most_floats_are_certain(passes: int) -> None:
    seen: Counter[tuple[str, str]] = Counter()
    for seed in range(8):
        fields = hidden_device(1000 * passes + seed, passes)
        readings = infer(series_of_fields(fields)).readings
        for reading in readings:
            right = any(f.is_read_by(reading) for f in fields)
            assert right or reading.level is not Level.CERTAIN, (seed, reading)
        for f in fields:
            found = next((x for x in readings if f.is_read_by(x)), None)
            if f.moves:
                seen[(f.kind, str(found.level) if found is not None else "missed")] += 1
    floats = {level: n for (kind, level), n in seen.items() if kind == "float32"}
    assert floats.get("certain", 0) >= 0.6 * sum(floats.values()), floats
    assert floats.get("missed", 0) + floats.get("guess", 0) <= 0.1 * sum(floats.values()), floats


def test_few_passes_or_no_movement_make_nothing_certain() -> None:
    fields = hidden_device(5, 20)
    few = [Hidden(f.address, f.kind, f.order, f.rows[:5]) for f in fields]
    assert all(r.level is not Level.CERTAIN for r in infer(series_of_fields(few)).readings)
    still = [Hidden(f.address, f.kind, f.order, f.rows[:1] * 20) for f in fields]
    assert all(r.level is not Level.CERTAIN or r.type == "string" for r in infer(series_of_fields(still)).readings)


def test_a_repeated_answer_is_not_evidence() -> None:
    fields = hidden_device(6, 5)
    slow = [Hidden(f.address, f.kind, f.order, [row for row in f.rows for _ in range(4)]) for f in fields]
    series = series_of_fields(slow)
    assert series.passes == 20
    assert without_repetitions(series).passes == 5
    assert all(r.level is not Level.CERTAIN or r.type == "string" for r in infer(series).readings)
    fields = hidden_device(6, 12)
    slow = [Hidden(f.address, f.kind, f.order, [row for row in f.rows for _ in range(3)]) for f in fields]
    once, thrice = infer(series_of_fields(fields)).readings, infer(series_of_fields(slow)).readings
    assert [(r.address, r.type, r.probability) for r in once] == [(r.address, r.type, r.probability) for r in thrice]


def test_a_word_that_fits_both_neighbours_is_doubtful() -> None:
    r = random.Random(3)
    low = [r.randint(0, 65535) for _ in range(12)]
    rows = [[0x4366] * 12, low, [0x4366] * 12]  # ABCD with the first, or CDAB with the last
    found = infer_run(run_of("input", 0, rows))
    assert all(reading.level is not Level.CERTAIN for reading in found)
    assert any(rival[0] == "float32" for reading in found for rival in reading.rivals)


@pytest.mark.parametrize("order", ["ABCD", "CDAB", "BADC", "DCBA"])
@pytest.mark.parametrize("passes", [7, 20])
def test_smooth_waves_and_ramps_cause_no_false_claims(order: str, passes: int) -> None:
    r = random.Random(passes)
    for _ in range(4):
        fields: list[Hidden] = []

        def put(kind: str, values: list[float], into: list[Hidden] = fields) -> None:
            address = sum(len(f.rows[0]) for f in into)
            into.append(Hidden(address, kind, order, [words(kind, order, v) for v in values]))

        for kind, centre, swing in (
            ("float32", 1000, 0.3),
            ("float32", 20, 0.05),
            ("int16", 500, 0.2),
            ("int32", 1e6, 0.4),
        ):
            phase, period = r.uniform(0, 6), r.uniform(5, 40)
            wave = [centre * (1 + swing * math.sin(i * 6.28 / period + phase)) for i in range(passes)]
            put(kind, wave)
        for kind, start, step in (("float32", r.uniform(1, 100), 0.37), ("uint32", 70000, 37), ("uint16", 5, 3)):
            put(kind, [start + i * step for i in range(passes)])
        for reading in infer(series_of_fields(fields)).readings:
            assert any(f.is_read_by(reading) for f in fields) or reading.level is not Level.CERTAIN, reading


def one(kind: str, values: list[float], *, times_s: list[float] | None = None) -> Interpretation:
    field = Hidden(0, kind, "ABCD", [words(kind, "ABCD", v) for v in values])
    series = series_of_fields([field])
    if times_s is not None:
        series = Series(tuple(times_s), series.cells)
    return infer(series).readings[-1]


def test_counters_states_times_and_signs_are_marked() -> None:
    assert "counter" in one("uint32", [65_000 + 150 * i + i % 3 for i in range(20)]).marks
    assert "enumeration" in one("uint16", [1, 1, 1, 4, 4, 4, 4, 2, 2, 2, 2, 2, 1, 1, 1]).marks
    clock = [START_S + t for t in (0, 10, 20, 33, 40, 51, 60, 70)]
    assert one("uint32", [t + 3600 for t in clock], times_s=clock).marks == ("timestamp",)
    assert one("uint16", [t - START_S + 77 for t in clock], times_s=clock).marks == ("seconds",)
    signed = one("int16", [3, -2, 5, -7, 1, -1, 4, -6, 2, -3])
    assert (signed.type, signed.sign_open) == ("int16", False)
    unsigned = one("uint16", [300, 301, 299, 300, 305, 298, 300, 302])
    assert unsigned.sign_open


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("bcd", [False, True])
def test_a_calendar_clock_is_found_among_other_registers(backwards: bool, bcd: bool) -> None:
    times = [START_S + 7 * i for i in range(8)]
    rows = []
    for t in times:
        d = datetime.fromtimestamp(t + 7200, UTC)
        row = [d.year % 100, d.month, d.day, d.hour, d.minute, d.second]
        row = [int(str(x), 16) for x in row] if bcd else row
        rows.append([500, *(row[::-1] if backwards else row), 77])
    cells = {10 + i: [row[i] for row in rows] for i in range(8)}
    readings = infer(Series(tuple(times), {"input": cells})).readings
    clock = [r for r in readings if "timestamp" in r.marks]
    assert [r.address for r in clock] == list(range(11, 17))
    assert clock[0].type == ("bcd16" if bcd else "uint16")
    assert ("second" if backwards else "year") in clock[0].notes[0]


@pytest.mark.parametrize("noise", [1, 30])
def test_noise_is_neither_counter_nor_state(noise: int) -> None:
    r = random.Random(noise)
    reading = one("uint16", [500 + r.randint(-noise, noise) for _ in range(20)])
    assert not set(reading.marks) & {"counter", "timestamp", "seconds"}


def test_an_integer_that_follows_a_float_gets_its_scale() -> None:
    r = random.Random(1)
    volts = [230 + r.gauss(0, 1) for _ in range(12)]
    fields = [Hidden(0, "float32", "ABCD", [words("float32", "ABCD", v) for v in volts])]
    fields += [Hidden(2, "uint16", "ABCD", [words("uint16", "ABCD", 10 * v) for v in volts])]
    readings = infer(series_of_fields(fields)).readings
    assert readings[-1].scale == pytest.approx(0.1)
    assert "holding:0 times 10" in " ".join(readings[-1].notes)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(st.integers(0, 0xFFFF), min_size=7, max_size=7), min_size=1, max_size=6))
def test_readings_tile_any_run_once_and_make_a_draft(columns: list[list[int]]) -> None:
    series = Series(tuple(START_S + i for i in range(7)), {"input": {50 + i: w for i, w in enumerate(columns)}})
    inference = infer(series)
    covered = [a for r in inference.readings for a in range(r.address, r.address + r.registers)]
    assert covered == list(range(50, 50 + len(columns)))
    assert all(0 <= r.probability <= 1 for r in inference.readings)


@given(
    st.sampled_from(NUMBERS), st.lists(st.lists(st.integers(0, 0xFFFF), min_size=4, max_size=4), min_size=1, max_size=9)
)
def test_costs_are_positive_numbers(kind: str, rows: list[list[int]]) -> None:
    size = 1 if kind.endswith("16") else 4 if kind.endswith("64") else 2
    for order in orders_of(kind):
        assert cost([row[:size] for row in rows], kind, order) > 0


def test_from_a_hidden_map_over_the_wire_to_a_profile_that_reads_it(tmp_path: Path) -> None:
    """Dump over time, infer, draft, load, read: the values read are the original ones."""
    fields = hidden_device(12, 12)
    end = fields[-1].address + len(fields[-1].rows[0])

    async def main() -> None:
        made = bank([CellSpan("holding", 0, end)])
        wire = Wired(unit(made, read_registers=20), latency_s=0.001)

        def live() -> None:
            now = int(loop().time() // 10)
            for f in fields:
                for i, word in enumerate(f.rows[min(now, 11)]):
                    made.poke("holding", f.address + i, word)
            if now < 11:
                loop().call_at(10 * (now + 1), live)

        live()
        job = DumpJob(
            DeviceTarget(URL, 1), register_spans([f"holding:0..{end - 1}"]), functions=False, passes=12, every_s=10.0
        )
        await dump(job, tmp_path / "d.jsonl", words="", connector=wire, clock=loop())
        dumps = [load_dump(tmp_path / "d.jsonl")]
        inference = infer(series_of(dumps))
        text = draft_profile(inference, dumps, "hidden")
        assert "limits: {functions: [3], read_registers: 20}  # to write: add" in text
        checked(text, tmp_path / "p.yaml")
        (tmp_path / "p.yaml").write_text(text)
        profile = load_profile(tmp_path / "p.yaml")
        assert profile.form.limits.read_registers == 20
        certain = [r for r in inference.readings if r.level is Level.CERTAIN]
        assert len(certain) >= 4
        assert text.count("# certain") == len(certain)
        async with point_at(DeviceTarget(URL, 1, profile), connector=wire, clock=loop()) as point:
            answers = await point.read(tags_of([], "modbus", profile=profile))
        for reading in certain:
            truth = next(f for f in fields if f.is_read_by(reading))
            value = answers[f"holding_{reading.address}"].value.value
            assert isinstance(value, int | float)
            assert words(truth.kind, truth.order, value / reading.scale) == truth.rows[-1]

    run_virtually(main())


def test_dumps_of_two_units_or_of_nothing_are_refused(tmp_path: Path) -> None:
    for name, unit_id in (("a", 1), ("b", 2)):
        (tmp_path / name).write_text(
            f'{{"fieldtwin_dump":1,"protocol":"modbus","address":{unit_id},"ranges":[]}}\n'
            '{"pass":0,"at":"2026-01-01T00:00:00+00:00"}\n{"read":"holding:0","hex":"0001","us":1}\n{"ended":"x"}\n'
        )
    (tmp_path / "c").write_text('{"fieldtwin_dump":1,"protocol":"modbus","address":1,"ranges":[]}\n')
    with pytest.raises(FileInvalid, match="two units"):
        series_of([load_dump(tmp_path / "a"), load_dump(tmp_path / "b")])
    with pytest.raises(FileInvalid, match="without values"):
        series_of([load_dump(tmp_path / "c")])


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("rtu:/dev/ttyUSB0?baudrate=9600&frame=8E1", "factory: {baudrate: 9600, frame: 8E1, unit: 17}"),
        ("rtu:/dev/ttyUSB0?baudrate=9600", "factory: {baudrate: 9600, unit: 17}"),
        ("tcp://192.0.2.1:502", "factory: {unit: 17}"),
    ],
)
def test_draft_has_the_serial_settings_of_the_dump(tmp_path: Path, endpoint: str, expected: str) -> None:
    path = tmp_path / "dump"
    path.write_text(
        f'{{"fieldtwin_dump":2,"protocol":"modbus","endpoint":"{endpoint}","address":17,"ranges":[]}}\n'
        '{"pass":0,"at":"2026-01-01T00:00:00+00:00"}\n{"read":"holding:0","hex":"0001","us":1}\n{"ended":"x"}\n'
    )
    dumps = [load_dump(path)]
    text = draft_profile(infer(series_of(dumps)), dumps)
    assert expected in text.splitlines()
    checked(text, tmp_path / "p.yaml")
