"""The list of third-party programs (`structured_text.yaml`), and `scripts/corpus`, which compares it with checkouts."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import yaml

from fieldtwin.plc.st.dialects import DIALECTS

LIST = Path(__file__).parent / "structured_text.yaml"
SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "corpus"
NEEDED = {"repository", "path", "commit", "dialect", "valid", "expected"}

PROGRAM = "PROGRAM Main VAR_OUTPUT n : INT; END_VAR n := n + 1; END_PROGRAM\n"
WRONG = "PROGRAM Main VAR_OUTPUT n : INT; END_VAR n := 1.5; END_PROGRAM\n"


def test_each_file_of_the_list_has_all_fields_and_is_listed_once() -> None:
    files = yaml.safe_load(LIST.read_text(encoding="utf-8"))["files"]
    assert len(files) > 100
    for entry in files:
        assert {*entry} - {"libraries", "tests", "differ"} == NEEDED, entry
        assert entry["repository"].count("/") == 1
        assert not entry["path"].startswith("/")
        assert entry["dialect"] in DIALECTS
        assert entry["valid"] in ("yes", "no", "unresolved")
        assert all(isinstance(entry[name], str) and entry[name] for name in NEEDED)
    assert max(Counter((entry["repository"], entry["path"]) for entry in files).values()) == 1


def run(checkouts: Path, *entries: str) -> subprocess.CompletedProcess[str]:
    made = checkouts / "list.yaml"
    made.write_text(
        "files:\n" + "".join(f"  - {{repository: a/b, commit: c, dialect: standard, {e}}}\n" for e in entries)
    )
    command = [sys.executable, str(SCRIPT), str(checkouts), "--list", str(made)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_script_counts_valid_files_and_prints_each_difference(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (folder / "good.st").write_text(PROGRAM)
    (folder / "wrong.st").write_text(WRONG)
    good, absent = 'path: good.st, valid: "yes", expected: compiles', 'path: no.st, valid: "yes", expected: compiles'
    as_listed = run(tmp_path, good, 'path: wrong.st, valid: "no", expected: assigned to n', absent)
    assert as_listed.returncode == 0, as_listed.stdout + as_listed.stderr
    assert as_listed.stdout.splitlines() == [
        "a/b: 1 of 1 valid files compile, 1 missing",
        "total: 1 of 1 valid files compile, 0 differences",
    ]
    (folder / "good_tests.st").write_text(
        "TEST 'first' VAR m : Main; END_VAR m(); ASSERT_EQ(m.n, 1); END_TEST\n"
        "TEST 'second' VAR m : Main; END_VAR m(); ASSERT_EQ(m.n, 2); END_TEST\n"
    )
    tested = run(tmp_path, f"{good}, tests: good_tests.st, differ: [second]")
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "results: 1 of 2 tests of the repositories pass" in tested.stdout
    assert "a/b/good_tests.st: expected []; got ['second']" in run(tmp_path, f"{good}, tests: good_tests.st").stdout
    different = run(tmp_path, good, 'path: wrong.st, valid: "yes", expected: compiles')
    assert different.returncode == 1
    assert "total: 1 of 2 valid files compile, 1 differences" in different.stdout
    assert "a/b/wrong.st: expected 'compiles'; got 'assigned to n" in different.stdout
