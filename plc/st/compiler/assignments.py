"""Records which line last assigned an output, an element of an array or a member of a structure: a pass over the Python that
Structured Text was compiled to.

After each such assignment (a statement, an output of a block or function, a VAR_IN_OUT) it inserts an assignment of the line's
number; for elements, members and global variables, of a record with the number of the scan, the object that executed the
statement, and the values of indices and pointers. The Python text of a unit stays without them, and the model checker reads that.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.runtime.lines import MEMBER, RECORD_HEAD, indices_of, line_of

GLOBALS = "_G"
"""The name of the object that holds the global variables in the Python code."""
MAX_INDICES = 8
"""The largest number of variables in indices whose values one assignment records."""
_VARIABLE = "v_"
_INDEXING = {"index": 0, "view": 1, "moved": 1}
"""The functions that check an index, with the number of the argument that is the index."""
_POINTED = "pointed"
"""The function that checks a pointer."""
_KEPT = "_w"
"""The beginning of the local variables that keep a part of a target for its record."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """The attributes of a program or function block whose assignments are recorded: its `outputs`, its `arrays` of simple
    values, and its VAR_IN_OUTs that are such arrays (`lent`).
    """

    outputs: frozenset[str] = frozenset()
    arrays: frozenset[str] = frozenset()
    lent: frozenset[str] = frozenset()

    def slots(self) -> tuple[str, ...]:
        """Return the attributes that keep the lines."""
        outputs = sorted(self.outputs)
        return (*map(line_of, outputs), *map(indices_of, outputs), *map(line_of, sorted(self.arrays | self.lent)))


@dataclass(frozen=True, slots=True)
class Arrays:
    """The attributes of a unit that are arrays of simple values: variables (`arrays`), VAR_IN_OUTs (`lent`), and `members` of
    structures, which are arrays in each structure that has a member with this name.
    """

    arrays: frozenset[str] = frozenset()
    lent: frozenset[str] = frozenset()
    members: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Assigned:
    """Which assignments of a unit are recorded: by class of a program or block its attributes, the attributes of global variables
    that are assigned as a whole (`shared`), and the arrays of the unit.
    """

    recorded: Mapping[str, Recorded] = field(default_factory=dict)
    shared: frozenset[str] = frozenset()
    arrays: Arrays = Arrays()


class MemberLines(ast.NodeTransformer):
    """The pass over the class of a structure, whose new objects have no records yet."""

    def __init__(self, members: frozenset[str]) -> None:
        self._members = members

    def visit_Assign(self, node: ast.Assign) -> list[ast.stmt]:
        target = node.targets[0]
        if isinstance(target, ast.Attribute) and target.attr in self._members:
            lines = ast.Attribute(_load(target.value), line_of(target.attr), ast.Store())
            return [node, _at(ast.Assign([lines], _call("ElementLines")), node)]
        return [node]


def is_recorded(kind: ty.Type) -> bool:
    """Return whether a variable of this type is an array whose elements are recorded. Structures and instances have own
    records.
    """
    if not isinstance(kind, ty.Array):
        return False
    while isinstance(kind, ty.Array):
        kind = kind.of
    return not isinstance(kind, ty.Struct | ty.Block)


class Assignments(ast.NodeTransformer):
    """The pass over a class or function. `recorded` names the attributes of ``self`` whose assignments are recorded, `known`
    has the arrays of the unit.

    `shared` are the global variables. Any program or instance may assign them, so their records have the object. Lines of a
    function block have the file `path` (`with_path`), because it may be in another file than the program.
    """

    def __init__(
        self, recorded: Recorded, known: Arrays, shared: frozenset[str], path: str, *, with_path: bool
    ) -> None:
        self._with_path = with_path
        self._outputs = {"self": recorded.outputs, GLOBALS: shared}
        self._recorded_here, self._known, self._path = recorded, known, path
        self._indices: list[list[str]] = []
        """The variables in indices of the conditions around the statement."""
        self._temporaries: dict[str, list[str]] = {}
        """The variables in indices of the values of temporary variables, by their names."""
        self._kept = 0
        self._in_instance = False

    # -- what is around a statement -----------------------------------------------------------------------------------

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self._temporaries, self._kept = {}, 0
        self._in_instance = bool(node.args.args) and node.args.args[0].arg == "self"
        self.generic_visit(node)
        if node.name == "__init__":
            here = self._recorded_here
            lines: list[tuple[str, ast.expr]] = [(name, _call("ElementLines")) for name in sorted(here.arrays)]
            lines += [(name, _no_lines()) for name in sorted(here.lent)]
            node.body[:0] = [_at(ast.Assign([_own(line_of(name), ast.Store())], made), node) for name, made in lines]
        return node

    def visit_If(self, node: ast.If) -> ast.If:
        self._indices.append(self._indices_in(node.test))
        self._lend(node.test, node)
        self.generic_visit(node)
        self._indices.pop()
        return node

    def visit_For(self, node: ast.For) -> ast.For:
        self.generic_visit(node)
        node.body[:0] = self._lines(self._outputs_in(node.target), node, node.iter)
        return node

    # -- assignments --------------------------------------------------------------------------------------------------

    def visit_Assign(self, node: ast.Assign) -> list[ast.stmt]:
        target = node.targets[0]
        if isinstance(target, ast.Name) and not target.id.startswith(_VARIABLE):
            self._temporaries[target.id] = self._indices_in(node.value)
        self._lend(node, node)
        if isinstance(target, ast.Subscript):
            return [node, *self._element(target, node)]
        if not isinstance(target, ast.Attribute):
            return [node]
        own = {ast.unparse(target)}
        if target.attr == "v":  # through a reference, which knows where the line belongs
            assign = ast.Attribute(target.value, "assign", ast.Load())
            return [_at(ast.Expr(ast.Call(assign, [node.value, self._record(node)], [])), node)]
        if target.attr.startswith(MEMBER):
            record = self._record(node, own)
            line = ast.Attribute(self._again(target), line_of(target.attr), ast.Store())
            return [node, _at(ast.Assign([line], record), node)]
        if not _is_own(target) and target.attr in self._known.lent:
            lines = self._lines_of(node.value) or _no_lines()
            if target.attr in self._known.arrays:  # a variable of another block has the same name
                return [
                    node,
                    _at(ast.Expr(_call("hand_lines", _load(target.value), ast.Constant(target.attr), lines)), node),
                ]
            handed = ast.Attribute(_load(target.value), line_of(target.attr), ast.Store())
            return [node, _at(ast.Assign([handed], lines), node)]
        return [node, *self._lines(self._outputs_in(target), node, node, own)]

    def visit_Expr(self, node: ast.Expr) -> list[ast.stmt]:
        call = node.value
        name = _function(call)
        self._lend(node, node)
        if not isinstance(call, ast.Call) or name not in ("put", "fill"):
            return [node]
        record, target = self._record(node), call.args[0]
        lines = (self._lines_of(target, whole=True) or _no_lines()) if name == "fill" else None
        kept, call.args[0] = self._keep(target)
        noted = _call("assigned_whole", kept, record) if lines is None else _call("assigned_array", kept, lines, record)
        return [node, _at(ast.Expr(noted), node)]

    def _lend(self, part: ast.AST, node: ast.stmt) -> None:
        """Hand the records of arrays to the references in a `part` of a statement, and note that a function or method may
        assign the arrays that it receives.
        """
        for call in [each for each in ast.walk(part) if isinstance(each, ast.Call)]:
            name = _function(call)
            if name in ("Element", "OpenArray", "Whole"):
                lines = self._lines_of(call.args[0])
                if lines is not None:
                    call.keywords.append(ast.keyword("lines", lines))
            elif _writes_memory(call):
                call.keywords.append(ast.keyword("record", self._record(node)))
            elif not name and not _is_context(call):
                for n, argument in enumerate(call.args):
                    lines = self._lines_of(argument)
                    if lines is not None:
                        call.args[n] = _call("lent", argument, lines, self._record(node))

    def _element(self, target: ast.Subscript, node: ast.Assign) -> list[ast.stmt]:
        """Return the statement that records the assignment of an element."""
        record = self._record(node)
        array, keys = self._rows(target)
        lines = self._lines_of(array, whole=True)
        if lines is None:
            return []
        key = keys[0] if len(keys) == 1 else ast.Tuple(keys, ast.Load())
        return [_at(ast.Assign([ast.Subscript(lines, key, ast.Store())], record), node)]

    def _rows(self, part: ast.expr) -> tuple[ast.expr, list[ast.expr]]:
        """Return the array of an element, and the expressions that repeat its indices, the first one first."""
        keys: list[ast.expr] = []
        while isinstance(part, ast.Subscript):
            kept, part.slice = self._keep(part.slice)
            keys.insert(0, kept)
            part = part.value
        return part, keys

    def _lines_of(self, array: ast.expr, *, whole: bool = False) -> ast.expr | None:
        """Return the expression of the records of an array that is a variable or a part of one; None for others.

        `whole`: `array` is an array also if it is the variable of a reference.
        """
        at = array
        while isinstance(at, ast.Subscript):
            at = at.value
        if _function(at) == "whole" and isinstance(at, ast.Call):
            at = at.args[0]
        if not isinstance(at, ast.Attribute):
            return None
        lines: ast.expr
        if _is_own(at):
            if at.attr not in self._recorded_here.arrays | self._recorded_here.lent:
                return None
            lines = _own(line_of(at.attr))
        elif at.attr in self._known.members:
            lines = ast.Attribute(self._again(at), line_of(at.attr), ast.Load())
        elif at.attr in self._known.arrays | self._known.lent:
            lines = _call("lines_in", self._again(at), ast.Constant(at.attr))
        elif at.attr == "items" or (at.attr == "v" and (whole or at is not array)):
            lines = ast.Attribute(self._again(at), "lines", ast.Load())
        else:
            return None
        _, rows = self._rows(array)
        return _call("RowLines", lines, *rows) if rows else lines

    # -- records ------------------------------------------------------------------------------------------------------

    def _record(self, node: ast.stmt, without: Collection[str] = (), read: ast.AST | None = None) -> ast.Tuple:
        """Return the record of a statement that is executed in this line, without the variables that it assigns itself.

        `read` is the part of the statement that uses variables; None for all of it.
        """
        scan = ast.Attribute(ast.Name("_c", ast.Load()), "scan", ast.Load())
        used = [*(name for names in self._indices for name in names), *self._indices_in(read or node)]
        names = [name for name in dict.fromkeys(used) if name not in without][:MAX_INDICES]
        codes = [ast.Constant(name.removeprefix("self.")) for name in names]
        source = ast.Tuple([ast.Constant(self._path), ast.Constant(node.lineno), *codes], ast.Load())
        instance: ast.expr = ast.Name("self", ast.Load()) if self._in_instance else ast.Constant(None)
        values = [ast.parse(name, mode="eval").body for name in names]
        return ast.Tuple([scan, source, instance, *values], ast.Load())

    def _indices_in(self, expression: ast.AST) -> list[str]:
        """Return the variables in the indices of an expression or a simple statement, and its pointers, as Python code."""
        found = []
        for node in ast.walk(expression):
            at = _INDEXING.get(_function(node))
            if at is not None and isinstance(node, ast.Call):
                found += list(_variables(node.args[at]))
            elif isinstance(node, ast.Call) and _function(node) == _POINTED:
                pointer = node.args[0]
                found += list(_variables(pointer)) if isinstance(pointer, ast.Name | ast.Attribute) else []
            elif isinstance(node, ast.Name):
                found += self._temporaries.get(node.id, [])
        return found

    def _keep(self, expression: ast.expr) -> tuple[ast.expr, ast.expr]:
        """Return an expression that repeats the value of `expression`, and what replaces `expression` itself."""
        if isinstance(expression, ast.NamedExpr):
            return ast.Name(expression.target.id, ast.Load()), expression
        if isinstance(expression, ast.Constant | ast.Name):
            return _load(expression), expression
        if isinstance(expression, ast.Attribute) and isinstance(expression.value, ast.Name):
            return _load(expression), expression
        self._kept += 1
        name = f"{_KEPT}{self._kept}"
        return ast.Name(name, ast.Load()), ast.NamedExpr(ast.Name(name, ast.Store()), expression)

    def _again(self, target: ast.Attribute) -> ast.expr:
        """Return an expression that repeats the object of which `target` is an attribute."""
        kept, target.value = self._keep(target.value)
        return kept

    def _outputs_in(self, target: ast.expr) -> list[tuple[str, str]]:
        """Return the object and the attribute of each output that `target` assigns."""
        if isinstance(target, ast.Attribute) and isinstance(target.value, ast.Name):
            owner = target.value.id
            return [(owner, target.attr)] if target.attr in self._outputs.get(owner, ()) else []
        return []

    def _lines(
        self, found: list[tuple[str, str]], node: ast.stmt, read: ast.AST, without: Collection[str] = ()
    ) -> list[ast.stmt]:
        """Return the statements that record the assignment of outputs and global variables by `node`, which uses the variables
        in `read`.
        """
        made: list[ast.stmt] = []
        for owner, name in found:
            record, of = self._record(node, without, read), ast.Name(owner, ast.Load())
            place: ast.expr = ast.Constant(node.lineno)
            if owner == GLOBALS:
                place = record
            elif self._with_path:
                place = ast.Tuple([ast.Constant(self._path), place], ast.Load())
            made.append(_at(ast.Assign([ast.Attribute(of, line_of(name), ast.Store())], place), node))
            if owner != GLOBALS and len(record.elts) > RECORD_HEAD:
                made.append(_at(ast.Assign([ast.Attribute(of, indices_of(name), ast.Store())], record), node))
        return made


def _variables(index: ast.expr) -> Iterator[str]:
    """Yield the variables in an index as Python code, such as ``self.v_i``; none of those that are reached by an index."""
    if isinstance(index, ast.Name):
        if index.id.startswith(_VARIABLE):
            yield index.id
    elif isinstance(index, ast.Attribute):
        part: ast.expr = index
        while isinstance(part, ast.Attribute):
            part = part.value
        if isinstance(part, ast.Name) and part.id != "_v":
            yield ast.unparse(index)
    else:
        for inner in ast.iter_child_nodes(index):
            if isinstance(inner, ast.expr):
                yield from _variables(inner)


def _function(node: ast.AST) -> str:
    """Return the name of the function of the run-time library that an expression calls; "" for anything else."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
        return node.func.attr if node.func.value.id == "_v" else ""
    return ""


