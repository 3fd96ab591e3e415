"""The names of a unit and their meaning during compilation, the errors that compiling raises, and the code that it
writes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NoReturn, Protocol

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning, WarningCollector
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.source import shortened
from fieldtwin.plc.st.syntax.tree import Argument, Expr, Missing, Pos, Ref

COMPARISONS = {"=": "==", "<>": "!=", "<": "<", ">": ">", "<=": "<=", ">=": ">="}
"""Operators of Structured Text and their Python form."""


@dataclass(frozen=True, slots=True)
class Symbol:
    """A variable: its Python expression, and its value if it is a constant. `reference`: for a VAR_IN_OUT of an
    elementary type, the expression of the object that refers to the caller's variable
    (`fieldtwin.plc.st.runtime.references`)."""

    name: str
    type: ty.Type
    code: str
    writable: bool = True
    constant: Any = None
    reference: str = ""
    is_input: bool = False
    refused: str = ""
    """Why the variable is not visible in the scope; empty for one that is."""

    @property
    def is_constant(self) -> bool:
        """Return whether it is declared CONSTANT, whether or not its value is written at each use."""
        return self.constant is not None or not (self.writable or self.is_input)


@dataclass(frozen=True, slots=True)
class Value:
    """A compiled expression. `place` is true if it is a variable or a part of one, `is_input` if that is an input of the POU.
    `constant` is its value if it is known.

    `reference`: Python expression of an object that refers to the variable; empty for a function's own variable. `view`: for an
    array to which a POINTER TO points, its Python expression; that array may have another size than the pointer states.
    """

    code: str
    type: ty.Type
    constant: Any = None
    place: bool = False
    writable: bool = False
    reference: str = ""
    is_input: bool = False
    view: str = ""


@dataclass(frozen=True, slots=True)
class Parameter:
    name: str
    type: ty.Type
    initial: str
    """Python expression of the initial value."""


@dataclass(frozen=True, slots=True)
class Signature:
    """The signature of a user's function. The compiled function returns a tuple if it has outputs."""

    name: str
    returns: ty.Type
    inputs: tuple[Parameter, ...]
    in_outs: tuple[Parameter, ...]
    outputs: tuple[Parameter, ...]
    order: tuple[str, ...]
    """The names of all parameters in the order of the declaration, which positional arguments have."""

    def names(self) -> set[str]:
        """Return the names of all parameters in lower case."""
        return {p.name.lower() for p in (*self.inputs, *self.in_outs, *self.outputs)}


@dataclass(frozen=True, slots=True)
class Method:
    """A method, or the GET or SET of a property: `kind` is METHOD, GET or SET.

    `owner` is the name, as declared, of the class or interface that declares it. `access` is PUBLIC, PROTECTED, PRIVATE or
    INTERNAL. `abstract` is true for one without a body.
    """

    signature: Signature
    kind: str
    owner: str
    access: str
    abstract: bool
    final: bool
    pos: Pos

    @property
    def attribute(self) -> str:
        """Return the name of the method in the Python class."""
        return attribute_of(self.kind, self.signature.name)

    @property
    def key(self) -> str:
        """Return the name by which calls of the method are noted."""
        of = "" if self.kind == "METHOD" else f".{self.kind.lower()}"
        return f"{self.owner.lower()}.{self.signature.name.lower()}{of}"

    def __str__(self) -> str:
        of = "" if self.kind == "METHOD" else f"{self.kind} of "
        return f"{of}{self.owner}.{self.signature.name}"


def attribute_of(kind: str, name: str) -> str:
    """Return the Python name of a method (``m_``), or of the GET (``g_``) or SET (``s_``) of a property."""
    return f"{kind[0].lower()}_{name.lower()}"


