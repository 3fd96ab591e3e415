"""Each process is killed with SIGKILL 100 times at random instants, also while it starts: its stored data remain consistent.

The instants are seeded (FIELDTWIN_KILLS_SEED, default 0). FIELDTWIN_KILLS and FIELDTWIN_KILLS_OF_A_RUN set the numbers;
a whole run is killed 12 times by default, because it takes seconds to start.
"""

from __future__ import annotations

import json
import os
import signal
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import pytest
from fan_hall import hall, writes
from many_kills_rig import KILLS, KILLS_OF_A_RUN, nothing_is_left, processes_of, victim
from procs import (
    Asking,
    alive,
    command_from_far,
    every_device_online,
    fieldtwin,
    free_port,
    held_by,
    wait_for,
)
from stores import ask, log_of, own

pytestmark = [pytest.mark.long, pytest.mark.timeout(900 + 15 * max(KILLS, KILLS_OF_A_RUN))]

RETAINING = """
PROGRAM Fan
VAR_INPUT temperature : REAL; END_VAR
VAR_OUTPUT mode : INT; scanned : DINT; sevenfold : DINT; END_VAR
VAR RETAIN n : DINT; seven : DINT; END_VAR
  n := n + 1;
  seven := seven + 7;
  scanned := n;
  sevenfold := seven;
  IF temperature > 10.0 THEN mode := 2; ELSE mode := 1; END_IF
END_PROGRAM
"""


