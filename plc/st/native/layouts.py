"""The C structures that hold the variables of programs, function blocks and global variables, and where their values are.

The kind of a variable is that of its initial value in the Python class: BOOL is a `bool`, every integer, enumeration, time and
bit string an `int`, REAL and LREAL a `float`. Variables of other kinds have no place in a structure, and statements that use
them stay Python.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fieldtwin.plc.blocks import BLOCKS
from fieldtwin.plc.st.runtime.lines import MEMBER, is_line, line_of

MAX_ELEMENTS = 4096
"""The largest number of elements of an array that is read and written in machine code, because each execution reads all."""
NONE = "INT64_MIN"
"""The number that stands for None: a timer that does not run has no start time."""
_GLOBAL = ("bool", "int", "float", "block")
"""The kinds of global variables that have a place in a structure."""
SIMPLE = ("bool", "int", "float")
"""The kinds of variables without parts."""
ROW = (*SIMPLE, "optional")
"""The kinds of variables that are in the row of a structure."""
STANDARD = "T_"
"""The beginning of the names of the structures of standard function blocks."""


class Unsupported(Exception):
    """A construct that is not translated. Its text names it."""


@dataclass(slots=True)
class Field:
    """A variable in a structure. `kind` is bool, int, float, optional (an int or None), block (also a structure of the source),
    array, blocks (an array of them), line or lines.

    `of` is the structure of a block, or the kind of the elements of an array; `size` their number. A `line` is the record of
    the last assignment of a variable, `lines` those of the elements of an array; `values` is the largest number of values of
    indices in such a record.
    """

    name: str
    kind: str
    of: str = ""
    size: int = 0
    values: int = 0

    @property
    def c_name(self) -> str:
        return f"f_{self.name}"


@dataclass(slots=True)
class Layout:
    """The structure of a class: its fields by the names of the attributes, and the Python code of its methods."""

    name: str
    fields: dict[str, Field] = field(default_factory=dict)
    slots: tuple[str, ...] = ()
    """The slots of the Python class in the order of their memory; empty for the class of the global variables, which has none."""
    methods: dict[str, ast.FunctionDef] = field(default_factory=dict)
    constants: Mapping[str, object] = field(default_factory=dict)

    def row(self) -> list[Field | None]:
        """Return the variables without parts in the order of their memory; None for another slot between them."""
        if not self.slots:
            return [one for one in self.fields.values() if one.kind in ROW]
        found = [self.fields.get(name) for name in self.slots]
        kept = [one if one is not None and one.kind in ROW else None for one in found]
        used = [n for n, one in enumerate(kept) if one is not None]
        return kept[used[0] : used[-1] + 1] if used else []

    def parts(self) -> list[Field]:
        """Return the blocks and arrays, and after them the records that have values."""
        found = [one for one in self.fields.values() if one.kind in ("block", "blocks", "array")]
        return found + [
            one for one in self.fields.values() if one.kind == "lines" or (one.kind == "line" and one.values)
        ]

    def lines(self) -> list[Field]:
        """Return the records without values."""
        return [one for one in self.fields.values() if one.kind == "line" and not one.values]


def slots_of(node: ast.ClassDef) -> list[str]:
    """Return the attributes that the methods of the class of a PROGRAM set, which become its slots."""
    set_in = [each for each in ast.walk(node) if isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store)]
    own = [each.attr for each in set_in if isinstance(each.value, ast.Name) and each.value.id == "self"]
    return list(dict.fromkeys(own))


class Layouts:
    """The structures of the classes in the Python code `body` of a unit."""

    def __init__(self, body: list[ast.stmt]) -> None:
        self._classes = {node.name: node for node in body if isinstance(node, ast.ClassDef)}
        self._made: dict[str, Layout] = {}
        self._waiting: set[str] = set()
        self.functions = {node.name: node for node in body if isinstance(node, ast.FunctionDef)}
        self.globals = self._globals(body)

    def of(self, name: str) -> Layout:
        """Return the structure of a class. Raises `Unsupported` for a class that is unknown, or contains itself."""
        if name not in self._made:
            if name in self._waiting:
                raise Unsupported(f"{name} contains itself")
            self._waiting.add(name)
            self._made[name] = self._standard(name) if name.startswith(STANDARD) else self._of_class(name)
            self._waiting.discard(name)
        return self._made[name]

    def _of_class(self, name: str) -> Layout:
        node = self._classes.get(name)
        if node is None:
            raise Unsupported(f"class {name}")
        made = Layout(name, slots=_slots(node))
        made.methods = {each.name: each for each in node.body if isinstance(each, ast.FunctionDef)}
        for target, value in _assigned(made.methods.get("__init__")):
            found = self._field(target, value)
            if found is not None:
                made.fields[target] = found
                if target.startswith(MEMBER) and found.kind in SIMPLE:
                    made.fields[line_of(target)] = Field(line_of(target), "line")
        for target in _lines_in(node, "self"):
            made.fields.setdefault(target, Field(target, "line"))
        return made

    def _field(self, name: str, value: ast.expr) -> Field | None:
        if is_line(name):
            if ast.unparse(value) == "_v.ElementLines()":
                return Field(name, "lines")
            return Field(name, "line")
        kind = _kind(value)
        if kind:
            return Field(name, kind)
        of = self._created(value)
        if of:
            return Field(name, "block", of)
        return self._array(name, value)

    def _array(self, name: str, value: ast.expr) -> Field | None:
        """Return the field of a new array of one dimension; None for other expressions."""
        if isinstance(value, ast.ListComp) and isinstance(value.generators[0].iter, ast.Call):
            counts, kinds = value.generators[0].iter.args, {_kind(value.elt) or self._created(value.elt)}
            size = counts[0].value if len(counts) == 1 and isinstance(counts[0], ast.Constant) else 0
        elif isinstance(value, ast.List):
            size, kinds = len(value.elts), {_kind(each) or self._created(each) for each in value.elts}
        else:
            return None
        kind = kinds.pop() if len(kinds) == 1 else ""
        if not kind or not isinstance(size, int) or not 0 < size <= MAX_ELEMENTS:
            return None
        return Field(name, "array" if kind in SIMPLE else "blocks", kind, size)

    def _created(self, value: ast.expr) -> str:
        """Return the structure of the object that an expression creates; empty if it cannot be one."""
        if isinstance(value, ast.Call) and ast.unparse(value.func) == "_v.with_members":
            value = value.args[0]
        return (
            self._class_of(value.func) if isinstance(value, ast.Call) and not value.args and not value.keywords else ""
        )

    def _class_of(self, function: ast.expr) -> str:
        """Return the structure of the class that a call creates; empty if it cannot be one."""
        if isinstance(function, ast.Subscript) and isinstance(function.slice, ast.Constant):
            name = STANDARD + str(function.slice.value)
        elif isinstance(function, ast.Name) and function.id.startswith(("B_", "S_")):
            name = function.id
        else:
            return ""
        try:
            return self.of(name).name
        except Unsupported:
            return ""

    def _standard(self, name: str) -> Layout:
        """Return the structure of a standard function block, from an instance and the source of its class."""
        block = BLOCKS[name.removeprefix(STANDARD)]
        made, new = Layout(name), block()
        constants = {}
        for base in reversed(block.__mro__):
            constants.update({key: value for key, value in vars(base).items() if isinstance(value, int)})
            own = sorted(vars(base).get("__slots__", ()))
            made.slots += tuple(own)
            for slot in own:
                value = getattr(new, slot)
                kind = "optional" if value is None else _kind(ast.Constant(value))
                if not kind:
                    raise Unsupported(f"function block {name.removeprefix(STANDARD)}")
                made.fields[slot] = Field(slot, kind)
        made.constants = constants
        source = textwrap.dedent(inspect.getsource(block.execute))
        made.methods["execute"] = next(each for each in ast.parse(source).body if isinstance(each, ast.FunctionDef))
        return made

    def _globals(self, body: list[ast.stmt]) -> Layout:
        made = Layout("globals")
        for node in body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Attribute):
                target = node.targets[0]
                found = self._field(target.attr, node.value) if ast.unparse(target.value) == "_G" else None
                if found is not None and found.kind in _GLOBAL:
                    made.fields[target.attr] = found
        for name in _lines_in(ast.Module(body, []), "_G"):
            made.fields[name] = Field(name, "line")
        return made


def _slots(node: ast.ClassDef) -> tuple[str, ...]:
    """Return the slots of a class in the order of their memory: CPython sorts the slots of one class by their names."""
    for each in node.body:
        if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "__slots__":
            return tuple(sorted(ast.literal_eval(each.value)))
    return tuple(sorted(slots_of(node)))


def _assigned(init: ast.FunctionDef | None) -> Iterator[tuple[str, ast.expr]]:
    """Yield the attributes that a class sets first, each with its value."""
    for node in init.body if init is not None else ():
        target = node.targets[0] if isinstance(node, ast.Assign) else None
        if isinstance(target, ast.Attribute) and isinstance(node, ast.Assign) and ast.unparse(target.value) == "self":
            yield target.attr, node.value


def _lines_in(node: ast.AST, owner: str) -> Iterator[str]:
    """Yield the attributes of `owner` with records that statements in `node` assign."""
    for each in ast.walk(node):
        if isinstance(each, ast.Assign) and isinstance(each.targets[0], ast.Attribute):
            target = each.targets[0]
            if is_line(target.attr) and isinstance(target.value, ast.Name) and target.value.id == owner:
                yield target.attr


def _kind(value: ast.expr) -> str:
    """Return the kind of a constant; empty for other expressions."""
    if isinstance(value, ast.UnaryOp) and isinstance(value.op, ast.USub):
        value = value.operand
    if isinstance(value, ast.Constant) and type(value.value) in (bool, int, float):
        return type(value.value).__name__
    return ""
