"""`fieldtwin run --thread` and `fieldtwin shadow`: two processes connected only by a thread."""

from __future__ import annotations

from pathlib import Path

import pytest
from procs import fieldtwin, free_port, no_tracebacks, run_to_end, wait_for


@pytest.mark.long
def test_a_shadow_opposite_a_prototype_follows_its_states_and_survives_its_own_death(tmp_path: Path) -> None:
    root, place = tmp_path / "r", f"tcp://127.0.0.1:{free_port()}"
    with fieldtwin(
        root, "run", "observatory", "--prototype", "--commands", "1,2,0,-1", "--for", "12s", "--json", "--thread", place
    ) as run:
        plant = run.control("observatory", "thread")
        with fieldtwin(root, "shadow", "observatory", "--from", place, "--for", "60s", "--json", name="first") as first:
            wait_for(lambda: plant("get")["sent_through"] > 0, 20, f"something arrived; {first.err}")
            first.process.kill()
        with fieldtwin(
            root, "shadow", "observatory", "--from", place, "--for", "60s", "--json", name="second"
        ) as second:
            assert run.wait(60) in (0, 1), run.err
            second.signal(2)
            assert second.wait(20) == 0, second.err
        seen = second.summary
    assert (seen["state"], seen["period_s"]) == ("OFF", -1)
    assert seen["prototype"], "ruling 15"
    assert seen["statuses"] == seen["agreed"] >= 3
    assert seen["measurements"] > 20
    assert seen["twinning_rate_hz"] > 1
    assert run.summary["ok"], "nobody noticed that it was watched"
    no_tracebacks(root)


def test_a_shadow_without_a_plant_reports_it(tmp_path: Path) -> None:
    ended = run_to_end(
        tmp_path / "r",
        "shadow",
        "observatory",
        "--from",
        f"tcp://127.0.0.1:{free_port()}",
        "--for",
        "500ms",
        name="alone",
    )
    assert ended.process.returncode == 4
    assert "the plant's thread" in ended.err
    assert "connection refused" in ended.err
    wrong = run_to_end(tmp_path / "r", "shadow", "observatory", "--from", "mqtt://broker", name="wrong")
    assert wrong.process.returncode == 2
    assert "mqtt://[USER@]HOST[:PORT]/GROUP/NODE" in wrong.err
