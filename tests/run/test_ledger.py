"""The ledger of virtual hours: each entry counts once, and a kill costs at most the line being written."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.run.campaigns.ledger import Ledger
from fieldtwin.run.campaigns.many_seeds import SeedResult, fingerprint


def result(seed: int, ok: bool = True, wrong: int = 0) -> SeedResult:
    return SeedResult(seed, ok, () if ok else ("it failed",), 100, wrong, 1000, "ab" * 32)


def test_runs_add_up_and_are_known_again(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    first = Ledger(path)
    what = fingerprint("system", "1h")
    first.add(what, 1.0, result(1))
    first.add(what, 1.0, result(2, ok=False, wrong=1))
    again = Ledger(path)
    assert again.done(what) == {1, 2}
    assert again.done(fingerprint("system", "2h")) == set()
    assert (again.hours, again.wrong, [e.seed for e in again.failed]) == (2.0, 1, [2])
    assert again.failed[0].errors == ("it failed",)


def test_a_line_that_a_kill_cut_off_goes(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    Ledger(path).add("w", 0.5, result(1))
    whole = path.read_bytes()
    for cut in range(1, len(whole)):
        path.write_bytes(whole + whole[:cut].replace(b"\n", b""))
        ledger = Ledger(path)
        assert ledger.done("w") == {1}
        ledger.add("w", 0.5, result(3))
        assert Ledger(path).done("w") == {1, 3}


def test_a_file_that_is_not_a_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    path.write_text('{"what": 1}\n')
    with pytest.raises(FileInvalid, match="not a line of a ledger") as e:
        Ledger(path)
    assert e.value.line == 1


def test_texts_are_not_mixed_up() -> None:
    assert fingerprint("ab", "c") != fingerprint("a", "bc")


def test_a_campaign_that_the_ledger_knows_as_failed_does_not_end_ok(tmp_path: Path) -> None:
    """Defect: with --ledger a seed that had failed was not repeated, and the campaign ended with ok."""
    from click.testing import CliRunner

    from fieldtwin.cli.run.simulate_command import command

    path = tmp_path / "ledger.jsonl"
    words = ["observatory", "--for", "2s", "--seeds", "1..2", "--jobs", "1"]
    words += ["--ledger", str(path)]
    assert CliRunner().invoke(command, words, standalone_mode=False).return_value == 0
    first, second = path.read_text().splitlines()
    assert '"seed":2' in second
    path.write_text(first + "\n" + second.replace('"ok":true', '"ok":false') + "\n")
    ended = CliRunner().invoke(command, words, standalone_mode=False)
    assert ended.return_value == 1, ended.output
    assert "seed 2 failed before" in ended.output
    assert ended.output.rstrip().endswith("not ok")
