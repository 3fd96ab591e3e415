"""The lists of third-party programs and of their tests, and `scripts/corpus`, which compares them with checkouts."""

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
        "total: 1 of 1 valid files compile",
        "0 differences",
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
    assert "total: 1 of 2 valid files compile\n1 differences" in different.stdout
    assert "a/b/wrong.st: expected 'compiles'; got 'assigned to n" in different.stdout


RUST = """
use crate::common::{drive_fb, Snapshot};
const COUNTER: &str = "
PROGRAM main VAR on : BOOL; t : TON; q : BOOL; et : TIME; END_VAR
  t(IN := on, PT := T#2s, Q => q, ET => et);
END_PROGRAM";

e2e_i32!(
    /// A comment, and a "text" in it.
    a_macro_compares_variables_by_number,
    "PROGRAM main VAR x : BYTE := 200; y : DWORD; END_VAR y := NOT 16#0; END_PROGRAM",
    &[(0, 200), (1, -1)],
);
e2e_f64_near!(a_tolerance, 0.01, "PROGRAM main VAR x : LREAL := 1.5; END_VAR END_PROGRAM", &[("x", 1.505)]);
e2e_i32!(a_wrong_value, "PROGRAM main VAR x : INT := 1; END_VAR END_PROGRAM", &[(0, 1), (0, 2)]);
e2e!(a_duration, "PROGRAM main VAR x : TIME := T#1m30s; END_VAR END_PROGRAM", &[(0, Duration::seconds(90))]);

fn after(body: &str, kind: &str) -> i64 {
    let source = format!("PROGRAM main VAR r : {kind}; d : INT := 7; END_VAR {body} END_PROGRAM (*{{{}*)", "end");
    let (_c, bufs) = parse_and_run(&source, &CompilerOptions::default());
    bufs.vars[0].as_i64()
}

#[rstest]
#[case::times("timer", &[write("on", 1), run(0), expect("q", 0), Run(2_000_000), Expect(2, 1), expect("et", 2000)])]
#[case::wrong("timer", &[Write(0, 1), Run(0), Expect(2, 1)])]
fn steps(#[case] _name: &str, #[case] steps: &[FbStep]) {
    drive_fb(COUNTER, &CompilerOptions::default(), steps);
}

#[rstest]
fn combinations(#[values("INT", "LINT")] kind: &str, #[values(("+", 10), ("-", 4), ("*", 21))] op: (&str, i64)) {
    let (sign, expected) = op;
    assert_eq!(after(&format!("r := d {sign} 3;"), kind), expected, "{kind}");
}

#[test]
fn an_error_at_run_time_is_expected() {
    let source = "PROGRAM main VAR x : DINT; END_VAR x := 1 / x; END_PROGRAM";
    let result = parse_and_try_run(source, &CompilerOptions::default());
    assert!(result.is_err() && true, "expected a trap");
    assert_eq!(result.unwrap_err().trap, Trap::DivideByZero);
}

#[test]
fn scans_in_a_closure() {
    let source = "PROGRAM main VAR n : INT; s : STRING[5]; t : STRING := 'a\\"b'; END_VAR n := n + 1; s := 'abc'; END_PROGRAM";
    parse_and_run_rounds(source, &CompilerOptions::default(), |vm| {
        for _ in 0..3 { vm.run_round(0).unwrap(); }
        assert_eq!(vm.read_variable(VarIndex::new(0)).unwrap(), 3);
        assert_eq!(read_string(&vm.data_region, string_offset(&[5])), "a\\"b");
    });
}

#[test]
fn about_the_memory() {
    let container = parse_and_compile(COUNTER, &CompilerOptions::default());
    assert_eq!(container.header.num_variables, 4);
}

#[test]
fn without_a_program() { assert_eq!(1, 1); }
"""


def test_the_tests_of_a_file_in_rust_are_executed(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b" / "tests"
    folder.mkdir(parents=True)
    (folder / "some.rs").write_text(RUST)
    made = tmp_path / "list.yaml"
    command = [sys.executable, str(SCRIPT), str(tmp_path), "--list", str(made)]
    entry = (
        "{path: some.rs, dialect: standard, tests: 16, differ: {value: [a_wrong_value, steps::wrong]}, "
        "not_read: [about_the_memory, without_a_program]}"
    )
    made.write_text(f"repository: a/b\nfolder: tests\nfiles:\n  - {entry}\n  - {{path: no.rs}}\n")
    as_listed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert as_listed.stdout.splitlines() == [
        "a/b: 12 tests in Rust pass, 2 differ, 2 are not executed, 1 files missing",
        "0 differences",
    ]
    assert as_listed.returncode == 0
    made.write_text(
        "repository: a/b\nfolder: tests\nfiles: [{path: some.rs, dialect: standard, tests: 2, differ: {a: [a_duration]}}]"
    )
    different = subprocess.run(command, capture_output=True, text=True, check=False)
    assert different.returncode == 1
    assert different.stdout.splitlines()[2:] == [
        "a/b/tests/some.rs: expected 2 tests; got 16",
        "a/b/tests/some.rs: a_duration: it passes",
        "a/b/tests/some.rs: a_wrong_value: x is 1; expected 2",
        "a/b/tests/some.rs: steps::wrong: q is False; expected 1",
        "a/b/tests/some.rs: about_the_memory: the member header",
        "a/b/tests/some.rs: without_a_program: a test without a program",
    ]


def test_without_checkouts_all_files_of_both_lists_are_missing(tmp_path: Path) -> None:
    found = subprocess.run([sys.executable, str(SCRIPT), str(tmp_path)], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert "PLC-lang/rusty: 0 of 0 valid files compile, " in found.stdout
    assert "ironplc/ironplc: 0 tests in Rust pass, 0 differ, 0 are not executed, 75 files missing" in found.stdout


def test_each_reason_of_the_list_of_ironplc_is_used() -> None:
    listed = yaml.safe_load((Path(__file__).parent / "ironplc.yaml").read_text(encoding="utf-8"))
    used: set[str] = set()
    for entry in listed["files"]:
        assert {*entry} - {"differ", "not_read"} == {"path", "commit", "dialect", "tests"}, entry
        assert entry["dialect"] in DIALECTS
        names = [name for of in entry.get("differ", {}).values() for name in of] + entry.get("not_read", [])
        assert len(names) == len({*names}) <= entry["tests"]
        used |= entry.get("differ", {}).keys()
    assert used == listed["reasons"].keys()
