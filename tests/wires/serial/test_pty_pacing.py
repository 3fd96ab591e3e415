"""The model of a serial line: pure arithmetic, checked against the standard's numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.endpoint import SerialSettings


@pytest.mark.parametrize(
    ("baudrate", "frame", "char_us", "t3_5_us"),
    [
        (19200, "8E1", 572.9, 2005.2),
        (9600, "8N1", 1041.7, 3645.8),
        (9600, "8N2", 1145.8, 4010.4),
        (1200, "7E1", 8333.3, 29166.7),
        (115200, "8N1", 86.8, 1750.0),  # fixed above 19200
        (38400, "8E1", 286.5, 1750.0),
    ],
)
def test_times_of_a_line(baudrate: int, frame: str, char_us: float, t3_5_us: float) -> None:
    line = SerialPacer(SerialSettings(baudrate, frame))
    assert line.duration_ns(1) / 1000 == pytest.approx(char_us, abs=0.1)
    assert line.t3_5_ns / 1000 == pytest.approx(t3_5_us, abs=0.1)
    assert line.t1_5_ns / 1000 == pytest.approx(750 if baudrate > 19200 else 1.5 * char_us, abs=0.1)


def test_characters_queue_one_after_the_other() -> None:
    line = SerialPacer(SerialSettings(10_000, "8N1"))  # 1 ms per character
    assert line.earliest_end(5_000_000, 3) == 8_000_000
    assert line.earliest_end(5_000_000, 3) == 8_000_000, "asking takes no time on the line"
    assert line.send(5_000_000, 3) == 8_000_000
    assert line.send(6_000_000, 1) == 9_000_000
    assert line.send(20_000_000, 1) == 21_000_000
    assert line.busy_until_ns == 21_000_000


@given(
    st.integers(50, 4_000_000),
    st.sampled_from(["8N1", "8E1", "7E2"]),
    st.lists(st.tuples(st.integers(0, 10**7), st.integers(0, 300)), max_size=20),
)
def test_never_faster_than_the_line_and_never_backwards(
    baudrate: int, frame: str, sends: list[tuple[int, int]]
) -> None:
    settings = SerialSettings(baudrate, frame)
    line = SerialPacer(settings)
    now_ns, before_ns, total = 0, 0, 0
    for wait_ns, count in sends:
        now_ns += wait_ns
        end_ns = line.send(now_ns, count)
        total += count
        assert end_ns >= max(before_ns, now_ns)
        assert end_ns >= total * settings.bits_per_char * 10**9 // baudrate
        before_ns = end_ns
