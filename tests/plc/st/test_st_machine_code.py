"""Machine code of Structured Text: it computes what the Python code computes, with the same errors and records of assignments."""

from __future__ import annotations

import copy
import random
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.plc.debug.breakpoints import Breakpoint
from fieldtwin.plc.debug.tracer import Resume, Tracer
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_text
from fieldtwin.plc.st.native.building import NoCompiler
from fieldtwin.plc.st.native.machine import MachineCode, with_machine_code
from fieldtwin.plc.st.native.suspension import resume, suspend
from fieldtwin.plc.st.program import StProgram, load_source, program_class
from fieldtwin.plc.st.resource import attributes_of, line_of_error
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

try:
    with_machine_code(compile_text("PROGRAM p VAR k : INT; END_VAR k := 1; END_PROGRAM"))
except NoCompiler as missing:
    pytest.skip(str(missing), allow_module_level=True)

BLOCKS = """
TYPE Mode : (Idle, Run, Stop); Percent : INT(0..100);
  Point : STRUCT x, y : REAL; n : INT := 3; END_STRUCT;
  Tank : STRUCT level : REAL; open : BOOL; at : Point; hist : ARRAY[1..4] OF INT; END_STRUCT;
  Named : STRUCT n : INT; name : STRING[10]; END_STRUCT; END_TYPE
VAR_GLOBAL total : DINT; shared : TON; END_VAR
FUNCTION Clamp : REAL
VAR_INPUT x, low, high : REAL; END_VAR
VAR y : REAL; END_VAR
  y := x;
  IF y < low THEN Clamp := low; RETURN; END_IF
  Clamp := MIN(y, high);
END_FUNCTION
FUNCTION_BLOCK Valve
VAR_INPUT go : BOOL; END_VAR
VAR_OUTPUT pos : Point; n : INT; END_VAR
VAR own : Tank; END_VAR
  IF go THEN own.level := own.level + 1.5; own.at.n := own.at.n + 1; END_IF
  own.hist[2] := own.at.n; pos.x := own.level; n := own.hist[2];
END_FUNCTION_BLOCK
FUNCTION Twice : DINT
VAR_EXTERNAL total : DINT; END_VAR
  Twice := total * 2;
END_FUNCTION
FUNCTION_BLOCK Meter
VAR_EXTERNAL total : DINT; END_VAR
VAR_INPUT by : DINT; END_VAR
  total := total + by;
END_FUNCTION_BLOCK
FUNCTION_BLOCK Pump
VAR_INPUT start, stop : BOOL; speed : REAL; END_VAR
VAR_OUTPUT running : BOOL; hours : LREAL; END_VAR
VAR delay : TON; edge : R_TRIG; n : UDINT; END_VAR
VAR PUBLIC mode : Mode; END_VAR
  edge(CLK := start);
  delay(IN := start, PT := T#20ms);
  IF edge.Q THEN n := n + 1; END_IF
  CASE mode OF
    Mode#Idle: IF delay.Q THEN mode := Mode#Run; END_IF
    Mode#Run: running := TRUE; IF stop THEN mode := Mode#Stop; END_IF
  ELSE running := FALSE; mode := Mode#Idle;
  END_CASE
  hours := hours + 0.001 * REAL_TO_LREAL(speed);
END_FUNCTION_BLOCK
"""
WHOLE = {
    "blocks": (
        "go : BOOL; level : REAL;",
        "p1, p2 : Pump; valve : REAL; m : Mode; t : TOF; pulse : TP; up : CTU; both : CTUD; sr : SR; rs : RS; down : F_TRIG;",
        "p1(start := go, speed := level); p2(start := p1.running, stop := NOT go); m := p1.mode; t(IN := go, PT := T#30ms);"
        "valve := Clamp(level * 1.5, 0.0, 100.0); pulse(IN := p2.running, PT := T#15ms); up(CU := go, PV := 3, R := up.CV > 5);"
        "both(CU := go, CD := t.Q, PV := 2); sr(S1 := go, R := t.Q); rs(S := pulse.Q, R1 := go); down(CLK := go);",
    ),
    "loops": (
        "go : BOOL; n : INT;",
        "a : ARRAY[1..10] OF INT; b : ARRAY[0..3] OF BOOL; i, k : INT; sum : DINT; last : UINT;",
        "sum := 0; FOR i := 1 TO 10 DO a[i] := i * n; sum := sum + a[i]; IF sum > 500 THEN EXIT; END_IF; IF i = 4 THEN CONTINUE;"
        "END_IF; k := k + 1; END_FOR; WHILE sum > 3 DO sum := sum / 2; END_WHILE; REPEAT last := last + 1; UNTIL last MOD 3 = 0"
        " END_REPEAT; FOR i := 10 TO -4 BY -3 DO k := k - i; END_FOR; b[k MOD 2 + 1] := NOT b[ABS(k MOD 4)];"
        "a[1 + ABS(n MOD 10)] := k;",
    ),
    "global variables": (
        "go : BOOL; n : INT;",
        "own : DINT; meter : Meter;",
        "total := total + n; shared(IN := go, PT := T#25ms); IF shared.Q THEN own := total; END_IF;",
    ),
    "global variables of others": (
        "n : INT;",
        "own : DINT; meter : Meter;",
        "meter(by := n); own := Twice();",
    ),
    "structures": (
        "go : BOOL; n : INT;",
        "a : Tank; p : Point; v : Valve; i : INT; many : ARRAY[1..3] OF Point; valves : ARRAY[0..1] OF Valve; k : INT;",
        "a.level := a.level + 0.5; a.at.x := a.level * 2.0; a.open := go; FOR i := 1 TO 4 DO a.hist[i] := i + n; END_FOR\n"
        "v(go := go); p.n := v.n; p.x := v.pos.x; many[2].x := p.x; many[1 + ABS(n MOD 3)].n := n; k := n MOD 2;\n"
        "valves[ABS(k)](go := NOT go); k := valves[1].n;",
    ),
    "actions": (
        "go : BOOL; n : INT;",
        "k, m : INT; t : TON;",
        "IF go THEN Up(); ELSE Down(); END_IF; t(IN := go, PT := T#20ms);\n"
        "ACTION Up: k := k + n; IF k > 100 THEN RETURN; END_IF; m := m + 1; END_ACTION\n"
        "ACTION Down: k := k - 1; total := total + k; END_ACTION",
    ),
    "RETURN": ("go : BOOL; n : INT;", "k : INT;", "IF n > 3 THEN k := n; RETURN; END_IF; k := k - 1;"),
    "subrange": ("n : INT;", "s : Percent; w : WORD;", "s := ABS(n MOD 90); w.3 := n > 2; w := SHL(w, 1) OR 1;"),
}
"""By what it shows: inputs, variables and body of a PROGRAM that is translated as a whole."""
PARTS = {
    "text": (
        "n : INT;",
        "s : STRING[20]; k : INT;",
        "k := k + n; s := CONCAT('a', INT_TO_STRING(k)); k := k + LEN(s);",
    ),
    "grid": ("n : INT;", "g : ARRAY[1..2, 1..2] OF INT; k : INT;", "k := n; g[1, 2] := k; k := k + g[1, 2];"),
    "a structure with a text": ("n : INT;", "s : Named; k : INT;", "s.n := s.n + n; s.name := 'a'; k := s.n;"),
    "a copied structure": ("n : INT;", "p, q : Point; k : INT;", "p.n := n; q := p; k := q.n;"),
    "64 bits": ("n : INT;", "u : ULINT := 18446744073709551615; k : INT;", "k := n; u := u - 1; k := k + 1;"),
}
"""By what stays Python: PROGRAMs that are translated in part."""
ERRORS = {
    "division": ("n : INT;", "k, q : INT;", "k := k + 1;\nq := 100 / (n - 3);\nk := k + 10;"),
    "index": ("n : INT;", "a : ARRAY[1..3] OF INT; k : INT;", "k := k + 1;\na[n] := k;\nk := k + 10;"),
    "conversion": ("x : REAL;", "k : INT;", "k := 7;\nk := REAL_TO_INT(x * 1.0E4);"),
    "root": ("x : REAL;", "y : REAL; k : INT;", "k := 1; y := SQRT(x - 2.0);\nk := 2;"),
    "endless": ("n : INT;", "k : DINT;", "k := 5; WHILE n > 2 DO k := k + 1;\nEND_WHILE;"),
    "subrange": ("n : INT;", "s : Percent; k : INT;", "k := k + 1; s := n * 30;"),
}
"""By error: PROGRAMs that stop with it for some inputs."""


