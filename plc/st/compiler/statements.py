"""Compiles statements to Python."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import bind, given_outputs
from fieldtwin.plc.st.compiler.calls import Calls
from fieldtwin.plc.st.compiler.classes.members import SUPER, is_own, method_of, note
from fieldtwin.plc.st.compiler.execution_control import split_control
from fieldtwin.plc.st.compiler.implicit import meeting
from fieldtwin.plc.st.compiler.scope import CodeWriter, Environment, Symbol, Value, default_value, identifier, wrapped
from fieldtwin.plc.st.compiler.variables import variable
from fieldtwin.plc.st.syntax import tree as t

MAX_DEEP = 60
"""How deep statements may be nested."""
MAX_LOOPS = 18
"""How deep loops may be nested: Python's limit is 20."""
MAX_CONTINUES = 50
"""The largest number of CONTINUE statements in one REPEAT. The generated code repeats the condition for each of them."""
_CHAIN = 48
"""The longest chain of elif: a longer chain is split, because Python nests each branch in the one before."""


class Statements(Calls):
    """The compiler of the statements of a POU. `leave` is the Python statement for RETURN."""

    leave = "return"

    def __init__(self, env: Environment, symbols: dict[str, Symbol], out: CodeWriter, pou: str = "") -> None:
        super().__init__(env, symbols, out, pou)
        self._loops: list[t.Expr | None] = []  # the loops around the statement; for a REPEAT its condition
        self._continues: dict[int, int] = {}
        self._inside = 0
        self._target: tuple[str, dict[str, int]] = ("", {})
        """The variable with the number of the part that a jump executes next, and the numbers of the labels in lower case."""
        self.actions: frozenset[str] = frozenset()
        """The names of the actions of the POU `owner`, in lower case."""
        self.owner = pou

    def body(self, statements: tuple[t.Statement, ...]) -> None:
        if self._inside >= MAX_DEEP and statements:
            self.env.fail(statements[0].pos, "statements nested too deep", expected=f"at most {MAX_DEEP} levels")
        self._inside += 1
        for statement in statements:
            loops, controls, inside = len(self._loops), len(self.controls), self._inside
            try:
                getattr(self, f"_{type(statement).__name__.lower()}")(statement)
            except FileInvalid as e:  # the next statement may have an error too
                self.env.collected(e)
                del self._loops[loops:], self.controls[controls:]
                self._inside = inside
        self._inside -= 1

    # -- assignment and calls -----------------------------------------------------------------------------------------

    def _assign(self, s: t.Assign) -> None:
        if s.word and not self.env.dialect.vendor:
            expected = (
                "one statement for each assignment"
                if s.word == t.CHAINED
                else f"IF condition THEN {s.target.name} := ..."
            )
            self.env.fail(s.pos, f"{s.word} is not in this dialect", expected=expected)
        self.assign(s.target, self.value(s.value, self.type_of(s.target)), s.value.pos)

    def _refer(self, s: t.Refer) -> None:
        self.refer(s)

    def _attempt(self, s: t.Attempt) -> None:
        self.attempt(s)

    # -- unit tests and coverage --------------------------------------------------------------------------------------

    def _assertion(self, s: t.Assertion) -> None:
        condition = self.condition(s.condition, "an assertion") if s.condition is not None else ""
        shown = [self.value(expr) for expr in s.shown]
        condition = condition or self._same_arrays(s, shown)
        self.env.recorded[s.number] = tuple(value.type for value in shown)
        values = "".join(f"{value.code}, " for value in shown)
        self.out.line(f"_c.asserted({s.number}, {condition}, ({values}), {s.of_test})", s.pos)

    def _same_arrays(self, s: t.Assertion, values: list[Value]) -> str:
        """Return the code that compares two arrays of an assertion."""
        kinds = [value.type for value in values[:2] if isinstance(value.type, ty.Array)]
        for expr, value in zip(s.shown[:2], values, strict=False):
            if not isinstance(value.type, ty.Array) or not isinstance(
                ty.plain(value.type.of), ty.Elementary | ty.String
            ):
                wanted = "an array of numbers, texts or truth values"
                self.env.fail(expr.pos, "an assertion about arrays", expected=wanted, got=str(value.type))
        actual, expected = kinds
        fits = ty.fits(actual.of, expected.of) or ty.fits(expected.of, actual.of)
        if not fits or len(actual.ranges) != len(expected.ranges):
            self.env.fail(s.pos, "arrays of different types", expected=str(expected), got=str(actual))
        within = self.coerced(values[2], ty.LREAL, s.pos, "Delta") if len(values) > 2 else "None"
        return f"_c.same({values[0].code}, {values[1].code}, {within})"

    def _ordered(self, s: t.Ordered) -> None:
        with self.out.block(f"if _c.has_turn({s.test}):", s.pos):
            self.body(s.body)

    def _finished(self, s: t.Finished) -> None:
        self.out.line(f"_c.finished.add({s.test})", s.pos)

    def _advance(self, s: t.Advance) -> None:
        by = self.coerced(self.value(s.by), ty.LTIME, s.pos, "BY of ADVANCE_TIME")
        self.out.line(f"_c.advance({by})", s.pos)

    def _probe(self, s: t.Probe) -> None:
        if s.value is None:
            self.out.line(f"_c.executed({s.number})", s.pos)
            return
        value = self.value(s.value)
        self.env.probed[s.number] = value.type
        self.out.line(f"_c.executed(({s.number}, {value.code}))", s.pos)

    # -- values of networks and tests ---------------------------------------------------------------------------------

    def _hold(self, s: t.Hold) -> None:
        code = "w_" + s.name.replace(".", "_")
        with self.env.declaring(s.name, self.env.faulty_here):
            kept = self._kept(s, code)
            self.symbols[s.name] = Symbol(s.name, kept.type, code, writable=False, constant=kept.constant)

    def _kept(self, s: t.Hold, code: str) -> Value:
        if s.enabled is None:
            return self._held(s, code)
        with self.out.block(f"if {self.condition(s.enabled, 'EN')}:", s.pos):
            kept = self._held(s, code)
        with self.out.block("else:", s.pos):
            self.out.line(f"{code} = {default_value(kept.type)}", s.pos)
        return kept

    def _held(self, s: t.Hold, code: str) -> Value:
        value = self.value(s.value)
        if s.boolean:
            value = Value(self.coerced(value, ty.BOOL, s.pos, f"the state of {s.boolean}"), ty.BOOL)
        self.out.line(f"{code} = {value.code}", s.pos)
        return value

    def _callstatement(self, s: t.CallStatement) -> None:
        call = s.call
        name = call.ref.name.lower()
        if method_of(self, call.ref, "METHOD") is not None:
            self.out.line(self.value(call).code, s.pos)
            return
        if name in SUPER and not call.ref.selectors and is_own(self, call.ref):
            self._base_call(call)
            return
        known = name in self.symbols or name in self.env.globals
        if not call.ref.selectors and not known and self._is_action(self.owner, self.actions, name):
            self._own_action(call, name)
        elif call.ref.selectors or known:
            ref, action = self._action_of(call.ref)
            instance = variable(self, ref)
            if not isinstance(instance.type, ty.Block):
                self.env.fail(
                    call.pos, f"{call.ref.name} cannot be called", expected="a function block", got=str(instance.type)
                )
            self._block_call(call, instance.code, instance.type, action)
        else:
            self.out.line(self.value(call).code, s.pos)

    def _base_call(self, call: t.Call) -> None:
        """Write ``SUPER()``, the call of the body of the base (6.6.6.4). The dialects of CODESYS also call it in a method."""
        assert self.own is not None
        in_body = self.pou == self.owner
        base = self.own.ancestors[0]
        if call.arguments:
            self.env.fail(call.arguments[0].pos, f"{call.ref.name} takes no arguments: the base has the same variables")
        if base.kind == "CLASS" or not (in_body or self.env.dialect.vendor):
            expected = f"{call.ref.name} in the body of a FUNCTION_BLOCK that extends a FUNCTION_BLOCK"
            self.env.fail(call.pos, f"{call.ref.name}()", expected=expected)
        if not in_body and isinstance(base.type, ty.Block) and base.type.in_outs:
            message = f"{call.ref.name}() in a method or action, and {base.name} has VAR_IN_OUT, which exist only in its own call"
            self.env.fail(call.pos, message, expected=f"{call.ref.name}() in the body")
        note(self, base.key, call.pos)
        self.out.line(f"B_{identifier(base.key)}.execute(self, {'now_ns' if in_body else '_c.now_ns'})", call.pos)

    def _is_action(self, pou: str, actions: frozenset[str], name: str) -> bool:
        return name in actions or f"{pou}.{name}" in self.env.missing

    def _own_action(self, call: t.Call, name: str) -> None:
        """Write the call of an action of the same POU."""
        declaring = self.own.actions.get(name, self.owner) if self.own is not None else self.owner
        self._note_action(declaring, name, call)
        if call.arguments:
            self.env.fail(call.arguments[0].pos, f"action {call.ref.name} takes no arguments")
        self.out.line(f"self.a_{name}()", call.pos)

    def _declaring(self, block: ty.Block, action: str) -> str:
        """Return the name of the POU that declares the action: the block or one of its bases, in lower case."""
        of = self.env.classes.get(block.name.lower())
        return of.actions.get(action, of.key) if of is not None else block.name.lower()

    def _note_action(self, pou: str, name: str, call: t.Call) -> None:
        key = f"{pou}.{name}"
        self.env.refuse_missing(key, call.pos)
        self.env.calls.setdefault(self.pou, {}).setdefault(key, call.pos)

    def _action_of(self, ref: t.Ref) -> tuple[t.Ref, str]:
        """Return the reference to a function block, and the name of its action that `ref` selects; "" for the block itself."""
        last = ref.selectors[-1] if ref.selectors else None
        if isinstance(last, t.Member):
            instance = ref.without_last()
            kind, name = self.type_of(instance), last.name.lower()
            if isinstance(kind, ty.Block) and self._is_action(kind.name.lower(), kind.actions, name):
                return instance, name
        return ref, ""

    def _block_call(self, call: t.Call, code: str, block: ty.Block, action: str = "") -> None:
        """Write the call of a function block, or of one of its actions."""
        call, en, eno = split_control(self.env, call, {*block.inputs, *block.outputs, *block.in_outs})
        if en is not None or eno is not None:
            self.controlled(call.pos, en, eno, lambda: self._block_call(call, code, block, action))
            return
        if block.is_class and not action:
            self.env.fail(call.pos, f"{call.ref.name} is an instance of the class {block} and cannot be called")
        if action:
            self._note_action(self._declaring(block, action), action, call)
        if "[" in code or "(" in code:  # compute the place once
            place = self.out.temporary()
            self.out.line(f"{place} = {code}", call.pos)
            code = place
        if block.aliases:
            named = (replace(a, name=block.aliases.get(a.name.lower(), a.name)) for a in call.arguments)
            call = replace(call, arguments=tuple(named))
        cells: dict[str, str] = {}
        given = bind(self.env, call, block.order, str(block), block.outputs)
        outputs = given_outputs(self.env, call, given, block.outputs, str(block))
        for name, argument in given.items():
            assert argument.value is not None
            if name in block.inputs:
                member, kind = block.inputs[name]
                value = self.given(argument.value, kind, argument.pos, f"{member} of {block}")
                self.out.line(f"{code}.{_attribute(block, name, member)} = {value}", call.pos)
            else:
                member, kind = block.in_outs[name]
                handed = self.in_out(argument.value, member, kind, call, str(block), cells)
                self.out.line(f"{code}.v_{name} = {handed}", call.pos)
        for name, (member, _) in block.in_outs.items():
            if name not in given:
                self.env.fail(call.pos, f"VAR_IN_OUT {member} of {block} needs a variable")
        self.out.line(f"{code}.a_{action}()" if action else f"{code}.execute(_c.now_ns)", call.pos)
        self.take_back(cells, call.pos)
        for argument in outputs:
            name = argument.name.lower()
            if name not in block.outputs:
                self.env.unknown(
                    argument.pos, f"in {block}, an output", argument.name, [m for m, _ in block.outputs.values()]
                )
            member, kind = block.outputs[name]
            self.take(argument, Value(f"{code}.{_attribute(block, name, member)}", kind))

    # -- selection ----------------------------------------------------------------------------------------------------

    def _if(self, s: t.If) -> None:
        if len(s.branches) <= _CHAIN:
            self._chain(s.branches, lambda: self.body(s.otherwise), bool(s.otherwise), s.pos)
            return
        done = self.out.temporary()
        self.out.line(f"{done} = False", s.pos)
        for n in range(0, len(s.branches), _CHAIN):
            with self.out.block(f"if not {done}:", s.pos):
                self.out.line(f"{done} = True", s.pos)
                self._chain(s.branches[n : n + _CHAIN], lambda: self.out.line(f"{done} = False", s.pos), True, s.pos)
        if s.otherwise:
            with self.out.block(f"if not {done}:", s.pos):
                self.body(s.otherwise)

    def _chain(
        self,
        branches: tuple[tuple[t.Expr, tuple[t.Statement, ...]], ...],
        otherwise: Callable[[], None],
        more: bool,
        pos: t.Pos,
    ) -> None:
        """Write a chain of if and elif, and let `otherwise` write the else branch, if there is one (`more`).

        A condition that needs lines before it begins a new chain inside the else branch of the previous chain.
        """
        with ExitStack() as inside:
            word = "if"
            for condition, body in branches:
                mark = len(self.out.lines)
                code = self.condition(condition, "IF")
                prepared = self.out.since(mark)
                if prepared and word == "elif":
                    if self.out.depth >= MAX_DEEP:
                        self.env.fail(condition.pos, "too many conditions with calls in one IF")
                    inside.enter_context(self.out.block("else:", pos))
                    word = "if"
                self.out.again(prepared)
                with self.out.block(f"{word} {code}:", condition.pos):
                    self.body(body)
                word = "elif"
            if more:
                with self.out.block("else:", pos):
                    otherwise()

    def _case(self, s: t.Case) -> None:
        selector = self.value(s.selector)
        kind = ty.plain(selector.type)
        if not (ty.is_kind(kind, "int", "bits") or isinstance(kind, ty.Enum)):
            self.env.fail(
                s.selector.pos, "the selector of CASE", expected="a whole number or an enumeration", got=str(kind)
            )
        name = self.out.temporary()
        self.out.line(f"{name} = {selector.code}", s.pos)
        labels = [[(*self._label(label, kind), label.pos) for label in of] for of, _ in s.branches]
        self._check_labels([label for of in labels for label in of])
        bodies = [body for _, body in s.branches]
        places = [of[0].pos for of, _ in s.branches]
        if len(bodies) <= _CHAIN:
            tests = [
                " or ".join(f"{name} == {low}" if low == high else f"{low} <= {name} <= {high}" for low, high, _ in of)
                for of in labels
            ]
        else:
            rows = sorted((low, high, n) for n, of in enumerate(labels) for low, high, _ in of)
            lows, highs, numbers = (tuple(column) for column in zip(*rows, strict=True))
            self.out.line(f"{name} = _v.branch({name}, {lows}, {highs}, {numbers})", s.pos)
            tests = [f"{name} == {n}" for n in range(len(bodies))]
        self._cases(name, list(zip(tests, bodies, places, strict=True)), 0, s)

    def _cases(self, name: str, rows: list[tuple[str, tuple[t.Statement, ...], t.Pos]], first: int, s: t.Case) -> None:
        """Write the branches of a CASE as a chain of conditions.

        If there are many, they are selected by number, in nested halves.
        """
        if len(rows) > _CHAIN:
            half = len(rows) // 2
            with self.out.block(f"if 0 <= {name} < {first + half}:", s.pos):
                self._cases(name, rows[:half], first, s)
            with self.out.block(f"elif {name} >= {first + half}:", s.pos):
                self._cases(name, rows[half:], first + half, s)
            if s.otherwise and len(rows) == len(s.branches):
                with self.out.block("else:", s.pos):
                    self.body(s.otherwise)
            return
        word = "if"
        for test, body, pos in rows:
            with self.out.block(f"{word} {test}:", pos):
                self.body(body)
            word = "elif"
        if s.otherwise and len(rows) == len(s.branches):
            with self.out.block("else:" if word == "elif" else "if True:", s.pos):
                self.body(s.otherwise)

    def _label(self, label: t.CaseLabel, kind: ty.Type) -> tuple[int, int]:
        ends = []
        for expr in (label.low, label.high or label.low):
            value = self.value(expr, kind if self.of_context(kind) else None)
            whole = ty.is_kind(value.type, "int", "bits") or isinstance(value.type, ty.Enum)
            if value.constant is None or not whole or meeting(self, value.type, kind, expr.pos) is None:
                self.env.fail(expr.pos, "a label of CASE", expected=f"a constant of {kind}", got=str(value.type))
            ends.append(int(value.constant))
        low, high = ends
        if low > high:
            self.env.fail(label.pos, "an empty range", got=f"{low}..{high}")
        return low, high

    def _check_labels(self, labels: list[tuple[int, int, t.Pos]]) -> None:
        """Check that no two labels overlap; the error names the later one."""
        before: tuple[int, int, t.Pos] | None = None
        for label in sorted(labels, key=lambda each: each[:2]):
            if before is not None and label[0] <= before[1]:
                low, high, pos = max(before, label, key=lambda each: (each[2].line, each[2].column))
                got = str(low) if low == high else f"{low}..{high}"
                self.env.fail(pos, "a label that another branch also has", got=got)
            before = label

    # -- iteration ----------------------------------------------------------------------------------------------------

    @contextmanager
    def _loop(self, head: str, pos: t.Pos, until: t.Expr | None = None) -> Iterator[None]:
        if len(self._loops) >= MAX_LOOPS:
            self.env.fail(pos, "loops nested too deep", expected=f"at most {MAX_LOOPS}")
        self._loops.append(until)
        with self.out.block(head, pos):
            self.out.step(pos)
            yield
        self._loops.pop()

    def _for(self, s: t.For) -> None:
        """Compile FOR. Limits and step are computed once. Afterwards the variable is the first value past the limit, as
        in C."""
        target = self.writable(s.variable)
        kind = target.type
        if not isinstance(kind, ty.Elementary) or kind.kind != "int":
            self.env.fail(s.variable.pos, "the variable of FOR", expected="an integer", got=str(kind))
        if target.code.count(".m_") != len(s.variable.selectors):
            self.env.fail(s.variable.pos, "the variable of FOR", expected="a variable, or a member of a structure")
        first, last = (self.coerced(self.value(e), kind, e.pos, "a limit of FOR") for e in (s.first, s.last))
        taken, code = self.out.temporary(), f"range({first}, {last} + 1)"
        if s.step is not None:
            code = f"_v.steps({first}, {last}, {self.coerced(self.value(s.step), kind, s.step.pos, 'the step of FOR')})"
        self.out.line(f"{taken} = {code}", s.pos)
        own = target.code in (f"v_{s.variable.name.lower()}", f"self.v_{s.variable.name.lower()}")
        head = taken if own else f"_v.unaltered({taken}, lambda: {target.code})"
        begin, indent = len(self.out.lines), "    " * self.out.depth
        self.controls.append(target.code)
        with self._loop(f"for {target.code} in {head}:", s.pos):
            self.body(s.body)
        self.controls.pop()
        beyond = f"_v.beyond({taken})"
        if len(self.controls) in self.altered:
            self.altered.remove(len(self.controls))
            head = f"_v.following({taken}, lambda: {target.code})"
            self.out.lines[begin] = f"{indent}for {target.code} in {head}:", s.pos
            beyond = f"({target.code} + {taken}.step if {taken} else {taken}.start)"
        with self.out.block("else:", s.pos):
            self.out.line(f"{target.code} = {wrapped(beyond, kind)}", s.pos)

    def _while(self, s: t.While) -> None:
        with self._loop("while True:", s.pos):
            code = self.condition(s.condition, "WHILE")
            with self.out.block(f"if not {code}:", s.condition.pos):
                self.out.line("break", s.condition.pos)
            self.body(s.body)

    def _repeat(self, s: t.Repeat) -> None:
        with self._loop("while True:", s.pos, s.until):
            self.body(s.body)
            self._until(s.until)

    def _until(self, condition: t.Expr) -> None:
        code = self.condition(condition, "REPEAT")
        with self.out.block(f"if {code}:", condition.pos):
            self.out.line("break", condition.pos)

    def _networks(self, s: t.Networks) -> None:
        """Compile a drawn body with jumps: a loop over its parts, which a jump begins again with the number of its label."""
        target = self.out.temporary()
        numbers = {label.lower(): n for n, part in enumerate(s.parts) for label in part.labels}
        self._target = target, numbers
        self.out.line(f"{target} = 0", s.pos)
        with self.out.block("while True:", s.pos):
            for n, part in enumerate(s.parts):
                with self.out.block(f"if {target} <= {n}:", s.pos):
                    self.body(part.body)
            self.out.line("break", s.pos)

    def _jump(self, s: t.Jump) -> None:
        if s.word == "RETURN":
            self.out.line(self.leave, s.pos)
            return
        if s.word == "JMP":
            target, numbers = self._target
            self.out.step(s.pos)
            self.out.line(f"{target} = {numbers[s.label.lower()]}", s.pos)
            self.out.line("continue", s.pos)
            return
        if not self._loops:
            self.env.fail(s.pos, f"{s.word} outside a loop")
        if s.word == "EXIT":
            self.out.line("break", s.pos)
            return
        until = self._loops[-1]
        if until is not None:  # CONTINUE in REPEAT goes to its condition
            self._continues[id(until)] = self._continues.get(id(until), 0) + 1
            if self._continues[id(until)] > MAX_CONTINUES:
                self.env.fail(s.pos, "too many CONTINUEs in one REPEAT", expected=f"at most {MAX_CONTINUES}")
            self._until(until)
        self.out.line("continue", s.pos)


def _attribute(block: ty.Block, name: str, member: str) -> str:
    return member if block.standard else f"v_{name}"