@dataclass(slots=True)
class Class:
    """A function block, class, program or interface with all its methods and actions, also those that it inherits.

    `key` is its name in lower case. `methods` are by their Python names; `actions` map names to the POUs that declare them,
    all in lower case. `ancestors` are the classes that it extends, directly or through others, the nearest first.
    """

    name: str
    key: str
    kind: str
    ancestors: tuple[Class, ...] = ()
    methods: dict[str, Method] = field(default_factory=dict)
    actions: dict[str, str] = field(default_factory=dict)
    descendants: list[Class] = field(default_factory=list)
    variables: dict[str, Symbol] = field(default_factory=dict)
    """The variables of an instance, as code inside the class sees them."""
    type: ty.Type | None = None

    def of(self, kind: str, name: str) -> Method | None:
        """Return the method, GET or SET with this name."""
        return self.methods.get(attribute_of(kind, name))


def identifier(name: str) -> str:
    """Return a name as a part of Python names; a full name has a middle dot between its parts, which Python allows."""
    return name.lower().replace(".", "\u00b7")


def simple_default(kind: ty.Type) -> str | None:
    """Return the initial value of a type without parts as Python code; None for other types."""
    if isinstance(kind, ty.Subrange):
        return str(min(max(0, kind.low), kind.high))
    if isinstance(kind, ty.Elementary):
        if kind.kind == "char":
            return repr("\0")
        return "False" if kind.kind == "bool" else "0.0" if kind.kind == "real" else "0"
    if isinstance(kind, ty.String):
        return "''"
    if isinstance(kind, ty.Interface | ty.Pointer):
        return "None"
    return str(kind.initial) if isinstance(kind, ty.Enum) else None


def default_value(kind: ty.Type) -> str:
    """Return the Python expression of a new variable with the initial value of its type."""
    simple = simple_default(kind)
    if simple is not None:
        return simple
    if isinstance(kind, ty.Struct):
        return f"S_{identifier(kind.name)}()"
    if isinstance(kind, ty.Block):
        code = f"_blocks[{kind.name!r}]()" if kind.standard else f"B_{identifier(kind.name)}()"
        return f"{code}.created()" if kind.created else code
    if isinstance(kind, ty.Array):
        return repeated(default_value(kind.of), kind)
    return "0" if isinstance(kind, ty.AnyInt | ty.AnyReal) else "None"


def repeated(code: str, kind: ty.Array) -> str:
    """Return the Python expression of a new array whose elements have the value `code`."""
    for low, high in reversed(kind.ranges):
        code = f"[{code} for _ in range({high - low + 1})]"
    return code


def open_outputs(outputs: Sequence[Parameter]) -> list[Parameter]:
    """Return the outputs of variable length, whose limits the caller passes as arguments after the inputs and VAR_IN_OUT."""
    return [p for p in outputs if isinstance(p.type, ty.OpenArray)]


def by_reference(kind: ty.Type) -> bool:
    """Return whether a VAR_IN_OUT of this type is passed as the object itself; other types need an object that refers
    to them."""
    return isinstance(kind, ty.Array | ty.OpenArray | ty.Struct | ty.Block)


