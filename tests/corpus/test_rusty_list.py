"""The list of rusty's tests (`rusty.yaml`), and the readers of scripts/corpus_rusty."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import yaml

LIST = Path(__file__).parent / "rusty.yaml"
SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "corpus_rusty"

PRINTED = """// RUN: %COMPILE %s && %RUN | %CHECK %s
FUNCTION main
VAR n : INT; u : UDINT := 4294967295; s : STRING := 'water'; r : REAL := 1.25; b : BOOL := TRUE; END_VAR
  FOR n := 1 TO 3 DO
    printf('step %d$N', n);
  END_FOR
  // CHECK: step 1
  // CHECK-NEXT: step 2
  // CHECK-NOT: step 2
  printf('%s %.1f %d %u %d%%$N', REF(s), r, b, u, u);
  // CHECK: water  {{1.[23]}} 1 4294967295 -1%
END_FUNCTION
"""
WRONG = PRINTED.replace("NEXT: step 2", "NEXT: step 3")
REFUSED = PRINTED.replace("n : INT", "n : NONE")

RUST = """use crate::compile_and_run;
#[test]
fn result() {
    let src = r#"FUNCTION main : REAL
    main := 0.1; END_FUNCTION"#;
    let res: f32 = compile_and_run(src.to_string(), &mut MainType::default());
    assert!((res - 0.1_f32).abs() < f32::EPSILON);
}

#[test]
fn fields() {
    struct MainType { first: i16, second: bool, }
    let src = "PROGRAM main
    VAR a : INT; (* first *) b : BOOL; END_VAR
    a := a + 16#10; b := a > 3; END_PROGRAM";
    let mut main_type = MainType::default();
    let _: i32 = compile_and_run(src, &mut main_type);
    assert_eq!(0x1_0, main_type.first);
    assert!(main_type.second);
}

#[test]
fn different() {
    let src = r"FUNCTION main : STRING
    main := 'ab'; END_FUNCTION";
    let res: String = compile_and_run(src, &mut MainType::default());
    assert_eq!(res, "ac");
}

#[test]
fn unknown() {
    let src = "FUNCTION main : INT main := 1; END_FUNCTION";
    let res: i16 = compile_and_run(src, &mut MainType::default());
    assert_eq!(res, computed(1));
}
"""


def test_each_file_of_the_list_has_its_fields_and_each_difference_a_reason() -> None:
    listed = yaml.safe_load(LIST.read_text(encoding="utf-8"))
    files = listed["files"]
    assert len({one["path"] for one in files}) == len(files) >= 80
    for entry in files:
        assert {*entry} - {"unread", "differ"} == {"path", "commit", "tests"}, entry
        assert len(entry.get("differ", {})) <= entry["tests"]
        for one in entry.get("differ", {}).values():
            assert one["kind"] in ("rusty", "open", "missing", "file")
            assert one["got"]
            assert one["reason"]


def run(checkouts: Path, files: str) -> subprocess.CompletedProcess[str]:
    made = checkouts / "list.yaml"
    made.write_text(f"repository: a/b\ndialect: codesys\nfiles: [{files}]\n")
    command = [sys.executable, str(SCRIPT), str(checkouts), "--list", str(made)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_script_compares_printed_output_and_values_with_the_list(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    for name, text in (("good.st", PRINTED), ("wrong.st", WRONG), ("refused.st", REFUSED), ("some.rs", RUST)):
        (folder / name).write_text(text)
    wrong = "{path: wrong.st, tests: 1, differ: {main: {got: step 3}}}"
    refused = "{path: refused.st, tests: 1, differ: {main: {got: a type 'NONE' is not declared}}}"
    rust = "{path: some.rs, tests: 3, unread: 1, differ: {different: {got: \"expected 'ac'; got 'ab'\"}}}"
    as_listed = run(tmp_path, f"{{path: good.st, tests: 1}}, {wrong}, {refused}, {rust}, {{path: no.st, tests: 1}}")
    assert as_listed.returncode == 0, as_listed.stdout + as_listed.stderr
    assert as_listed.stdout.splitlines() == [
        "3 of 6 tests in 4 files pass, 1 not read, 1 missing",
        "0 differences from the list",
    ]
    other = run(tmp_path, "{path: good.st, tests: 1, differ: {main: {got: nothing}}}, {path: some.rs, tests: 4}")
    assert other.returncode == 1
    assert "good.st: main: expected 'nothing'; got ''" in other.stdout
    assert "some.rs: different: expected 'no difference'; got \"ASSERT_EQ(r, 'ac')" in other.stdout
    assert "some.rs: expected 4 tests and 0 not read; got 3 and 1" in other.stdout
