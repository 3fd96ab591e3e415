"""The doctor's conclusions from a computer's figures, and its queries to the computer."""

from __future__ import annotations

import grp
import os
from pathlib import Path

import pytest

from fieldtwin.doctor.checks import _disk, _run_directory, examine
from fieldtwin.doctor.host import cgroup_quota, clock_state, cpu_count, join_advice, kernel_number
from fieldtwin.doctor.verdicts import (
    ClockState,
    HostVerdict,
    can_interface_verdict,
    clock_verdict,
    processor_verdict,
    quota_of,
    watches_verdict,
)


@pytest.mark.parametrize(
    ("state", "verdict"),
    [
        (None, HostVerdict.NOTE),
        (ClockState(True, 0.004, 2026), HostVerdict.OK),
        (ClockState(False, 16.0, 2026), HostVerdict.NOTE),
        (ClockState(True, 0.004, 1970), HostVerdict.BAD),
    ],
)
def test_verdict_on_the_clock(state: ClockState | None, verdict: HostVerdict) -> None:
    check = clock_verdict(state)
    assert check.verdict is verdict
    assert bool(check.advice) is (verdict is not HostVerdict.OK)


@pytest.mark.parametrize(("text", "quota"), [("max 100000\n", None), ("150000 100000", 1.5), ("", None), ("1 0", None)])
def test_quota_of_a_cgroup(text: str, quota: float | None) -> None:
    assert quota_of(text) == quota


def test_less_than_a_processor_is_reported() -> None:
    assert processor_verdict(8, None).verdict is HostVerdict.OK
    assert processor_verdict(8, 2.0).verdict is HostVerdict.OK
    tight = processor_verdict(8, 0.5)
    assert tight.verdict is HostVerdict.NOTE
    assert "0.5" in tight.found


def test_verdict_on_the_inotify_limit() -> None:
    assert watches_verdict(128).verdict is HostVerdict.OK
    assert watches_verdict(None).verdict is HostVerdict.OK
    assert watches_verdict(4).verdict is HostVerdict.NOTE


def test_the_group_to_join_is_the_group_that_owns_the_port(tmp_path: Path) -> None:
    port = tmp_path / "ttyUSB0"
    port.write_bytes(b"")
    port.chmod(0o660)
    group = grp.getgrgid(port.stat().st_gid).gr_name
    assert f"usermod -aG {group} " in join_advice([str(port)])
    port.chmod(0o600)
    assert "udev" in join_advice([str(port)])


def test_the_checks_run_on_this_computer() -> None:
    assert cpu_count() >= 1
    assert (cgroup_quota() or 1) > 0
    assert kernel_number("no/such") is None
    assert kernel_number("kernel/pid_max")
    state = clock_state()
    assert state is None or (state.year >= 2024 and state.error_s >= 0)


def test_every_check_that_is_not_ok_names_the_remedy() -> None:
    checks = examine()
    assert len({c.name for c in checks}) == len(checks)
    assert {"python", "serial ports", "kernel CAN", "real time", "clock", "disk", "open files", "processors"} <= {
        c.name for c in checks
    }
    assert [c.name for c in checks if c.verdict is not HostVerdict.OK and not c.advice] == []


def test_a_run_directory_that_cannot_be_written_is_bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "file" / "below"))
    found = {c.name: c for c in examine()}["run directory"]
    assert found.verdict is HostVerdict.BAD
    assert os.fspath(tmp_path) in found.found


def test_an_unreadable_folder_is_not_an_internal_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A foreign directory, such as FIELDTWIN_RUN=/root/x for a service: any file system query may be refused."""

    def refused(*args: object, **more: object) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setenv("FIELDTWIN_RUN", "/somebody/else")
        for name in ("mkdir", "exists", "stat"):
            patched.setattr(Path, name, refused)
        checks = _run_directory(), _disk()
    assert checks[0].verdict is HostVerdict.BAD
    assert checks[1].found.endswith("at /")


def test_a_can_interface_that_is_down_is_reported() -> None:
    assert can_interface_verdict({}).verdict is HostVerdict.OK
    assert can_interface_verdict({"can0": True, "vcan0": True}).found == "can0, vcan0"
    down = can_interface_verdict({"can0": True, "can1": False})
    assert (down.verdict, down.found) == (HostVerdict.NOTE, "can0, can1 (down)")
    assert down.advice == "sudo ip link set can1 up type can bitrate 125000 restart-ms 100"
    assert can_interface_verdict({"vcan0": False}).advice == "sudo ip link set vcan0 up"
