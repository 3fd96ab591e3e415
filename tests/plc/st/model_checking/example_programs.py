"""Programs in Structured Text that together use every construct that has a model."""

INTEGERS = """
PROGRAM Integers
VAR_INPUT a, b : INT; u : USINT; w : WORD; l : LINT; x : ULINT; n : INT; END_VAR
VAR
  sum, difference, product, quotient, rest, negative, least, most, limited, picked, size : INT;
  narrow : SINT; wide : DINT; huge : LINT; unsigned : USINT; whole : ULINT; sub : INT(-5..100);
  bits, shifted, right, rotated, mixed : WORD; byte_ : BYTE; equal, above : BOOL; bcd : WORD;
END_VAR
  sum := a + b; difference := a - b; product := a * b; negative := -a;
  IF b <> 0 THEN quotient := a / b; END_IF
  rest := a MOD b;
  least := MIN(a, b, 3); most := MAX(a, b); limited := LIMIT(-10, a, 10); size := ABS(a);
  picked := SEL(a > b, a, b) + MUX(LIMIT(0, n, 2), a, b, 7);
  narrow := INT_TO_SINT(a); wide := INT_TO_DINT(a) * b; huge := huge * 3 + l; unsigned := unsigned + u;
  whole := whole + x; sub := LIMIT(-5, a, 100);
  bits := (w AND 16#0FF0) OR (NOT w AND 16#000F); mixed := w XOR bits;
  shifted := SHL(w, LIMIT(0, n, 20)); right := SHR(w, LIMIT(0, n, 20)); rotated := ROL(w, LIMIT(0, n, 40));
  byte_.3 := a > 0; byte_.0 := w.15;
  equal := a = b; above := INT_TO_DINT(a) > huge / 2;
  bcd := UINT_TO_BCD_WORD(INT_TO_UINT(LIMIT(0, a, 9999)));
END_PROGRAM
"""
FAILING = """
PROGRAM Failing
VAR_INPUT a, b : INT; r : REAL; END_VAR
VAR q : INT; list : ARRAY[1..4] OF INT; sub : INT(0..9); END_VAR
  q := a / b;
  list[a] := b;
  sub := b;
  q := REAL_TO_INT(r);
END_PROGRAM
"""
PARTS = """
TYPE Point : STRUCT x, y : INT; on : BOOL; END_STRUCT; END_TYPE
TYPE Mode : (Off, Slow := 5, Fast); END_TYPE
FUNCTION Clipped : INT
VAR_INPUT v, top : INT; END_VAR
VAR_OUTPUT cut : BOOL; END_VAR
  IF v > top THEN cut := TRUE; Clipped := top; RETURN; END_IF
  Clipped := v;
END_FUNCTION
FUNCTION_BLOCK Counter
VAR_INPUT up : BOOL; END_VAR
VAR_IN_OUT total : DINT; END_VAR
VAR_OUTPUT n : INT; END_VAR
VAR edge : R_TRIG; END_VAR
  edge(CLK := up);
  IF edge.Q THEN n := n + 1; total := total + n; END_IF
END_FUNCTION_BLOCK
VAR_GLOBAL shared : INT := 4; END_VAR
PROGRAM Parts
VAR_INPUT i : INT; go : BOOL; mode : Mode; grade : INT; END_VAR
VAR
  list : ARRAY[0..3] OF INT; grid : ARRAY[1..2, 0..2] OF BOOL; p, q : Point; points : ARRAY[0..2] OF Point;
  one, two : Counter; both : ARRAY[0..1] OF Counter; total : DINT; k, steps, found, letter : INT; was_cut, first : BOOL;
END_VAR
VAR_TEMP j : INT; END_VAR
  list[LIMIT(0, i, 3)] := i;
  k := list[LIMIT(0, i - 1, 3)] + list[0];
  grid[1 + ABS(i MOD 2), ABS(i MOD 3)] := go;
  p.x := Clipped(v := i, top := 50, cut => was_cut);
  p.on := go;
  q := p;
  points[LIMIT(0, i, 2)] := q;
  one(up := go, total := total);
  two(up := NOT go, total := total);
  both[LIMIT(0, i, 1)](up := go, total := total);
  CASE mode OF
    Mode#Off: letter := 1;
    Mode#Slow: IF go THEN letter := 2; END_IF
  ELSE letter := 3;
  END_CASE
  CASE grade OF
    -3..-1: shared := shared - 1;
    0: ;
    1, 3, 5: shared := shared + 1;
    100..200: shared := 0;
  END_CASE
  found := -1;
  FOR j := 0 TO 3 DO
    IF list[j] < 0 THEN CONTINUE; END_IF
    steps := steps + 1;
    IF list[j] = 7 THEN found := j; EXIT; END_IF
  END_FOR
  FOR j := LIMIT(0, i, 4) TO 0 BY -2 DO steps := steps + j; END_FOR
  WHILE k > 100 DO k := k / 2; END_WHILE
  k := MAX(k, -5);
  REPEAT k := k + 1; UNTIL k > 3 END_REPEAT
  first := FIRST_SCAN();
END_PROGRAM
"""
TIMES = """
PROGRAM Times
VAR_INPUT a, b : BOOL R_EDGE; c, d : BOOL; delay : TIME; value : INT; END_VAR
VAR
  on_ : TON; off_ : TOF; pulse : TP; up : CTU; down : CTD; both : CTUD; rise : R_TRIG; fall : F_TRIG; set : SR; reset : RS;
  long : CTU_DINT; sum, twice : TIME; ms : DINT; late, edges, good : BOOL;
END_VAR
  on_(IN := c, PT := T#3s); off_(IN := d, PT := delay); pulse(IN := c, PT := T#500ms);
  up(CU := c, R := d, PV := 3); down(CD := c, LD := d, PV := 2); both(CU := c, CD := d, R := up.Q, LD := down.Q, PV := 2);
  long(CU := d, R := FALSE, PV := 100000);
  rise(CLK := c); fall(CLK := d); set(S1 := c, R := d); reset(S := c, R1 := d);
  sum := on_.ET + off_.ET; twice := delay * 2; ms := TIME_TO_DINT(pulse.ET);
  late := sum > T#2s; edges := a OR b; good := IS_GOOD(c) AND NOT IS_GOOD(value);
END_PROGRAM
"""
REALS = """
PROGRAM Reals
VAR_INPUT x, y : REAL; z : LREAL; n : INT; go : BOOL; END_VAR
VAR
  sum, product, quotient, chosen, root, size : REAL; double_, third : LREAL; above, near : BOOL; count : INT; cut : DINT;
  band : HYSTERESIS; ramp : RAMP;
END_VAR
  sum := x + y; product := x * 0.1; double_ := double_ + z * 0.5;
  IF y <> 0.0 THEN quotient := x / y; END_IF
  chosen := LIMIT(-1.5, x, MAX(y, 2.5)); size := ABS(x); third := INT_TO_LREAL(n) / 3.0;
  IF x >= 0.0 THEN root := SQRT(x); END_IF
  above := x > y; near := ABS(x - y) < 0.25;
  IF ABS(x) < 1000.0 THEN count := REAL_TO_INT(x * 2.0); cut := TRUNC(x); END_IF
  band(XIN1 := x, XIN2 := 10.0, EPS := 0.5);
END_PROGRAM
"""
ALARMS = """
PROGRAM Alarms
VAR_INPUT level : REAL; ack : BOOL; END_VAR
VAR guard : ALARM; END_VAR
  guard(X := level, H := 80.0, HH := 90.0, HYS := 2.0, DELAY := T#2s, ACK := ack);
END_PROGRAM
"""
CHART = """
PROGRAM Chart
VAR_INPUT start, stop, full : BOOL; END_VAR
VAR_OUTPUT valve, lamp, motor : BOOL; END_VAR
  INITIAL_STEP Idle: END_STEP
  STEP Filling: valve(N); Blink(D, T#2s); END_STEP
  STEP Mixing: motor(L, T#5s); lamp(S); END_STEP
  STEP Done: lamp(R); END_STEP
  TRANSITION FROM Idle TO Filling := start AND NOT stop; END_TRANSITION
  TRANSITION FROM Filling TO Mixing := full; END_TRANSITION
  TRANSITION FROM Filling TO Idle := stop; END_TRANSITION
  TRANSITION FROM Mixing TO Done := Mixing.T >= T#4s; END_TRANSITION
  TRANSITION FROM Done TO Idle := NOT start; END_TRANSITION
  ACTION Blink: lamp := NOT lamp; END_ACTION
END_PROGRAM
"""
CLASSES = """
FUNCTION_BLOCK Meter
VAR n : INT; END_VAR
METHOD PUBLIC Add : BOOL
VAR_INPUT by : INT; END_VAR
  n := n + by;
  Add := n > 100;
END_METHOD
END_FUNCTION_BLOCK
FUNCTION_BLOCK Doubled EXTENDS Meter
METHOD PUBLIC OVERRIDE Add : BOOL
VAR_INPUT by : INT; END_VAR
  Add := SUPER.Add(by := by * 2);
END_METHOD
END_FUNCTION_BLOCK
PROGRAM Classes
VAR_INPUT by : INT; END_VAR
VAR one : Meter; two : Doubled; full, early : BOOL; END_VAR
  full := one.Add(by := by);
  early := two.Add(by := by) AND NOT full;
END_PROGRAM
"""
TEXTS = """
PROGRAM Texts
VAR_INPUT n : INT; on : BOOL; x : REAL; t : TIME; END_VAR
VAR shown, name, last : STRING; size, same, at : INT; was : BOOL; lines : ARRAY[0..2] OF STRING; END_VAR
VAR_TEMP word : STRING; END_VAR
  name := SEL(on, 'off', 'on');
  size := LEN(name);
  IF name = 'on' THEN same := same + 1; END_IF
  word := CONCAT(name, '!');
  at := FIND('on!off!', 'off');
  shown := CONCAT(word, INT_TO_STRING(n), REAL_TO_STRING(x), TIME_TO_STRING(t), BOOL_TO_STRING(on));
  lines[LIMIT(0, n, 2)] := MID(shown, 3, 2);
  IF on THEN last := REPLACE(INSERT(DELETE(shown, 1, 1), 'x', 1), name, 1, 1); ELSE last := RIGHT(shown, 2); END_IF
  was := on;
END_PROGRAM
"""
CODESYS = """
FUNCTION Doubled : INT VAR_INPUT n : INT; END_VAR Doubled := 2 * n; END_FUNCTION
FUNCTION_BLOCK Meter
VAR n, limit : INT; END_VAR
METHOD FB_init : BOOL
VAR_INPUT bInitRetains : BOOL; bInCopyCode : BOOL; start : INT; END_VAR
  limit := start;
END_METHOD
METHOD Add : REFERENCE TO Meter
VAR_INPUT by : INT; END_VAR
  n := n + by;
  Add REF= THIS^;
END_METHOD
METHOD Full : BOOL Full := n > limit; END_METHOD
END_FUNCTION_BLOCK
TYPE Point : STRUCT x, y : INT; END_STRUCT; END_TYPE
FUNCTION Made : Point VAR_INPUT n : INT; END_VAR Made.x := n; Made.y := n - 1; END_FUNCTION
PROGRAM Part
VAR_INPUT on : BOOL; END_VAR
VAR count : INT; END_VAR
  IF on THEN count := count + 1; END_IF
END_PROGRAM
PROGRAM Codesys
VAR_INPUT by : INT; on : BOOL; END_VAR
VAR one : Meter(first); first : INT := Doubled(20); full : BOOL; a, b, c : INT; many : ARRAY[1..2] OF Meter[(1), (2)]; END_VAR
  full := by > 3 AND_THEN one.Full() OR_ELSE many[2].Full();
  a := b := Made(by).y;
  Part(on := on);
  c := Part.count;
END_PROGRAM
"""
CLOCK = """
PROGRAM Clock
VAR_INPUT start : BOOL; END_VAR
VAR began, passed : LTIME; running, late : BOOL; ms : LINT; END_VAR
  IF start AND NOT running THEN began := SCAN_TIME(); running := TRUE; END_IF
  IF running THEN
    passed := SCAN_TIME() - began;
    ms := LTIME_TO_LINT(SCAN_TIME()) / 1_000_000 MOD 1000;
    IF passed >= LT#10s THEN late := TRUE; running := start; END_IF
  END_IF
END_PROGRAM
"""
MAIL = """
PROGRAM Mail
VAR_INPUT heard : MESSAGES; at : INT; END_VAR
VAR_OUTPUT said : MESSAGES[16, 4]; END_VAR
VAR count, most : DINT; many : BOOL; seen : ARRAY[0..3] OF INT; text : STRING; END_VAR
VAR_TEMP i : DINT; END_VAR
  FOR i := 1 TO MSG_COUNT(heard) DO
    text := MSG_AT(heard, i);
    count := MIN(count + 1, 1000);
    seen[i MOD 4] := seen[i MOD 4] + 1;
  END_FOR
  most := MAX(most, MSG_COUNT(heard));
  many := MSG_COUNT(heard) > 3;
  IF at = 5 THEN text := MSG_AT(heard, 2); END_IF
END_PROGRAM
"""
MAIL_COUNTED_MODULO = MAIL.replace("MIN(count + 1, 1000)", "(count + 1) MOD 1000")
"""The limits of `count` are then questions that the solver cannot answer in time: its model takes half a minute."""
LENT = """
FUNCTION_BLOCK Counter VAR_INPUT by : INT; END_VAR VAR_IN_OUT n : INT; END_VAR n := n + by; END_FUNCTION_BLOCK
PROGRAM Lent
VAR_INPUT at, by : INT; END_VAR
VAR a : ARRAY[0..3] OF INT; grid : ARRAY[1..2, 1..2] OF INT; one : Counter; other : INT; END_VAR
  one(by := by, n := a[at]);
  IF by > 0 THEN one(by := 1, n := grid[2, at]); ELSE one(by := 2, n := other); END_IF
END_PROGRAM
"""
EXAMPLES = {
    "integers": INTEGERS, "failing": FAILING, "parts": PARTS, "times": TIMES, "reals": REALS, "alarms": ALARMS, "chart": CHART,
    "classes": CLASSES, "texts": TEXTS, "clock": CLOCK, "mail": MAIL, "lent": LENT,
}  # fmt: skip