@dataclass
class Environment:
    """All declarations of a unit, by names in lower case, and the errors that were found in it so far."""

    dialect: Dialect = STANDARD
    warnings: WarningCollector = field(default_factory=WarningCollector)
    errors: ErrorCollector = field(default_factory=ErrorCollector)
    faulty: set[str] = field(default_factory=set)
    """The names of the unit whose declaration has an error, so that their use is not a second error."""
    faulty_here: set[str] = field(default_factory=set)
    """The same for the POU that is being compiled, and the names in it that are not declared at all."""
    incomplete: frozenset[str] = frozenset()
    """The structures and POUs, in lower case, that lack inherited members because of an error in an EXTENDS."""
    incomplete_here: bool = False
    """Whether the POU that is being compiled is one of them."""
    types: dict[str, ty.Type] = field(default_factory=dict)
    type_initials: dict[str, str] = field(default_factory=dict)
    functions: dict[str, Signature] = field(default_factory=dict)
    classes: dict[str, Class] = field(default_factory=dict)
    """The function blocks, classes, programs and interfaces with methods, or that extend or implement others."""
    globals: dict[str, Symbol] = field(default_factory=dict)
    lists: dict[str, dict[str, Symbol]] = field(default_factory=dict)
    """The variables of each global list."""
    ambiguous: dict[str, list[str]] = field(default_factory=dict)
    """The qualified names of variables that several global lists declare under one name."""
    enum_values: dict[str, list[tuple[ty.Enum, int]]] = field(default_factory=dict)
    missing: dict[str, Missing] = field(default_factory=dict)
    """The declarations that were not imported, because a part of them is not supported."""
    inner: Mapping[str, Mapping[str, tuple[str, ty.Type]]] = field(default_factory=dict)
    """By block in lower case: variables that only the expressions of a debugger may select from outside of the block."""
    symbols: dict[str, dict[str, Symbol]] = field(default_factory=dict)
    """By POU: its variables; by method with its POU before it: all variables that it sees."""
    recorded: dict[int, tuple[ty.Type, ...]] = field(default_factory=dict)
    """By number of an assertion: the types of the values that it shows."""
    probed: dict[int, ty.Type] = field(default_factory=dict)
    """By number of a probe with a value: the type of the value."""
    calls: dict[str, dict[str, Pos]] = field(default_factory=dict)
    """By POU: the POUs that it calls or contains, with the first position of each."""

    def error(self, pos: Pos, message: str, *, expected: str = "", got: str = "", hint: str = "") -> FileInvalid:
        if pos.element:
            message = f"{pos.element}: {message}"
        return invalid(pos, message, expected, shortened(got), hint)

    @contextmanager
    def declaring(self, name: str, faulty: set[str]) -> Iterator[None]:
        """Collect the errors in the declaration of `name`, add the name to `faulty`, and continue after the block."""
        try:
            yield
        except FileInvalid as e:
            faulty.add(name.lower())
            self.collected(e)

    def collected(self, error: FileInvalid) -> None:
        """Add an error to those that were found. Raises them all if they are more than one message shows."""
        self.errors.add(error)
        if len(self.errors.errors) > FileInvalid.MAX_OTHERS:
            self.errors.raise_all()

    def accepts(self, warning: str, pos: Pos, message: str) -> bool:
        """Return whether the dialect accepts the construct with the id `warning`. If so, keep the warning."""
        if warning not in self.dialect.accepts:
            return False
        self.warnings.add(StWarning(warning, message, pos.path, pos.line, pos.column))
        return True

    def declare_global(self, symbol: Symbol, of_list: str, *, only_qualified: bool) -> None:
        """Add a global variable under its name, and under its qualified name if it belongs to a list."""
        key = symbol.name.lower()
        if of_list:
            self.lists.setdefault(of_list.lower(), {})[key] = symbol
        if only_qualified:
            return
        before = self.globals.get(key)
        if before is not None and before.code != symbol.code:
            lists = [name for name, variables in self.lists.items() if key in variables]
            self.ambiguous[key] = [f"{name}.{symbol.name}" for name in lists]
        self.globals[key] = symbol

    def fail(self, pos: Pos, message: str, *, expected: str = "", got: str = "", hint: str = "") -> NoReturn:
        raise self.error(pos, message, expected=expected, got=got, hint=hint)

    def target(self, kind: ty.Pointer, pos: Pos) -> ty.Type:
        """Return the type of the variables to which references of a type refer."""
        if not isinstance(kind.of, ty.Named):
            return kind.of
        found = self.types.get(kind.of.key)
        return found if found is not None else self.unknown(pos, "a type", kind.of.name, list(self.types))

    def refuse_missing(self, key: str, pos: Pos) -> None:
        """Raise `FileInvalid` if the declaration `key`, a name in lower case, was not imported, with the reason."""
        if key in self.missing:
            self.fail(pos, str(self.missing[key]))

    def unknown(self, pos: Pos, what: str, name: str, known: list[str], hint: str = "") -> NoReturn:
        """Raise the error of a name that is not declared. `hint` is the advice if none of the `known` names is similar."""
        if name.lower() in self.faulty | self.faulty_here or (self.incomplete_here and what != "a type"):
            raise self.following(name, pos)
        self.faulty_here.add(name.lower())
        self.fail(pos, f"{what} {name!r} is not declared", hint=did_you_mean(name, known) or hint)

    def following(self, name: str, pos: Pos) -> FollowingError:
        """Return the error of the use of `name`, whose declaration has an error. It is not reported."""
        return FollowingError(f"{name} is declared with an error", path=pos.path, line=pos.line, column=pos.column)

    def of_library(self, name: str) -> str:
        """Return the advice for an unknown name before a dot, which may be the name of a library; "" in other dialects."""
        if not self.dialect.vendor:
            return ""
        return f"if {name} is a library, name its folder under libraries: in the system file, or with --library DIR"


