"""Executes the statements of compiled Python code on symbolic values."""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import Any

from fieldtwin.plc.st.model_checking.execution.evaluation import Evaluation, Frame
from fieldtwin.plc.st.model_checking.execution.memory import Memory
from fieldtwin.plc.st.model_checking.execution.natives import SymbolicRange
from fieldtwin.plc.st.model_checking.execution.operations import binary, compare, truth
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.model_checking.execution.sources import Sources
from fieldtwin.plc.st.model_checking.execution.symbolic import UNDEFINED, Choice, Condition, Undefined, either, negated

MAX_ITERATIONS = 200
"""How often a loop whose end is not known may run."""
MAX_STATEMENTS = 200_000
"""How many statements one scan may execute."""
MAX_CALLS = 80
_ASKS_AFTER = 4
"""After how many iterations of a loop whose end is not known the solver is asked whether another one is possible."""
_RETURNED, _RESULT = "<returned>", "<result>"


class Interpreter(Evaluation):
    """The execution of functions. `possible` returns whether a condition can be true in any state."""

    def __init__(self, sources: Sources, memory: Memory, possible: Callable[[Condition], bool]) -> None:
        super().__init__(sources, memory)
        self._possible = possible
        self._executed = 0
        self._calls = 0
        self._loops = 0

    def run(self, function: Callable[..., Any], given: tuple[Any, ...]) -> Any:
        """Execute a function with the arguments `given`, and return its result."""
        tree = self.sources.tree(function)
        self._calls += 1
        if self._calls > MAX_CALLS:
            raise NotModelled(f"more than {MAX_CALLS} nested calls")
        frame = Frame(function.__globals__, self.sources.is_own(function))
        names = [argument.arg for argument in tree.args.args]
        frame.local.update(zip(names, given, strict=False))
        if tree.args.vararg is not None:
            frame.local[tree.args.vararg.arg] = given[len(names) :]
        frame.local[_RETURNED], frame.local[_RESULT] = False, UNDEFINED
        self._block(tree.body, frame)
        self._calls -= 1
        result = frame.local[_RESULT]
        return None if isinstance(result, Undefined) and not _has_result(tree) else result

    # -- control flow -----------------------------------------------------------------------------------------------------

    def _left(self, frame: Frame) -> Condition:
        """Return the condition under which the statements that follow are not executed."""
        number = frame.loops[-1] if frame.loops else 0
        local = frame.local
        return either(local[_RETURNED], local.get(f"<break {number}>", False), local.get(f"<continue {number}>", False))

    def _block(self, statements: list[ast.stmt], frame: Frame) -> None:
        opened = 0
        for n, statement in enumerate(statements):
            self._executed += 1
            if self._executed > MAX_STATEMENTS:
                raise NotModelled(f"a scan of more than {MAX_STATEMENTS:,} statements")
            if frame.own:
                self.line = statement.lineno
            getattr(self, f"_do_{type(statement).__name__.lower()}", self._do_other)(statement, frame)
            left = self._left(frame)
            if left is True:
                break
            if left is not False and n + 1 < len(statements):
                self._go_on(left, frame)
                opened += 1
        for _ in range(opened):
            self.memory.close()

    def _go_on(self, left: Condition, frame: Frame) -> None:
        """Begin the path on which the statements that follow are executed: on it no jump was taken."""
        self.memory.open(negated(left))
        number = frame.loops[-1] if frame.loops else 0
        for flag in (_RETURNED, f"<break {number}>", f"<continue {number}>"):
            if frame.local.get(flag, False) is not False:
                self.memory.put(frame.local, flag, False)

    def _do_other(self, statement: ast.stmt, frame: Frame) -> None:
        raise NotModelled(f"a statement of the kind {type(statement).__name__}")

    def _do_pass(self, statement: ast.Pass, frame: Frame) -> None:
        pass

    def _do_expr(self, statement: ast.Expr, frame: Frame) -> None:
        if not isinstance(statement.value, ast.Constant):  # a docstring
            self.value(statement.value, frame)

    def _do_return(self, statement: ast.Return, frame: Frame) -> None:
        if statement.value is not None:
            self.memory.put(frame.local, _RESULT, self.value(statement.value, frame))
        self.memory.put(frame.local, _RETURNED, True)

    def _do_break(self, statement: ast.Break, frame: Frame) -> None:
        self.memory.put(frame.local, f"<break {frame.loops[-1]}>", True)

    def _do_continue(self, statement: ast.Continue, frame: Frame) -> None:
        self.memory.put(frame.local, f"<continue {frame.loops[-1]}>", True)

    def _do_raise(self, statement: ast.Raise, frame: Frame) -> None:
        assert isinstance(statement.exc, ast.Call)
        first = statement.exc.args[0]
        self.fail_if(True, str(first.value) if isinstance(first, ast.Constant) else "an operation without a result")
        self.memory.put(frame.local, _RETURNED, True)

    def _do_if(self, statement: ast.If, frame: Frame) -> None:
        if _counts_steps(statement.test):
            return
        condition = truth(self.value(statement.test, frame))
        self.memory.branch(
            condition,
            lambda: self._block(statement.body, frame),
            lambda: self._block(statement.orelse, frame),
        )

    def _do_while(self, statement: ast.While, frame: Frame) -> None:
        self._loop(statement, frame, lambda n: truth(self.value(statement.test, frame)))

    def _do_for(self, statement: ast.For, frame: Frame) -> None:
        taken, control = self._iterated(statement.iter, frame)
        if isinstance(taken, SymbolicRange):
            op = "<" if taken.step > 0 else ">"

            def more(n: int) -> Condition:
                value = binary("+", taken.start, n * taken.step)
                goes_on = compare(op, value, taken.stop)
                if goes_on is not False:
                    self._assign(statement.target, value, frame)
                return goes_on
        else:
            items = list(taken)

            def more(n: int) -> Condition:
                if n >= len(items):
                    return False
                self._assign(statement.target, items[n], frame)
                return True

        self._loop(statement, frame, more, control)

    def _iterated(self, node: ast.expr, frame: Frame) -> tuple[Any, ast.Lambda | None]:
        """Return what a FOR iterates over, and the function that returns its control variable if a POU could alter that."""
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "unaltered":
            taken, control = node.args
            assert isinstance(control, ast.Lambda)
            return self.value(taken, frame), control
        taken = self.value(node, frame)
        if isinstance(taken, Choice):
            raise NotModelled("a FOR over one of several ranges")
        return (() if isinstance(taken, Undefined) else taken), None

    def _loop(
        self,
        statement: ast.For | ast.While,
        frame: Frame,
        more: Callable[[int], Condition],
        control: ast.Lambda | None = None,
    ) -> None:
        """Execute a loop. `more` prepares the iteration n, and returns the condition under which it is executed."""
        self._loops += 1
        number, line = self._loops, self.line
        broken, continued = f"<break {number}>", f"<continue {number}>"
        self.memory.put(frame.local, broken, False)
        frame.loops.append(number)
        opened = 0
        n = 0
        while True:
            if frame.own:
                self.line = line
            goes_on = more(n)
            if goes_on is False:
                break
            if goes_on is not True:
                self.memory.open(goes_on)
                opened += 1
            if opened and n >= _ASKS_AFTER and not self._possible(self.memory.path):
                break
            if opened and n >= MAX_ITERATIONS:
                raise NotModelled(
                    f"a loop that can run more than {MAX_ITERATIONS} times",
                    "give it a constant bound, or limit the inputs with --assume",
                )
            self.memory.put(frame.local, continued, False)
            before = self.value(control.body, frame) if control is not None else None
            self._block(statement.body, frame)
            if control is not None:
                altered = compare("!=", self.value(control.body, frame), before)
                self.fail_if(altered, "the control variable of a FOR was altered in the loop")
            self.memory.put(frame.local, continued, False)
            left = either(frame.local[broken], frame.local[_RETURNED])
            if left is True:
                break
            if left is not False:
                self._go_on(left, frame)
                opened += 1
            n += 1
        for _ in range(opened):
            self.memory.close()
        frame.loops.pop()
        if isinstance(statement, ast.For) and statement.orelse:
            ended = negated(either(frame.local[broken], frame.local[_RETURNED]))
            self.memory.branch(ended, lambda: self._block(statement.orelse, frame), lambda: None)

    # -- assignment -------------------------------------------------------------------------------------------------------

    def _do_assign(self, statement: ast.Assign, frame: Frame) -> None:
        value = self.value(statement.value, frame)
        for target in statement.targets:
            self._assign(target, value, frame)

    def _do_annassign(self, statement: ast.AnnAssign, frame: Frame) -> None:
        assert statement.value is not None
        self._assign(statement.target, self.value(statement.value, frame), frame)

    def _do_augassign(self, statement: ast.AugAssign, frame: Frame) -> None:
        if _counts_steps(statement.target):
            return
        load = ast.copy_location(ast.BinOp(_loaded(statement.target), statement.op, statement.value), statement)
        self._assign(statement.target, self.value(load, frame), frame)

    def _assign(self, target: ast.expr, value: Any, frame: Frame) -> None:
        if isinstance(target, ast.Name):
            self.memory.put(frame.local, target.id, value)
        elif isinstance(target, ast.Attribute):
            self.put_attribute(self.value(target.value, frame), target.attr, value)
        elif isinstance(target, ast.Subscript):
            self._assign_item(target, value, frame)
        elif isinstance(target, ast.Tuple):
            for part, each in zip(target.elts, value, strict=True):
                self._assign(part, each, frame)
        else:
            raise NotModelled(f"an assignment to {type(target).__name__}")

    def _assign_item(self, target: ast.Subscript, value: Any, frame: Frame) -> None:
        owner = self.value(target.value, frame)
        index = slice(None) if isinstance(target.slice, ast.Slice) else self.value(target.slice, frame)
        for condition, option in owner.options if isinstance(owner, Choice) else ((True, owner),):
            self.memory.open(condition)
            if isinstance(index, slice):
                for n, each in enumerate(value):
                    self.memory.put(option, n, each)
            elif isinstance(index, int):
                self.memory.put(option, index, value)
            elif not isinstance(index, Undefined) and not isinstance(option, Undefined):
                self.put_item(option, index, value)
            self.memory.close()


def _has_result(tree: ast.FunctionDef) -> bool:
    return any(isinstance(node, ast.Return) and node.value is not None for node in ast.walk(tree))


def _counts_steps(node: ast.AST) -> bool:
    """Return whether a part of a statement counts the iterations of a scan, of which the number is limited otherwise."""
    return any(
        isinstance(n, ast.Attribute) and n.attr == "left" and isinstance(n.value, ast.Name) and n.value.id == "_c"
        for n in ast.walk(node)
    )


def _loaded(target: ast.expr) -> ast.expr:
    """Return the expression that reads the target of an assignment."""
    if isinstance(target, ast.Attribute):
        return ast.copy_location(ast.Attribute(target.value, target.attr, ast.Load()), target)
    assert isinstance(target, ast.Name)
    return ast.copy_location(ast.Name(target.id, ast.Load()), target)
