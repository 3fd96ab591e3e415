"""Watching: samples over time, bounded histories, sparklines, a picture; and the commands read, write, watch."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from commissioning_rig import URL, Wired, bank, loop, run_virtually, unit
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.cli.device import dump_command, read_command, watch_command, write_command
from fieldtwin.commissioning.access.address import tags_of
from fieldtwin.commissioning.access.plotting import check_plot, plot
from fieldtwin.commissioning.access.point import PointValue
from fieldtwin.commissioning.access.reading import DeviceTarget, point_at
from fieldtwin.commissioning.access.watching import BLOCKS, MOST_SAMPLES, History, samples, sparkline
from fieldtwin.commissioning.access.writing import before, plan_write
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.gateway.core.errors import FileInvalid, ModbusExceptionReply, UsageError
from fieldtwin.gateway.core.values import Quality, Reason, TagValue


@given(st.lists(st.one_of(st.none(), st.floats(allow_nan=False, allow_infinity=False)), max_size=40))
def test_a_sparkline_has_a_character_a_value_and_its_ends_at_the_ends(values: list[float | None]) -> None:
    line = sparkline(values)
    assert len(line) == len(values)
    assert all((c == " ") == (v is None) for c, v in zip(line, values, strict=True))
    known = [v for v in values if v is not None]
    if known and max(known) - min(known) not in (0.0, float("inf")):
        assert line[values.index(max(known))] == BLOCKS[-1]
        assert line[values.index(min(known))] == BLOCKS[0]


def test_a_history_is_bounded_and_remembers_its_extremes() -> None:
    history = History()
    for i in range(MOST_SAMPLES + 10):
        history.add(i, PointValue(TagValue(i, Quality.GOOD, Reason.NONE, 1, bytes([i % 256]))))
    history.add(0, PointValue(TagValue(None, Quality.BAD, Reason.TIMEOUT)))
    assert len(history.values) == MOST_SAMPLES
    assert (history.samples, history.bad, history.least) == (MOST_SAMPLES + 11, 1, 0)
    assert history.changes == MOST_SAMPLES + 9
    assert history.sparkline(3)[-1] == " "


def test_samples_keep_their_pace_and_a_slow_round_is_not_made_up_for() -> None:
    async def main() -> None:
        made = bank([CellSpan("holding", 0, 4)])
        slow = Wired(unit(made), mute=lambda adu, before: before == 1)
        async with point_at(DeviceTarget(URL, 1, timeout_s=2.5), connector=slow, clock=loop()) as point:
            tags = tags_of(["holding:0"], "modbus")
            got = [s async for s in samples(point, tags, loop(), 1.0, 4)]
        assert [round(s.t_s, 1) for s in got] == [0.0, 1.0, 3.5, 4.5]
        assert [bool(s.answers["holding:0"].problem) for s in got] == [False, True, False, False]
        assert len(slow.requests) == 4

    run_virtually(main())


def test_a_picture_is_made_or_refused_before_the_watching(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="unsupported image format"):
        check_plot(tmp_path / "x.txt")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match=r"--plot needs matplotlib .*\[plot\]"):
        check_plot(tmp_path / "x.png")


def test_a_picture_has_a_curve_for_each_tag_with_numbers(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    tags = tags_of(["holding:0", "holding:1"], "modbus")
    histories = {t.name: History() for t in tags}
    for i in range(5):
        histories["holding:0"].add(i, PointValue(TagValue(i, Quality.GOOD, Reason.NONE, 1, b"x")))
    assert plot(tmp_path / "p.png", "t", tags, histories) == 1
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    assert plot(tmp_path / "q.png", "t", tags[1:], histories) == 0
    with pytest.raises(FileInvalid):
        plot(tmp_path / "no" / "p.png", "t", tags, histories)


def test_a_dry_run_needs_no_device() -> None:
    for command, args in (
        (read_command.command, ["tcp://192.0.2.1", "holding:100"]),
        (watch_command.command, ["tcp://192.0.2.1", "holding:100"]),
        (write_command.command, ["tcp://192.0.2.1", "holding:100=5"]),
        (dump_command.command, ["tcp://192.0.2.1", "holding:100..100"]),
    ):
        result = CliRunner().invoke(command, [*args, "--dry-run"], standalone_mode=False)
        assert result.return_value == 0, result.output
        assert result.stdout.startswith("00 01 00 00 00 06 01 0")
        assert "00 64" in result.stdout


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["tcp://192.0.2.1", "holding:1=5"], "--yes"),
        (["rtu:/dev/ttyS99", "holding:1=5", "--unit", "0", "--yes"], "--i-know"),
        (["tcp://192.0.2.1", "--restart-communications", "--yes"], "--i-know"),
        (["tcp://192.0.2.1", "holding:1"], "ITEM=VALUE"),
        (["tcp://192.0.2.1", "input:1=5", "--yes"], "read-only"),
        (["can:fieldtwin/127.0.0.1:1", "1010h:01=1", "--type", "uint32", "--yes"], "--i-know"),
    ],
)
def test_an_unconfirmed_write_is_refused_before_anything_is_opened(args: list[str], says: str) -> None:
    result = CliRunner().invoke(write_command.command, args, standalone_mode=False)
    assert isinstance(result.exception, UsageError)
    assert says in str(result.exception)


def test_a_restart_is_shown_by_a_dry_run() -> None:
    args = ["rtu:/dev/ttyS99", "--unit", "9", "--restart-communications", "--dry-run"]
    result = CliRunner().invoke(write_command.command, args, standalone_mode=False)
    assert result.stdout.startswith("09 08 00 01 00 00")


def test_a_written_value_is_restored_even_if_a_later_write_fails() -> None:
    async def main() -> None:
        made = bank([CellSpan("holding", 0, 2), CellSpan("holding", 2, 1, "ro")], {"holding": {0: [1, 2, 3]}})
        async with point_at(DeviceTarget(URL, 1), connector=Wired(unit(made)), clock=loop()) as point:
            writes = [plan_write(tags_of([f"holding:{i}"], "modbus")[0], "9") for i in range(3)]
            old = [await before(point, w) for w in writes]
            with pytest.raises(ModbusExceptionReply):
                await write_command._carry_out(point, writes, old, 0.0)
        assert list(made.read("holding", 0, 3, 0)) == [1, 2, 3]

    run_virtually(main())