def unit_of(inputs: str, variables: str, body: str) -> CompiledUnit:
    externals = "VAR_EXTERNAL total : DINT; shared : TON; END_VAR" if "total :=" in body else ""
    head = f"PROGRAM p {externals} VAR_INPUT {inputs} END_VAR VAR {variables} END_VAR"
    return compile_text(f"{BLOCKS}{head}\n{body}\nEND_PROGRAM", "p.st")


def content(value: Any) -> Any:
    """Return all that an object holds, records of assignments included, so that it can be compared. NaN and -0.0 are distinct."""
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, dict):
        return {key: content(each) for key, each in value.items()}
    if isinstance(value, tuple):
        return tuple(type(each).__name__ if hasattr(each, "execute") else content(each) for each in value)
    if isinstance(value, list):
        return [content(each) for each in value]
    if hasattr(value, "__dict__") and not callable(value):
        return content(attributes_of(value))
    names = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    if isinstance(value, bool | int | str) or not names:
        return value
    return {name: content(getattr(value, name)) for name in names if hasattr(value, name)}


class Both:
    """The same program as Python and with machine code, with the same inputs."""

    def __init__(self, unit: CompiledUnit) -> None:
        made = with_machine_code(unit)
        assert isinstance(made.machine_code, MachineCode)
        self.prepared = made.machine_code.prepared
        self.python, self.machine = program_class(unit)(), program_class(made)()
        self.inputs = [v for v in self.python.st_variables.values() if v.role == "input"]
        self.number = 0

    def scan(self, *given: Any) -> str:
        """Execute one scan of both, and compare them. Return the error of the scan."""
        self.number += 1
        found = []
        for program in (self.python, self.machine):
            for variable, value in zip(self.inputs, given, strict=True):
                program.__dict__[variable.name] = value
            found.append(self._executed(program))
        assert found[0] == found[1]
        return str(found[0][0])

    def _executed(self, program: StProgram) -> tuple[str, Any, Any, Any]:
        error = ""
        try:
            program.execute(ScanInfo(self.number * 10_000_000, self.number, self.number == 1))
        except FieldtwinError as e:
            error = f"{e} {line_of_error(e, ('p.st',))}"
        tags = {name: content(program.__dict__[name]) for name in program.st_outputs}
        return error, content(program.st_body), content(program.st_resource.globals), tags

    def machine_runs(self) -> list[bool | None]:
        """Return the results of the machine code after one more execution of each run."""
        resource = self.machine.st_resource
        return [run(self.machine.st_body, resource.context, resource.globals) for run in resource.space["_runs"]]