class Compiling(Protocol):
    """The compiler of expressions (`expressions.Expressions`), as standard functions, operators and references use it."""

    env: Environment
    symbols: dict[str, Symbol]
    out: CodeWriter
    only_constants: bool
    program_inputs: set[str]
    own: Class | None
    pou: str
    wanted: ty.Type | None

    def value(self, expr: Expr, wanted: ty.Type | None = None) -> Value: ...

    def declared(self, *exprs: Expr) -> ty.Type | None: ...

    def of_context(self, kind: ty.Type) -> bool: ...

    def flat(self, value: Value, pos: Pos) -> Value: ...

    def earlier(self, value: Value, mark: int, pos: Pos) -> Value: ...

    def typed(self, value: Value, pos: Pos) -> Value: ...

    def known(self, expr: Expr, result: float) -> Value: ...

    def coerced(self, value: Value, target: ty.Type, pos: Pos, what: str = "") -> str: ...

    def condition(self, expr: Expr, what: str) -> str: ...

    def type_of(self, ref: Ref) -> ty.Type | None: ...

    def take(self, argument: Argument, value: Value) -> None: ...


def wrapped(code: str, kind: ty.Elementary) -> str:
    """Return `code` reduced to the width of `kind`."""
    if kind.kind == "real":
        return f"_v.real({code})" if kind.bits == 32 else f"({code})"
    if kind.low < 0:
        return f"(({code} + {-kind.low} & {kind.high - kind.low}) - {-kind.low})"
    return f"({code} & {kind.high})"


class CodeWriter:
    """The Python code being written: its lines, each with its position in the source (None: that of the line before)."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, Pos | None]] = []
        self._depth = 0
        self._temporaries = 0

    def line(self, code: str, pos: Pos | None = None) -> None:
        self.lines.append(("    " * self._depth + code, pos))

    @contextmanager
    def block(self, head: str, pos: Pos | None = None) -> Iterator[None]:
        """Write `head` and an indented body, ``pass`` if nothing is written into it."""
        self.line(head, pos)
        self._depth += 1
        before = len(self.lines)
        try:
            yield
            if len(self.lines) == before:
                self.line("pass", pos)
        finally:
            self._depth -= 1

    def step(self, pos: Pos | None = None) -> None:
        """Count one loop iteration or call against the limit of the scan (`fieldtwin.plc.st.resource.MAX_STEPS`)."""
        self.line("_c.left -= 1", pos)
        self.line("if _c.left < 0: _c.too_long()", pos)

    @property
    def depth(self) -> int:
        """Return the number of blocks that enclose the next line."""
        return self._depth

    def since(self, mark: int) -> list[tuple[str, Pos | None]]:
        """Remove and return the lines after the first `mark` lines, without their present indentation."""
        taken = [(code[4 * self._depth :], pos) for code, pos in self.lines[mark:]]
        del self.lines[mark:]
        return taken

    def again(self, lines: list[tuple[str, Pos | None]]) -> None:
        """Write lines that `since` returned, with the present indentation."""
        self.lines += [("    " * self._depth + code, pos) for code, pos in lines]

    def temporary(self) -> str:
        self._temporaries += 1
        return f"_{self._temporaries}"