def sequences(store: Path) -> dict[str, list[int]]:
    with closing(sqlite3.connect(store)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        found: dict[str, list[int]] = {}
        for tag, sequence in db.execute("SELECT tag, sequence FROM exchange ORDER BY id"):
            found.setdefault(tag, []).append(sequence)
    return found


def answers(asking: Asking) -> bool:
    with suppress(OSError):
        return bool(asking("ready")["ready"])
    return False


def no_traceback(log: Path) -> None:
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    assert "Traceback" not in text, text[-3000:]


def test_the_plc_keeps_its_retained_values_whole_and_never_goes_back(tmp_path: Path) -> None:
    port, root = free_port(), tmp_path / "r"
    system = hall(tmp_path, port=port)
    (tmp_path / "fan.st").write_text(RETAINING)
    emulate = ("--control", "127.0.0.1:0", "--instance", "f", "--prototype-file", str(tmp_path / "hall.prototype.yaml"))
    with fieldtwin(root, "emulate", str(system), *emulate, name="field") as field:
        field.control("f", "field")
        with fieldtwin(root, "run", str(system), "--plant", "--allow-writes", "--instance", "p", "--json") as run:
            plc, gateway = run.control("p", "plc"), run.control("p", "gateway")
            every_device_online(gateway)
            os.kill(run.pid_of("p", "plc"), signal.SIGKILL)
            reached = seen = 0
            with victim(
                "plc",
                str(root / "p" / "plc.json"),
                root=root,
                imports="fieldtwin.plc.runtime.process,fieldtwin.plc.st.program",
            ) as it:

                def counted() -> int:
                    nonlocal reached, seen
                    variables = plc("get")["variables"]
                    n, seven = variables["control.scanned"], variables["control.sevenfold"]
                    if not n:
                        return 0
                    assert seven == 7 * n
                    assert n >= reached, f"it went back from {reached} to {n}"
                    reached, seen = n, seen + 1
                    return int(n)

                while it.starts < KILLS:
                    it.start()
                    if it.starts % 3:
                        wait_for(lambda: answers(plc), 20, it.log.read_text())
                        wait_for(counted, 20, "it scans")
                        it.at_some_instant(0.1)
                        counted()
                    else:
                        it.at_some_instant(0.2)  # while it starts
                    it.end()
                it.start()
                wait_for(lambda: answers(plc) and counted(), 20, it.log.read_text())
                wait_for(lambda: gateway("get")["plc"]["alive"], 10, "the gateway sees it")
                it.end(signal.SIGTERM)
                assert seen > KILLS // 2
                no_traceback(it.log)
            run.signal(signal.SIGINT)
            run.wait(10)
        assert [w for w in writes(root / "p") if w[2] != 2] == []
    nothing_is_left(root)


def test_the_gateway_leaves_no_hole_and_no_double_in_the_exchange_log(tmp_path: Path) -> None:
    root = tmp_path / "r"
    with fieldtwin(root, "run", "observatory", "--prototype", "--commands", "none", "--instance", "g", "--json") as run:
        field, gateway, plc = (run.control("g", name) for name in ("field", "gateway", "plc"))
        every_device_online(gateway)
        command_from_far(field("get")["far"]["modem"], 1, 1)
        wait_for(lambda: held_by(field, "ctd", "sample_period_s")[-1:] == ["0001"], 20, "the sensor samples")
        os.kill(run.pid_of("g", "gateway"), signal.SIGKILL)
        config = root / "g" / "gateway.json"
        with victim(
            "fieldtwin.twin.plant.controller", str(config), root=root, imports="fieldtwin.twin.site.system"
        ) as it:
            while it.starts < KILLS:
                it.start()
                if it.starts % 3:
                    wait_for(lambda: answers(gateway), 20, it.log.read_text())
                    it.at_some_instant(1.0)
                else:
                    it.at_some_instant(0.3)  # while it starts
                it.end()
            it.start()
            wait_for(lambda: answers(gateway), 20, it.log.read_text())
            every_device_online(gateway)
            wait_for(lambda: gateway("get")["tags"]["ctd.pressure"]["quality"] == "good", 20, "good values again")
            logged = int(plc("get")["variables"]["relay.logged"])
            store = root / "g" / "store.sqlite"
            wait_for(lambda: len(sequences(store)["relay.log"]) >= logged, 20, f"{logged} rows are stored")
            it.end(signal.SIGTERM)
            no_traceback(it.log)
        found = sequences(store)["relay.log"]
        assert found == list(range(1, len(found) + 1)), "holes, or doubles"
        assert len(found) > KILLS / 8
        for line in (root / "g" / "audit.jsonl").read_text(encoding="utf-8").splitlines():
            json.loads(line)
        run.signal(signal.SIGINT)
        run.wait(10)
    nothing_is_left(root)


def test_simulated_field_devices_come_back_on_their_ports_and_pseudo_terminals(tmp_path: Path) -> None:
    root, port = tmp_path / "r", free_port()
    can, lan = free_port(), free_port()
    words = (
        "emulate", "observatory", "--control", f"127.0.0.1:{port}", "--instance", "f", "--listen",
        f"can0=can:fieldtwin/127.0.0.1:{can}", "--listen", f"lan=tcp://127.0.0.1:{lan}",
    )  # fmt: skip
    field = Asking(("127.0.0.1", port))
    imports = "fieldtwin.cli.emulate.emulate_command,fieldtwin.twin.prototype.field_process"
    with victim("fieldtwin", *words, root=root, imports=imports) as it:
        while it.starts < KILLS:
            it.start()
            if it.starts % 3:
                wait_for(lambda: answers(field), 20, it.log.read_text())
                assert (root / "f" / "line1").exists()
                it.at_some_instant(0.1)
            else:
                it.at_some_instant(0.3)
            it.end()
            wait_for(lambda: len(processes_of(root)) <= 1, 5, str(processes_of(root)))
        it.start()
        wait_for(lambda: answers(field), 20, it.log.read_text())
        assert (root / "f" / "line1").exists()
        it.end(signal.SIGTERM)
        no_traceback(it.log)
    nothing_is_left(root)


def test_both_ends_of_a_digital_thread_have_the_same_log_in_the_end(tmp_path: Path) -> None:
    """The plant's end and its twin are killed alternately, each 100 times."""
    root, place = tmp_path / "r", f"tcp://127.0.0.1:{free_port()}"
    with fieldtwin(root, "run", "observatory", "--prototype", "--commands", "none", "--instance", "t", "--json") as run:
        gateway = run.control("t", "gateway")
        every_device_online(gateway)
        config = {
            "resolved": str(root / "t" / "system.pickle"), "run_dir": str(root / "t"),
            "place": place, "store": str(root / "t" / "knowledge.sqlite"), "prototype": True,
            "mapping": json.loads((root / "t" / "gateway.json").read_text())["mapping"],
        }  # fmt: skip
        (root / "thread.json").write_text(json.dumps(config))
        follow = ("twin", "observatory", "--from", place, "--instance", "tt", "--json")
        here, there = (root / name / "knowledge.sqlite" for name in ("t", "tt"))
        parts = ("twin.thread.end", "cli.twin.twin_command", "run.shadow.twin", "twin.plant.physical")
        imports = ",".join(f"fieldtwin.{part}" for part in parts)
        with (
            victim(
                "fieldtwin.twin.thread.plant_thread",
                str(root / "thread.json"),
                root=root,
                imports="fieldtwin.twin.site.system",
            ) as plant,
            victim("fieldtwin", *follow, root=root, imports=imports, seed=2) as twin,
        ):
            thread = Asking(str(root / "t" / "thread.sock"))
            while twin.starts < KILLS:
                plant.start()
                twin.start()
                if twin.starts % 3:
                    before = ask(there, "SELECT count(*) FROM event") or [(0,)]
                    wait_for(lambda: answers(thread), 20, plant.log.read_text())
                    if twin.starts % 10 == 1:  # some events must arrive
                        wait_for(
                            lambda past=before: (ask(there, "SELECT count(*) FROM event") or [(0,)])[0] > past[0],
                            30, twin.log.read_text(),
                        )  # fmt: skip
                    plant.at_some_instant(0.3)
                else:
                    plant.at_some_instant(0.4)
                for it in (plant, twin) if twin.starts % 2 else (twin, plant):
                    it.end()
            plant.start()
            twin.start()
            wait_for(lambda: answers(thread), 20, plant.log.read_text())
            wait_for(lambda: thread("get")["links"] and thread("get")["waiting"] == 0, 60, str(thread("get")))
            twin.end(signal.SIGINT)
            plant.end(signal.SIGTERM)
            no_traceback(plant.log)
            no_traceback(twin.log)
        run.signal(signal.SIGINT)
        run.wait(10)
    mine = log_of(here, own(here, "plant"))
    known = log_of(there, own(here, "plant"))
    assert len(known) > KILLS
    assert [row[0] for row in known] == list(range(1, len(known) + 1)), "holes, or doubles"
    assert known == mine[: len(known)]
    nothing_is_left(root)


def test_a_whole_run_leaves_no_process_and_the_next_one_starts(tmp_path: Path) -> None:
    """The supervisor is killed: its processes make the outputs safe and end."""
    root = tmp_path / "r"
    words = ("run", "observatory", "--prototype", "--commands", "none", "--json")
    imports = "fieldtwin.cli.run.run_command,fieldtwin.run.live.session"
    with victim("fieldtwin", *words, root=root, imports=imports) as it:
        gateway = Asking(str(root / "observatory" / "gateway.sock"))
        while it.starts < KILLS_OF_A_RUN:
            it.start()
            if it.starts % 2:
                wait_for(lambda: answers(gateway), 40, it.log.read_text())
                it.at_some_instant(1.0)
            else:
                it.at_some_instant(2.5)
            it.end()
            wait_for(lambda: len(processes_of(root)) <= 1, 15, str(processes_of(root)))
        it.start()
        wait_for(lambda: answers(gateway), 40, it.log.read_text())
        every_device_online(gateway)
        it.end(signal.SIGINT)
        assert not alive(it.pid)
        no_traceback(it.log)
    nothing_is_left(root)
    for store in root.rglob("store.sqlite"):
        for found in sequences(store).values():
            assert len(found) == len(set(found))