VALUES = {
    "BOOL": [True, False, True, True],
    "INT": [3, -7, 0, 1, 5, 2, 32767, -32768, 4, 3],
    "REAL": [0.0, 1.5, -2.25, 1e30, 99.5, -0.0, 3.0, 2.5],
}


def fed(both: Both, scans: int = 40) -> list[str]:
    """Execute scans with changing inputs. Return their errors."""
    errors = []
    for n in range(scans):
        kinds = [VALUES[str(variable.kind)] for variable in both.inputs]
        errors.append(both.scan(*(of[(n // (k + 1)) % len(of)] for k, of in enumerate(kinds))))
    return errors


@pytest.mark.parametrize("name", WHOLE)
def test_a_translated_program_computes_what_python_computes(name: str) -> None:
    both = Both(unit_of(*WHOLE[name]))
    assert both.prepared.kept == {"P_p": []}
    assert set(fed(both)) == {""}
    assert None not in both.machine_runs()


@pytest.mark.parametrize("name", PARTS)
def test_the_rest_of_a_program_stays_python(name: str) -> None:
    both = Both(unit_of(*PARTS[name]))
    assert both.prepared.kept["P_p"]
    assert both.prepared.runs >= 1
    assert set(fed(both)) == {""}
    assert None not in both.machine_runs()


@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_those_of_python_and_nothing_else_changes(name: str) -> None:
    errors = fed(Both(unit_of(*ERRORS[name])), 12)
    assert any(errors)
    assert "p.st" in next(error for error in errors if error)


def test_an_integer_beyond_64_bits_is_left_to_python() -> None:
    both = Both(unit_of("n : INT;", "u : ULINT; k : INT;", "k := n; u := u; k := k + 1;"))
    assert both.scan(1) == ""
    for program in (both.python, both.machine):
        program.st_body.v_u = 2**64 - 1
    assert both.scan(2) == ""
    assert both.machine_runs() == [None]
    assert both.machine.st_body.v_u == 2**64 - 1


def test_copies_of_a_program_do_not_share_variables() -> None:
    both = Both(unit_of(*WHOLE["blocks"]))
    fed(both, 10)
    other = copy.deepcopy(both.machine)
    before = content(both.machine.st_body)
    for n in range(20):
        other.__dict__["go"] = n % 3 == 0
        other.execute(ScanInfo(n * 10_000_000 + 10**9, n, False))
    assert content(both.machine.st_body) == before != content(other.st_body)
    assert other.__dict__["valve"] == other.st_body.v_valve
    assert set(fed(both, 10)) == {""}


def test_two_programs_with_the_same_machine_code_take_turns() -> None:
    unit = with_machine_code(unit_of(*WHOLE["loops"]))
    made = program_class(unit)
    first, second = Both(unit_of(*WHOLE["loops"])), made()
    for n in range(10):
        first.scan(n % 2 == 0, n)
        second.__dict__.update(go=True, n=-n)
        second.execute(ScanInfo(n, n, False))
    assert set(fed(first, 10)) == {""}


def test_a_value_from_outside_is_used_and_published() -> None:
    both = Both(unit_of(*WHOLE["RETURN"]))
    both.scan(True, 1)
    for program in (both.python, both.machine):
        program.put("k", 50)
    assert both.scan(True, 2) == ""
    assert both.machine.__dict__["k"] == 49


def test_suspended_machine_code_lets_python_execute_the_program() -> None:
    both = Both(unit_of(*WHOLE["loops"]))
    fed(both, 5)
    runs = both.machine.st_resource.space["_runs"]
    suspend("a debugger")
    try:
        assert {run(None, None, None) for run in runs} == {None}
        fresh = Both(unit_of(*WHOLE["loops"]))
        assert fresh.machine_runs() == [None]
        assert set(fed(both, 5)) == {""}
    finally:
        resume("a debugger")
    assert None not in both.machine_runs()
    assert None not in fresh.machine_runs()


def test_without_a_compiler_the_program_stays_python_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "p.st"
    source.write_text("PROGRAM p VAR k : INT; END_VAR k := k + 1; END_PROGRAM")
    monkeypatch.setenv("CC", "no-such-compiler")
    made = load_source(source, machine_code=True)
    assert made.st_unit.machine_code is None
    assert "ST116 the program stays Python, because there is no C compiler no-such-compiler" in made.source_warnings[0]
    program = made()
    program.execute(ScanInfo(0, 1, True))
    assert program.__dict__["k"] == 1


def test_a_compiler_that_fails_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "p.st"
    source.write_text("PROGRAM p VAR k : INT; END_VAR k := k + 2; END_PROGRAM")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    assert "false failed" in load_source(source, machine_code=True).source_warnings[0]


def test_compiled_modules_are_kept_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fieldtwin.plc.st.native import building

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(building, "MAX_KEPT", 2)
    kept = tmp_path / "fieldtwin" / "machine-code"
    for n in range(3):
        with_machine_code(unit_of("n : INT;", "k : INT;", f"k := k + {n};"))
        assert len(list(kept.iterdir())) == min(n + 1, 2)


def test_a_damaged_module_is_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    unit = unit_of("n : INT;", "k : INT;", "k := k + 77;")
    with_machine_code(unit)
    (module,) = (tmp_path / "fieldtwin" / "machine-code").iterdir()
    module.unlink()
    module.write_bytes(b"not a module")
    both = Both(unit)
    both.scan(1)
    assert both.machine_runs() == [False]


# -- any expression ---------------------------------------------------------------------------------------------------------

KINDS = {
    "INT": ("i1", "i2"), "DINT": ("d1", "d2"), "UINT": ("u1",), "LINT": ("l1",), "TIME": ("t1",), "WORD": ("w1", "w2"),
    "DWORD": ("dw",), "REAL": ("x1", "x2"), "LREAL": ("y1",), "BOOL": ("b1", "b2"),
}  # fmt: skip
CONSTANTS = {
    "INT": ["0", "1", "-1", "7", "32767", "-32768"], "DINT": ["3", "-2147483648", "2147483647"], "UINT": ["0", "65535", "9"],
    "LINT": ["5", "-9223372036854775807", "9223372036854775807"], "TIME": ["T#0s", "T#1ms", "T#-2h"],
    "WORD": ["16#0", "16#FFFF", "16#A5"], "DWORD": ["16#0", "16#FFFFFFFF", "16#80000001"],
    "REAL": ["0.0", "1.5", "-2.25", "1.0E30", "0.1"], "LREAL": ["0.1", "-3.0", "1.0E200"], "BOOL": ["TRUE", "FALSE"],
}  # fmt: skip
INTEGERS = ("INT", "DINT", "UINT", "LINT")
NUMBERS = ("INT", "DINT", "UINT", "LINT", "REAL", "LREAL")


FUNCTIONS = ("SQRT", "SIN", "COS", "TAN", "EXP", "LN", "LOG", "ATAN", "ASIN", "ACOS")


class Written:
    """Writes random expressions."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)

    def expression(self, kind: str, depth: int) -> str:
        pick = self.random.choice
        if depth == 0 or self.random.random() < 0.15:
            constants = CONSTANTS[kind] if kind in ("TIME", "BOOL") else [f"{kind}#{one}" for one in CONSTANTS[kind]]
            return pick([*KINDS[kind], *constants])
        return pick([self.choice, *self.makers(kind)])(kind, depth - 1)

    def makers(self, kind: str) -> list[Callable[[str, int], str]]:
        if kind == "BOOL":
            return [self.logic, self.comparison, self.comparison]
        if kind in ("WORD", "DWORD"):
            return [self.bits, self.shift]
        if kind == "TIME":
            return [self.arithmetic]
        made = [self.arithmetic, self.arithmetic, self.limits, self.conversion]
        return [*made, self.function, self.power] if kind in ("REAL", "LREAL") else made

    def choice(self, kind: str, depth: int) -> str:
        test, one, other = self.expression("BOOL", depth), self.expression(kind, depth), self.expression(kind, depth)
        return f"SEL({test}, {one}, {other})"

    def two(self, kind: str, depth: int, operators: Sequence[str]) -> str:
        return f"({self.expression(kind, depth)} {self.random.choice(operators)} {self.expression(kind, depth)})"

    def arithmetic(self, kind: str, depth: int) -> str:
        if kind == "TIME":
            return self.two(kind, depth, "+-")
        return self.two(kind, depth, [*"+-*/", *(["MOD"] if kind in INTEGERS else [])])

    def limits(self, kind: str, depth: int) -> str:
        name, count = self.random.choice([("MIN", 2), ("MAX", 3), ("ABS", 1), ("LIMIT", 3)])
        return f"{name}({', '.join(self.expression(kind, depth) for _ in range(count))})"

    def conversion(self, kind: str, depth: int) -> str:
        source = self.random.choice(["REAL", "LREAL", "WORD", "DINT", "BOOL"] if kind in INTEGERS else ["DINT", "INT"])
        return (
            f"{source}_TO_{kind}({self.expression(source, depth)})" if source != kind else self.expression(kind, depth)
        )

    def function(self, kind: str, depth: int) -> str:
        return f"{self.random.choice(FUNCTIONS)}({self.expression(kind, depth)})"

    def power(self, kind: str, depth: int) -> str:
        return self.two(kind, depth, ["**"])

    def bits(self, kind: str, depth: int) -> str:
        return f"NOT {self.two(kind, depth, ['AND', 'OR', 'XOR'])}"

    def shift(self, kind: str, depth: int) -> str:
        name, count = self.random.choice(["SHL", "SHR", "ROL", "ROR"]), self.random.choice(["1", "i1", "17", "33"])
        return f"{name}({self.expression(kind, depth)}, {count})"

    def logic(self, kind: str, depth: int) -> str:
        return f"NOT {self.two(kind, depth, ['AND', 'OR', 'XOR', 'AND_THEN', 'OR_ELSE'])}"

    def comparison(self, kind: str, depth: int) -> str:
        return self.two(self.random.choice([*NUMBERS, "TIME", "WORD"]), depth, ["<", "<=", "=", "<>", ">", ">="])


@pytest.mark.parametrize("seed", range(6))
def test_any_statements_compute_what_python_computes(seed: int) -> None:
    """An error of a statement ends the scan, so each scan begins with a different one."""
    written = Written(seed)
    lines = []
    for n in range(60):
        kind = written.random.choice(list(KINDS))
        target = written.random.choice(KINDS[kind])
        lines.append(f"IF n = {n} OR n = {n - 1} THEN {target} := {written.expression(kind, 3)}; END_IF;")
    variables = " ".join(f"{', '.join(names)} : {kind};" for kind, names in KINDS.items())
    both = Both(unit_of("n : INT;", variables, "\n".join(lines)))
    assert both.prepared.kept == {"P_p": []}
    errors = [both.scan(n * 7 % 60) for n in range(180)]
    assert 0 < errors.count("") < 180


def test_the_translation_is_part_of_the_unit() -> None:
    """The kinds of variables are those of their types, so that the test above covers what it seems to cover."""
    unit = unit_of("n : INT;", "k : INT; x : REAL; t : TIME;", "k := n; x := 0.5; t := T#1s;")
    made = with_machine_code(unit)
    assert replace(made, code=unit.code, machine_code=None) == unit
    assert [str(v.kind) for v in made.programs[0].variables] == ["INT", "INT", "REAL", "TIME"]
    assert made.programs[0].variables[0].kind == ty.ELEMENTARY["INT"]


# -- what else looks at programs --------------------------------------------------------------------------------------------


def test_a_breakpoint_stops_a_program_with_machine_code() -> None:
    both = Both(unit_of("n : INT;", "k : INT;", "k := k + n;\nk := k + 1;"))
    both.scan(1)
    line = max(place.line for place in both.machine.st_unit.places)
    seen: list[str] = []
    tracer = Tracer(lambda reason, _: seen.append(reason), lambda *_: None, lambda: Resume.CONTINUE)
    tracer.files = frozenset({"p.st"})
    tracer.breakpoints = {"p.st": {line: Breakpoint(lambda *_: pytest.fail("there is nothing to compile"))}}
    tracer.run(lambda: both.machine.execute(ScanInfo(10**9, 2, False)))
    assert seen == ["breakpoint"]
    assert both.machine_runs() == [False]


def test_a_virtual_run_has_the_same_trace(tmp_path: Path) -> None:
    systems = Path(__file__).resolve().parents[3] / "profiles"
    found = []
    for name, key in (("python", "false"), ("machine", "true")):
        shutil.copytree(systems, tmp_path / name)
        file = tmp_path / name / "systems" / "lab_vehicle.yaml"
        text = file.read_text()
        file.write_text(text.replace("source: vehicle.st", f"source: vehicle.st\n      machine_code: {key}"))
        run = VirtualRun(VirtualOptions(str(file), 20.0, seed=1))
        run.run()
        assert run.summary()["ok"]
        found.append(run.summary()["trace"])
    assert found[0]["events"] > 1000
    assert found[0] == found[1]
