"""The content of a Structured Text file as a tree: frozen nodes with their position. The meaning of names is not
resolved here."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from fieldtwin.plc.st.dialects import StWarning


@dataclass(frozen=True, slots=True)
class Pos:
    """Line and column, both from 1, of a file; `path` is empty if the text is not from a file. `element` names the element of
    a drawing, such as "localId 3 of Main"."""

    line: int
    column: int
    path: str = ""
    element: str = ""


# -- types ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class NamedType:
    """A type by its name. `arguments` are those of the method FB_init of the instances: one list for all, or one for each."""

    pos: Pos
    name: str
    arguments: tuple[tuple[Argument, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class SubrangeType:
    pos: Pos
    name: str
    low: Expr
    high: Expr


@dataclass(frozen=True, slots=True)
class StringType:
    pos: Pos
    wide: bool
    length: Expr | None


@dataclass(frozen=True, slots=True)
class MessagesType:
    """The type ``MESSAGES[bytes, depth]``: the size of the longest message in bytes, and the number of messages that may wait."""

    pos: Pos
    max_bytes: Expr | None
    depth: Expr | None


@dataclass(frozen=True, slots=True)
class ArrayType:
    """An array. `ranges` are the limits of each dimension; an array of variable length, ``ARRAY[*]``, has `open` dimensions."""

    pos: Pos
    ranges: tuple[tuple[Expr, Expr], ...]
    of: TypeSpec
    open: int = 0


@dataclass(frozen=True, slots=True)
class PointerType:
    """A type of references to variables: `word` is REF_TO, POINTER or REFERENCE."""

    pos: Pos
    word: str
    of: TypeSpec


@dataclass(frozen=True, slots=True)
class EnumType:
    """An enumeration without a name, in the declaration of a variable; as in `EnumDecl`."""

    pos: Pos
    values: tuple[tuple[str, int | Expr | None], ...]
    base: NamedType | None = None


TypeSpec = EnumType | NamedType | SubrangeType | StringType | MessagesType | ArrayType | PointerType


@dataclass(frozen=True, slots=True)
class InitArray:
    """An initial array. `items`: the count and the value of each item (None: the type's own initial value).

    Only the dialects of CODESYS have one that is not `bracketed`.
    """

    pos: Pos
    items: tuple[tuple[int, Init | None], ...]
    bracketed: bool = True


@dataclass(frozen=True, slots=True)
class InitStruct:
    pos: Pos
    members: tuple[tuple[str, Init], ...]


@dataclass(frozen=True, slots=True)
class VarDecl:
    """One declared name; `location` is the direct address after AT, `edge` is R_EDGE or F_EDGE, if any."""

    pos: Pos
    name: str
    type: TypeSpec
    initial: Init | None
    location: str = ""
    edge: str = ""


@dataclass(frozen=True, slots=True)
class Within:
    """Where a declaration stands: its namespace, such as ``Plant.Drives``, and the namespaces after USING."""

    namespace: str = ""
    using: tuple[NamedType, ...] = ()


@dataclass(frozen=True, slots=True)
class StructDecl:
    """A structure or a union. `extends` is the name after EXTENDS, in the dialects of CODESYS, if any.

    `packed` is the largest multiple of bytes at which a field begins in memory.
    """

    pos: Pos
    name: str
    fields: tuple[VarDecl, ...]
    within: Within = Within()
    extends: tuple[NamedType, ...] = ()
    union: bool = False
    packed: int = 8


@dataclass(frozen=True, slots=True)
class EnumDecl:
    """An enumeration. `values`: names with their stated number, if any; also an expression in the dialects of CODESYS.
    `base`: the type of the values, if it is stated.
    """

    pos: Pos
    name: str
    values: tuple[tuple[str, int | Expr | None], ...]
    initial: Init | None
    base: NamedType | None = None
    within: Within = Within()


@dataclass(frozen=True, slots=True)
class AliasDecl:
    pos: Pos
    name: str
    type: TypeSpec
    initial: Init | None
    within: Within = Within()


TypeDecl = StructDecl | EnumDecl | AliasDecl


@dataclass(frozen=True, slots=True)
class VarBlock:
    """A block of variables. `kind` (VAR, VAR_INPUT, ..., VAR_GLOBAL) and `qualifiers` (RETAIN, PUBLIC, ...) are in capitals.

    `list` is the name of the global list to which a VAR_GLOBAL belongs, if the dialect has such lists. If
    `only_qualified` is true, its variables are known only as ``list.variable``. A VAR_GLOBAL in a NAMESPACE is a list with the
    name of the `namespace`.
    """

    pos: Pos
    kind: str
    qualifiers: frozenset[str]
    variables: tuple[VarDecl, ...]
    list: str = ""
    only_qualified: bool = False
    namespace: str = ""


class Graphic:
    """A body in LD or FBD as its file has it, for drawings. It is not a node, so walks and changes of the tree skip it."""

    __slots__ = ("body",)

    def __init__(self, body: Any) -> None:
        self.body = body
        """The element ``<LD>`` or ``<FBD>`` of the PLCopen XML file."""


@dataclass(frozen=True, slots=True)
class Action:
    """An action of a PROGRAM or FUNCTION_BLOCK: statements, or a chart, with a name that use the variables of the POU."""

    pos: Pos
    name: str
    body: tuple[Statement, ...]
    chart: Chart | None = None
    graphic: Graphic | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True)
class Association:
    """An action of a step with its qualifier in capitals.

    `arguments` are the expressions after the qualifier: the time, if the qualifier has one, and the indicator variables.
    """

    pos: Pos
    action: str
    qualifier: str
    arguments: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Step:
    pos: Pos
    name: str
    initial: bool
    associations: tuple[Association, ...]


@dataclass(frozen=True, slots=True)
class Transition:
    """A transition between steps. `sources` and `targets` are names; `priority` is None if it is not stated.

    The statements in `body` assign the condition to the name of the transition, and `condition` reads it.
    """

    pos: Pos
    name: str
    priority: int | None
    sources: tuple[str, ...]
    targets: tuple[str, ...]
    condition: Expr
    probe: Probe | None = None
    body: tuple[Statement, ...] = ()


@dataclass(frozen=True, slots=True)
class Chart:
    """A sequential function chart, the body of a PROGRAM or FUNCTION_BLOCK, or of its action (IEC 61131-3, 6.7).

    `before` are the statements of the blocks that are drawn next to the chart. Each scan executes them before the transitions.
    """

    steps: tuple[Step, ...]
    transitions: tuple[Transition, ...]
    before: tuple[Statement, ...] = ()


@dataclass(frozen=True, slots=True)
class Pou:
    """A program organization unit, a class or an interface: `kind` is PROGRAM, FUNCTION, FUNCTION_BLOCK, CLASS or INTERFACE.

    A METHOD, and the GET or SET of a property, is the same node in the `methods` of its owner. `returns` is the type of the
    result; None without a result. `modifiers` are in capitals: the access (PUBLIC, ...), FINAL, ABSTRACT and OVERRIDE.
    """

    pos: Pos
    kind: str
    name: str
    returns: TypeSpec | None
    blocks: tuple[VarBlock, ...]
    body: tuple[Statement, ...]
    actions: tuple[Action, ...] = ()
    chart: Chart | None = None
    methods: tuple[Pou, ...] = ()
    extends: tuple[NamedType, ...] = ()
    implements: tuple[NamedType, ...] = ()
    modifiers: frozenset[str] = frozenset()
    within: Within = Within()
    graphic: Graphic | None = field(default=None, compare=False)


METHODS = ("METHOD", "GET", "SET")
"""The kinds of a `Pou` that belongs to another one."""


@dataclass(frozen=True, slots=True)
class Test:
    """A unit test (``TEST 'name' ... END_TEST``), which `fieldtwin.plc.st.unit_tests` runs. A program ignores it."""

    pos: Pos
    name: str
    blocks: tuple[VarBlock, ...]
    body: tuple[Statement, ...]
    within: Within = Within()


@dataclass(frozen=True, slots=True)
class Missing:
    """A declaration that was not imported, because a part of it is not supported. `kind` is program, function, function block,
    action or type; the `name` of an action has the name of its POU before it, with a dot."""

    pos: Pos
    kind: str
    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.reason} ({self.pos.path}:{self.pos.line})"


@dataclass(frozen=True, slots=True)
class Task:
    """A TASK of a resource ("" for a configuration without one). `values` has INTERVAL, PRIORITY and SINGLE, in capitals."""

    pos: Pos
    name: str
    values: tuple[tuple[str, Expr], ...]
    resource: str = ""


@dataclass(frozen=True, slots=True)
class Instance:
    """A program that a CONFIGURATION or RESOURCE runs: `name` is the instance, `program` its type, `task` that of its task, or
    "". `arguments` connect its variables with global variables.
    """

    pos: Pos
    name: str
    program: str
    task: str = ""
    arguments: tuple[Argument, ...] = ()
    resource: str = ""


@dataclass(frozen=True, slots=True)
class ConfiguredVariable:
    """A variable in VAR_CONFIG: the address of a variable that is declared at ``%I*`` or similar, or its initial value.

    `path` is that of the source, and `target` the one that the compiler uses, in lower case; "" before it is known.
    """

    pos: Pos
    path: tuple[str, ...]
    location: str
    type: TypeSpec
    initial: Init | None
    target: str = ""


@dataclass(frozen=True, slots=True)
class SourceUnit:
    """All declarations of one file, and those that were not imported."""

    types: tuple[TypeDecl, ...] = ()
    globals: tuple[VarBlock, ...] = ()
    pous: tuple[Pou, ...] = ()
    warnings: tuple[StWarning, ...] = ()
    missing: tuple[Missing, ...] = ()
    instances: tuple[Instance, ...] = ()
    tests: tuple[Test, ...] = ()
    tasks: tuple[Task, ...] = ()
    configured: tuple[ConfiguredVariable, ...] = ()


# -- expressions --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Literal:
    """A literal. `kind` is the kind of its token (INTEGER, REAL, BASED, TYPED, DURATION...), `text` its text as written."""

    pos: Pos
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Member:
    pos: Pos
    name: str


@dataclass(frozen=True, slots=True)
class Bit:
    """The part `number` of a bit string: a bit, or with a `size` of 8, 16, 32 or 64 bits a BYTE, WORD, DWORD or LWORD."""

    pos: Pos
    number: int
    size: int = 1


@dataclass(frozen=True, slots=True)
class Index:
    pos: Pos
    indices: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Deref:
    """The variable to which a reference refers: ``^``."""

    pos: Pos


Selector = Member | Bit | Index | Deref


@dataclass(frozen=True, slots=True)
class Ref:
    """A reference to a variable or to a part of it. In the dialects of CODESYS, `name` may be ``THIS^`` or ``SUPER^``.

    A part of the result of a call, such as ``f(x).member``, has the call in `of` and an empty `name`.
    """

    pos: Pos
    name: str
    selectors: tuple[Selector, ...] = ()
    of: Call | None = None

    def without_last(self) -> Ref:
        """Return the reference without its last selector."""
        return replace(self, selectors=self.selectors[:-1])


@dataclass(frozen=True, slots=True)
class Argument:
    """An argument: positional (`name` empty), ``name := value``, or ``name => target`` (`target` set, `inverted` by
    NOT)."""

    pos: Pos
    name: str
    value: Expr | None
    target: Ref | None = None
    inverted: bool = False


@dataclass(frozen=True, slots=True)
class Call:
    """A call. `empty` is the place of the first argument without a value or variable (``f(IN := )``), which CODESYS allows;
    `arguments` has only the others."""

    pos: Pos
    ref: Ref
    arguments: tuple[Argument, ...] = ()
    empty: Pos | None = None


@dataclass(frozen=True, slots=True)
class Binary:
    pos: Pos
    op: str
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Unary:
    pos: Pos
    op: str
    operand: Expr


Expr = Literal | Ref | Call | Binary | Unary
Init = Literal | Ref | Call | Binary | Unary | InitArray | InitStruct

CHAINED = "a := b := value"
"""The word of an assignment that passes on the value of the one before it."""

# -- statements ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Assign:
    """``target := value``. `word` is ``S=`` or ``R=`` in the statement that CODESYS writes with it, whose condition is
    around the assignment, and `CHAINED` for an assignment that passes on the value of the one before it; else "".
    """

    pos: Pos
    target: Ref
    value: Expr
    word: str = ""


@dataclass(frozen=True, slots=True)
class Refer:
    """``target REF= value``: from now on the reference `target` refers to the variable `value`."""

    pos: Pos
    target: Ref
    value: Expr


@dataclass(frozen=True, slots=True)
class Attempt:
    """``target ?= value``: an assignment of a reference that gives NULL if the types do not match."""

    pos: Pos
    target: Ref
    value: Expr


@dataclass(frozen=True, slots=True)
class CallStatement:
    pos: Pos
    call: Call


@dataclass(frozen=True, slots=True)
class If:
    pos: Pos
    branches: tuple[tuple[Expr, tuple[Statement, ...]], ...]
    otherwise: tuple[Statement, ...] = ()


@dataclass(frozen=True, slots=True)
class CaseLabel:
    """One value, or a range: each end is a literal or the name of an enumerated value."""

    pos: Pos
    low: Expr
    high: Expr | None


@dataclass(frozen=True, slots=True)
class Case:
    """A CASE. `has_else`: it has an ELSE, also one without a statement."""

    pos: Pos
    selector: Expr
    branches: tuple[tuple[tuple[CaseLabel, ...], tuple[Statement, ...]], ...]
    otherwise: tuple[Statement, ...] = ()
    has_else: bool = False


@dataclass(frozen=True, slots=True)
class For:
    pos: Pos
    variable: Ref
    first: Expr
    last: Expr
    step: Expr | None
    body: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class While:
    pos: Pos
    condition: Expr
    body: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class Repeat:
    pos: Pos
    body: tuple[Statement, ...]
    until: Expr


@dataclass(frozen=True, slots=True)
class Jump:
    """EXIT, CONTINUE, RETURN, or a JMP to a label of the `Networks` around it."""

    pos: Pos
    word: str
    label: str = ""


@dataclass(frozen=True, slots=True)
class Network:
    """The statements of a drawn body from its `labels` to the next one. The first part of a body may have no label."""

    labels: tuple[str, ...]
    body: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class Networks:
    """A drawn body with jumps. They lead to the parts with their labels, from where the parts are executed in their order."""

    pos: Pos
    parts: tuple[Network, ...]

    @property
    def body(self) -> tuple[Statement, ...]:
        """Return the statements of all parts."""
        return tuple(statement for part in self.parts for statement in part.body)


@dataclass(frozen=True, slots=True)
class Hold:
    """A value in a network that later statements of the same body read by `name`, such as the state of a contact.

    If `boolean` is not empty, the value has to be a BOOL, and `boolean` names it in errors. A value with `enabled` is computed
    only while that is true; otherwise it is the initial value of its type.
    """

    pos: Pos
    name: str
    value: Expr
    boolean: str = ""
    enabled: Expr | None = None


@dataclass(frozen=True, slots=True)
class Assertion:
    """An assertion of a unit test. `number` identifies it in the unit; `shown` are the values that a failure shows.

    An assertion of a cyclic test has the number of the test (`of_test`), because it does not count after the end of that test.
    Without a `condition` it compares two arrays, the first two values, element by element; a third value is the tolerance.
    """

    pos: Pos
    number: int
    condition: Expr | None
    shown: tuple[Expr, ...]
    of_test: int = 0


@dataclass(frozen=True, slots=True)
class Finished:
    """The end of a cyclic unit test, whose number is `test`."""

    pos: Pos
    test: int


@dataclass(frozen=True, slots=True)
class Ordered:
    """The statements of the cyclic unit test with the number `test`, executed after the ordered tests before it have ended."""

    pos: Pos
    test: int
    body: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class Advance:
    """An advance of the time of a unit test by a TIME."""

    pos: Pos
    by: Expr


@dataclass(frozen=True, slots=True)
class Probe:
    """A place whose execution is recorded for coverage. `number` identifies it in the unit. `value`, if any, is recorded too."""

    pos: Pos
    number: int
    value: Expr | None = None


Statement = (
    Assertion | Finished | Ordered | Advance | Probe | Hold | Assign | Refer | Attempt | CallStatement
    | If | Case | For | While | Repeat | Jump | Networks
)  # fmt: skip
