"""The command line's contract: exit codes, responsibility, position in files; invalid input is refused before anything starts.

The tests call `main` in this process as the console script does.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldtwin.cli.main import COMMANDS, SECTIONS, main

SYSTEMS = Path(__file__).resolve().parents[2] / "profiles" / "systems"
DEVICES = SYSTEMS.parent / "devices"

Invoke = Callable[..., tuple[int, str, str]]


@pytest.fixture
def invoke(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Invoke:
    """Call the command; return exit code, stdout, stderr. Run directories are in `tmp_path`."""
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))

    def call(*args: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fieldtwin", *args])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        code = ended.value.code
        return (code if isinstance(code, int) else 0), out, err

    return call


@pytest.fixture
def plant(tmp_path: Path) -> Callable[..., str]:
    """A copy of the observatory with some text changed: ``plant(old, new, ...)`` returns its path."""

    def copy(*changes: str, prototype: tuple[str, ...] = ()) -> str:
        folder = tmp_path / "systems"
        folder.mkdir(exist_ok=True)
        for name, wanted in (("observatory.yaml", changes), ("observatory.prototype.yaml", prototype)):
            text = (SYSTEMS / name).read_text(encoding="utf-8")
            for old, new in zip(wanted[::2], wanted[1::2], strict=True):
                assert old in text, old
                text = text.replace(old, new, 1)
            (folder / name).write_text(text, encoding="utf-8")
        return str(folder / "observatory.yaml")

    return copy


def line_of(path: str, text: str) -> int:
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    return next(i for i, line in enumerate(lines, 1) if text in line)


# -- usage ------------------------------------------------------------------------------------------------------------


def test_neither_flag_is_a_default_and_both_exclude_each_other(invoke: Invoke) -> None:
    code, out, err = invoke("run", "observatory")
    assert (code, out) == (2, "")
    assert "--plant" in err
    assert "--prototype" in err
    assert "real hardware" in err
    code, out, err = invoke("run", "observatory", "--plant", "--prototype")
    assert (code, out) == (2, "")
    assert "exclude" in err


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (("run", "observatory", "--plant", "--speed", "2"), "these options are for emulated devices"),
        (("run", "observatory", "--plant", "--field", "localhost"), "these options are for emulated devices"),
        (("run", "observatory", "--prototype", "--allow-writes"), "--plant"),
        (("run", "observatory", "--prototype", "--for", "soon"), "duration"),
        (("run", "observatory", "--prototype", "--commands", "1,x"), "periods in seconds"),
        (("run", "observatory", "--prototype", "--commands", "40000"), "periods in seconds"),
        (("run", "observatory", "--prototype", "--recording", "ctd"), "NAME=VALUE"),
        (("run", "observatory", "--prototype", "--recording", "ctx=x.jsonl"), "ctd"),
        (("run", "observatory", "--prototype", "--listen", "lan2=tcp://127.0.0.1:0"), "line1, can0, lan"),
        (("run", "observatory", "--prototype", "--listen", "lan=tpc://127.0.0.1:0"), "tcp:"),
        (("run", "observatory", "--prototype", "--instance", "a/b"), "instance name"),
        (("run", "observatry", "--prototype"), "observatory"),
        (("emulate", "observatry"), "observatory"),
        (("emulate", "ctd-reference"), "--on"),
        (("emulate", "observatory", "--on", "pty:x"), "--on"),
        (("emulate", "observatory", "--control", "nowhere"), "HOST:PORT"),
        (("import", "cast.txt"), ".cnv"),
        (("topside", "observatory"), "--far"),
        (("topside", "lab_vehicle"), "lab_vehicle has no acoustic modem"),
        (("fly",), "No such command"),
        (("shore", "observatory"), "now called 'topside'"),
        (("check", "modbus-master"), "now called 'modbus-client'"),
    ],
)
def test_invalid_usage_is_reported_in_one_line(invoke: Invoke, args: tuple[str, ...], told: str) -> None:
    code, out, err = invoke(*args)
    assert code == 2, err
    assert out == ""
    assert told in err
    assert "Traceback" not in err


def test_a_missing_field_simulator_is_unreachable(invoke: Invoke) -> None:
    code, out, err = invoke("run", "observatory", "--prototype", "--field", "127.0.0.1:1")
    assert (code, out) == (4, "")
    assert "127.0.0.1:1" in err


# -- files --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "line", "told"),
    [
        ("    bus: line1", "\tbus: line1", "\tbus: line1", "spaces, never tabs"),
        ("    unit: 1\n    expect: {serial: \"0042\"}", "   unit: 1\n    expect: {serial: \"0042\"}", "   unit: 1", "not YAML"),
        ("stale_after_ms: 1500", "stale_after: 1500", "stale_after: 1500", "did you mean 'stale_after_ms'?"),
        ("timeout_ms: 300", "timeout_ms: soon", "timeout_ms: soon", "a whole number"),
        ("timeout_ms: 300", "timeout_ms: 0", "timeout_ms: 0", "at least 1"),
        ("    bus: lan", "    bus: lann", "bus: lann", "did you mean 'lan'?"),
        ("    profile: ctd-reference", "    profile: ctd-refrence", "profile: ctd-refrence", "ctd-reference"),
        ("poll: {values:", "poll: {vales:", "poll: {vales:", "did you mean 'values'?"),
        ("{tag: ctd.sample}", "{tag: ctd.sampel}", "{tag: ctd.sampel}", "did you mean 'sample'?"),
        ("{tag: ctd.sample}", "{tag: cdt.sample}", "{tag: cdt.sample}", "did you mean 'ctd'?"),
        ("writable: [sample_period_s]", "writable: [pressure]", "writable: [pressure]", "read-only"),
        ("safe: {sample_period_s: 0}", "safe: {sample_period_s: 40000}", "safe: {sample_period_s: 40000}", "32767"),
        ("map: [slope_long, slope_lateral]", "map: [slope_long, slope_lat]", "map: [slope_long, slope_lat]", "slope_lateral"),
        ("url: \"tcp://modem:502\"", "url: \"tpc://modem:502\"", "tpc://modem:502", "tcp:"),
        ("expect: {serial: \"0042\"}", "expect: {seriel: \"0042\"}", "expect: {seriel", "did you mean 'serial'?"),
        ("fieldtwin.plc.relay:Relay", "fieldtwin.plc.relay:Realy", "fieldtwin.plc.relay:Realy", "Realy"),
        ("response: modem.outbox", "respons: modem.outbox", "respons: modem.outbox", "response"),
        ("fieldtwin: 1", "fieldtwin: 2", "fieldtwin: 2", "fieldtwin"),
        ("    relay:\n", "    relay:\n      task: fats\n", "task: fats", "no task 'fats'; expected main"),
        ("cycle_ms: 10", "tasks: {a: {interval_ms: 9}, b: {single: ctd.nought}}", "single: ctd.nought", "got ctd.nought"),
        ("cycle_ms: 10", "tasks: {b: {single: modem.link_state}}", "tasks: {b:", "only SINGLE tasks"),
    ],
)  # fmt: skip
def test_a_wrong_system_file_is_reported_with_line_and_expected_content(
    invoke: Invoke, plant: Callable[..., str], old: str, new: str, line: str, told: str, tmp_path: Path
) -> None:
    path = plant(old, new)
    code, out, err = invoke("run", path, "--prototype", "--for", "1s")
    assert code == 3, err
    assert out == ""
    assert f"{path}:" in err
    where = err.split(f"{path}:", 1)[1].split(" ", 1)[0]
    # YAML reports some one line later
    assert int(where.split(":")[0]) in (line_of(path, line), line_of(path, line) + 1), err
    assert told in err
    assert not (tmp_path / "run").exists() or not list((tmp_path / "run").glob("*/*.log"))  # nothing was started


def test_two_devices_on_one_unit_id(invoke: Invoke, plant: Callable[..., str]) -> None:
    second = "  ctd2:\n    profile: ctd-reference\n    bus: line1\n    unit: 1\n  inclinometer:\n"
    path = plant("  inclinometer:\n", second)
    code, _, err = invoke("run", path, "--plant", "--for", "1s")
    assert code == 3
    assert f"{path}:{line_of(path, 'ctd2:') + 3}:" in err
    assert "'ctd2' has unit 1 on 'line1', and so has 'ctd'" in err


def test_a_duplicate_key(invoke: Invoke, plant: Callable[..., str]) -> None:
    path = plant("  lan:   {url", "  line1: {url")
    code, _, err = invoke("run", path, "--plant")
    assert code == 3
    assert "'line1' is defined twice" in err


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("unmapped: refuse", "unmaped: refuse", "did you mean 'unmapped'?"),
        ("prototype_of: observatory.yaml", "prototype_of: other.yaml", "`prototype_of` names a different system file"),
        ("  lan:   {listen", "  lan2:  {listen", "the system has no bus 'lan2'"),
        ("listen: \"pty:line1\"", "listen: \"can:fieldtwin/x\"", "pty or tcp"),
        ("recording: cast.jsonl", "recording: nowhere.jsonl", "no recording 'nowhere.jsonl'"),
        ("  modem:        {model: mailbox", "  moden:        {model: mailbox", "no device 'moden'"),
        ("model: mailbox,", "model: mailbox, recording: cast.jsonl,", "one of `recording"),
        ("at_end: hold", "at_end: stop", "at_end"),
    ],
)  # fmt: skip
def test_a_wrong_prototype_file(invoke: Invoke, plant: Callable[..., str], old: str, new: str, told: str) -> None:
    path = plant(prototype=(old, new))
    code, _, err = invoke("run", path, "--prototype", "--for", "1s")
    assert code == 3, err
    assert "observatory.prototype.yaml:" in err
    assert told in err


def test_an_emulated_device_with_other_commands_is_refused_at_start(
    invoke: Invoke, plant: Callable[..., str], tmp_path: Path
) -> None:
    other = tmp_path / "ctd-other.yaml"
    text = (DEVICES / "ctd-reference.yaml").read_text(encoding="utf-8")
    other.write_text(text.replace("set_period", "set_interval"), encoding="utf-8")
    path = plant(prototype=("ctd:          {", f"ctd:          {{profile: {other}, "))
    code, out, err = invoke("run", path, "--prototype", "--for", "1s")
    assert (code, out) == (3, "")
    assert "'ctd'" in err
    assert "unknown to the device: set_period" in err
    assert "unknown to the driver: set_interval" in err
    assert not list((tmp_path / "run").glob("*/*.log"))


def test_a_transmitter_on_a_serial_line_is_refused_when_the_file_is_read(
    invoke: Invoke, plant: Callable[..., str]
) -> None:
    path = plant("    bus: lan\n    unit: 1", "    bus: line1\n    unit: 2")
    code, _, err = invoke("run", path, "--plant", "--for", "1s")
    assert code == 3, err
    assert f"{path}:{line_of(path, 'unit: 2') - 1}:" in err
    assert "TCP" in err


# -- recordings ---------------------------------------------------------------------------------------------------------


def test_a_cast_without_a_required_column_names_its_columns(invoke: Invoke, tmp_path: Path) -> None:
    cast = tmp_path / "x.cnv"
    cast.write_text(
        "* Sea-Bird SBE 9 Data File:\n# nquan = 2\n# nvalues = 1\n# units = specified\n"
        "# name 0 = prDM: Pressure, Digiquartz [db]\n# name 1 = t090C: Temperature [ITS-90, deg C]\n"
        "# interval = seconds: 0.5\n# bad_flag = -9.990e-29\n*END*\n      1.0    10.0\n",
        encoding="latin-1",
    )
    code, out, err = invoke("import", str(cast), "-o", str(tmp_path / "x.jsonl"))
    assert (code, out) == (3, "")
    assert "conductivity" in err
    assert "prDM" in err
    assert not (tmp_path / "x.jsonl").exists()


def test_a_file_that_is_not_a_recording(invoke: Invoke, tmp_path: Path) -> None:
    (tmp_path / "no.jsonl").write_text("not a recording\n", encoding="utf-8")
    recording = f"ctd={tmp_path / 'no.jsonl'}"
    code, _, err = invoke("run", "observatory", "--prototype", "--for", "1s", "--recording", recording)
    assert code == 3, err
    assert "no.jsonl:1" in err
    code, _, err = invoke("run", "observatory", "--prototype", "--for", "1s", "--recording", "ctd=nowhere.jsonl")
    assert code in (2, 3), err
    assert "nowhere.jsonl" in err


# -- the program itself ----------------------------------------------------------------------------------------------------


def test_help_lists_every_command(invoke: Invoke) -> None:
    code, out, _ = invoke("--help")
    assert code == 0
    for name, (_, text) in COMMANDS.items():
        assert name in out
        assert text.split(".")[0].split(":")[0] in " ".join(out.split())


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_explains_itself(invoke: Invoke, command: str) -> None:
    code, out, _ = invoke(command, "--help")
    assert code == 0
    assert out.startswith("Usage: fieldtwin " + command)


@pytest.mark.parametrize("kind", ["system", "prototype", "profile", "faults", "scenario", "waivers", "rules"])
def test_schemas_are_json_and_refuse_unknown_keys(invoke: Invoke, kind: str) -> None:
    code, out, err = invoke("schema", kind)
    assert (code, err) == (0, "")
    schema = json.loads(out)
    assert schema["additionalProperties"] is False
    refs = set(re.findall(r'"#/\$defs/([^"]+)"', out))
    assert refs <= set(schema.get("$defs", {}))


def test_doctor_writes_json(invoke: Invoke) -> None:
    code, out, _ = invoke("doctor", "--json")
    checks = json.loads(out)
    assert code == (1 if any(c["verdict"] == "bad" for c in checks) else 0)
    assert {"check", "verdict", "found", "advice"} == set(checks[0])


def test_options_can_come_from_the_environment(invoke: Invoke, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN_INSTANCE", "a/b")  # a flag's value, from FIELDTWIN_<COMMAND>_<FLAG>
    code, _, err = invoke("run", "observatory", "--prototype")
    assert code == 2
    assert "instance name" in err


def test_a_reader_that_closes_early_is_not_an_error() -> None:
    environment = {**os.environ, "PYTHONPATH": str(SYSTEMS.parents[1])}
    process = subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", "schema", "system"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(20) == 0


def test_every_command_is_in_one_section_of_the_help() -> None:
    assert sorted(name for names in SECTIONS.values() for name in names) == sorted(COMMANDS)