def _writes_memory(call: ast.Call) -> bool:
    """Return whether an expression calls one of the functions that write memory, such as MEMCPY."""
    return ast.unparse(call.func) in ("_v.copying.copied", "_v.copying.filled")


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Attribute(ast.Name("_v", ast.Load()), name, ast.Load()), list(arguments), [])


def _own(attribute: str, context: ast.expr_context | None = None) -> ast.Attribute:
    return ast.Attribute(ast.Name("self", ast.Load()), attribute, context or ast.Load())


def _is_context(call: ast.Call) -> bool:
    """Return whether an expression calls a function of the running scan, which assigns no array."""
    return isinstance(call.func, ast.Attribute) and isinstance(call.func.value, ast.Name) and call.func.value.id == "_c"


def _no_lines() -> ast.expr:
    return ast.Attribute(ast.Name("_v", ast.Load()), "NO_LINES", ast.Load())


def _is_own(node: ast.Attribute) -> bool:
    return isinstance(node.value, ast.Name) and node.value.id == "self"


def _load(expression: ast.expr) -> ast.expr:
    """Return a copy of an expression that is read."""
    return ast.parse(ast.unparse(expression), mode="eval").body


def _at(statement: ast.stmt, node: ast.stmt) -> ast.stmt:
    """Return a new statement with the line of `node`."""
    for each in ast.walk(statement):
        if isinstance(each, ast.stmt | ast.expr | ast.keyword):
            each.lineno = each.end_lineno = node.lineno
            each.col_offset = each.end_col_offset = 0
    return statement
