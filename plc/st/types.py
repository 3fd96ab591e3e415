"""The data types of Structured Text, their implicit conversions, and the representation of their values.

Representation at run time: BOOL as bool; integers, bit strings, enumerated values as int; REAL as a float rounded to 32 bits,
LREAL as float; TIME and LTIME as int of ns, TIME_OF_DAY ns since midnight, DATE and DATE_AND_TIME ns since 1970-01-01; strings
as str (a CHAR is one character; those of a STRING are 0 to 255, one byte each); arrays as lists; structures and function blocks
as objects. Source: IEC 61131-3:2013, 6.4 (types) and 6.6.1.6 (implicit conversions).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import prod
from typing import TypeGuard

from fieldtwin.plc.blocks import FunctionBlock

DEFAULT_STRING = 80
DAY_NS = 86_400_000_000_000
MAX_STRING = 65_535
MAX_ELEMENTS = 1_000_000
"""The limit for an array over all its dimensions, and for all elements of a structure, a block or a program."""
MAX_NESTED = 32
"""How deep structures, arrays and blocks may be nested."""
GIVEN = ("VAR_INPUT", "VAR_IN_OUT", "VAR_OUTPUT")
"""The kinds of variables for which a call may have an argument."""


@dataclass(frozen=True, slots=True)
class Elementary:
    """An elementary type. `kind` is int, bits, real, bool, duration, date, tod, dt, char; `low`..`high` for integers and bit
    strings."""

    name: str
    kind: str
    bits: int
    low: int = 0
    high: int = 0

    def __str__(self) -> str:
        return self.name


def _integers() -> dict[str, Elementary]:
    found = {}
    for bits, name in ((8, "SINT"), (16, "INT"), (32, "DINT"), (64, "LINT")):
        found[name] = Elementary(name, "int", bits, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        found["U" + name] = Elementary("U" + name, "int", bits, 0, 2**bits - 1)
    for bits, name in ((8, "BYTE"), (16, "WORD"), (32, "DWORD"), (64, "LWORD")):
        found[name] = Elementary(name, "bits", bits, 0, 2**bits - 1)
    return found


BOOL = Elementary("BOOL", "bool", 1, 0, 1)
BIT = Elementary("BIT", "bool", 1, 0, 1)
"""A BOOL of CODESYS that is a member of a structure, and has one bit of its memory."""
REAL = Elementary("REAL", "real", 32)
LREAL = Elementary("LREAL", "real", 64)
TIME = Elementary("TIME", "duration", 64, -(2**63), 2**63 - 1)
LTIME = Elementary("LTIME", "duration", 64, -(2**63), 2**63 - 1)
DATE = Elementary("DATE", "date", 64, -(2**63), 2**63 - 1)
TOD = Elementary("TIME_OF_DAY", "tod", 64, -(2**63), 2**63 - 1)
CHAR = Elementary("CHAR", "char", 8)
WCHAR = Elementary("WCHAR", "char", 16)
DT = Elementary("DATE_AND_TIME", "dt", 64, -(2**63), 2**63 - 1)

ELEMENTARY: dict[str, Elementary] = _integers() | {
    "BOOL": BOOL, "REAL": REAL, "LREAL": LREAL, "TIME": TIME, "LTIME": LTIME, "DATE": DATE, "LDATE": DATE,
    "TOD": TOD, "TIME_OF_DAY": TOD, "LTOD": TOD, "LTIME_OF_DAY": TOD, "DT": DT, "DATE_AND_TIME": DT, "LDT": DT,
    "LDATE_AND_TIME": DT, "CHAR": CHAR, "WCHAR": WCHAR,
}  # fmt: skip
INT, DINT, LINT, ULINT = (ELEMENTARY[name] for name in ("INT", "DINT", "LINT", "ULINT"))


@dataclass(frozen=True, slots=True)
class AnyInt:
    """An integer constant without a declared type: it fits every type that can hold its value."""

    value: int

    def __str__(self) -> str:
        return f"{self.value}"


@dataclass(frozen=True, slots=True)
class AnyReal:
    """A real constant, or a choice between several, without a declared type."""

    value: float

    def __str__(self) -> str:
        return f"{self.value}"


@dataclass(frozen=True, slots=True)
class Subrange:
    """An integer type with narrower limits, checked at each assignment."""

    base: Elementary
    low: int
    high: int

    def __str__(self) -> str:
        return f"{self.base}({self.low}..{self.high})"


@dataclass(frozen=True, slots=True)
class String:
    """A string of at most `length` characters; a longer string is cut when it is assigned."""

    length: int = DEFAULT_STRING
    wide: bool = False

    def __str__(self) -> str:
        return f"{'W' if self.wide else ''}STRING[{self.length}]"


@dataclass(frozen=True, slots=True)
class Enum:
    """An enumeration. `bits` is the size of the type of its values, for SIZEOF."""

    name: str
    values: Mapping[str, int] = field(hash=False)
    initial: int = 0
    bits: int = 16

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Array:
    """An array. `ranges`: first and last index of each dimension."""

    ranges: tuple[tuple[int, int], ...]
    of: Type

    def __str__(self) -> str:
        return f"ARRAY[{', '.join(f'{low}..{high}' for low, high in self.ranges)}] OF {self.of}"


@dataclass(frozen=True, slots=True)
class OpenArray:
    """An array of variable length, a parameter whose limits are those of the argument (IEC 61131-3:2013, 6.5.3)."""

    dimensions: int
    of: Type

    def __str__(self) -> str:
        return f"ARRAY[{', '.join('*' * self.dimensions)}] OF {self.of}"


@dataclass(frozen=True, slots=True)
class Struct:
    """A structure or union. `fields` maps the name of each field, in lower case, to the name as declared and the type."""

    name: str
    fields: Mapping[str, tuple[str, Type]] = field(hash=False)
    elements: int = 1
    nested: int = 1
    refers: bool = False
    """Whether it contains a reference to an instance."""
    union: bool = False
    """Whether its fields have the same memory (UNION of the dialects of CODESYS)."""
    packed: int = 8
    """The largest multiple of bytes at which a field begins in memory (``pack_mode`` of CODESYS)."""

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Block:
    """A function block: a block of the standard, whose class is `standard`, or a block or class of the user. The mappings give
    for each name in lower case the name as declared and the type. All other names are in lower case."""

    name: str
    inputs: Mapping[str, tuple[str, Type]] = field(hash=False)
    outputs: Mapping[str, tuple[str, Type]] = field(hash=False)
    order: tuple[str, ...]
    """The names of all parameters as declared, in the order of the declaration, which positional arguments have."""
    in_outs: Mapping[str, tuple[str, Type]] = field(hash=False, default_factory=dict)
    standard: type[FunctionBlock] | None = None
    elements: int = 8
    nested: int = 1
    actions: frozenset[str] = frozenset()
    publics: Mapping[str, tuple[str, Type]] = field(hash=False, default_factory=dict)
    """The variables in VAR PUBLIC."""
    hidden: frozenset[str] = frozenset()
    """The variables that only the block itself can use."""
    bases: frozenset[str] = frozenset()
    """The blocks and classes that this one extends, directly or through others."""
    interfaces: frozenset[str] = frozenset()
    """The interfaces that this one implements, also through its bases."""
    refers: bool = False
    """Whether it contains a reference to an instance."""
    is_class: bool = False
    """Whether it is a class, which has no body and cannot be called."""
    abstract: bool = False
    created: bool = False
    """Whether it has a method FB_init, which is called when an instance is created."""
    aliases: Mapping[str, str] = field(hash=False, default_factory=dict)
    """Further names of inputs, in lower case, each with the name as declared."""

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Interface:
    """An interface. A variable of this type refers to an instance, or is NULL. `bases` are the interfaces that it extends,
    directly or through others, in lower case."""

    name: str
    bases: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Named:
    """A structure or block to which a reference refers, by its name in lower case, because it may contain that reference."""

    key: str
    name: str

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Pointer:
    """A reference to a variable of type `of`. `word` is REF_TO, POINTER TO or REFERENCE TO (without ``^`` at each use)."""

    word: str
    of: Type | Named

    def __str__(self) -> str:
        return f"{self.word} {self.of}"


@dataclass(frozen=True, slots=True)
class Null:
    """The type of NULL, the reference to no variable."""

    def __str__(self) -> str:
        return "NULL"


NULL = Null()


@dataclass(frozen=True, slots=True)
class Nothing:
    """The result of a function that has none (IEC 61131-3, 6.6.2.2). It fits no type."""

    def __str__(self) -> str:
        return "no result"


NOTHING = Nothing()


@dataclass(frozen=True, slots=True)
class MessagesIn:
    """A program's input of messages (VAR_INPUT name : MESSAGES): the messages that are new in this scan."""

    def __str__(self) -> str:
        return "MESSAGES"


@dataclass(frozen=True, slots=True)
class MessagesOut:
    """A program's output of messages (VAR_OUTPUT name : MESSAGES[max_bytes, depth])."""

    max_bytes: int
    depth: int

    def __str__(self) -> str:
        return "MESSAGES"


Type = (
    Elementary | AnyInt | AnyReal | Subrange | String | Enum | Array | OpenArray | Struct | Block | Pointer | Null | MessagesIn
    | MessagesOut | Nothing | Interface
)  # fmt: skip


def plain(kind: Type) -> Type:
    """Return the type that a value has after it is read: for a subrange, its base type."""
    return kind.base if isinstance(kind, Subrange) else kind


def elements(kind: Type) -> int:
    """Return the size of a variable of this type in elements: 1 for a number, plus 1 for each 64 characters of a string."""
    if isinstance(kind, Array):
        return prod(high - low + 1 for low, high in kind.ranges) * elements(kind.of)
    if isinstance(kind, String):
        return 1 + kind.length // 64
    return kind.elements if isinstance(kind, Struct | Block) else 1


def nested(kind: Type) -> int:
    """Return the nesting depth of structures, arrays and blocks in a type."""
    if isinstance(kind, Array):
        return len(kind.ranges) + nested(kind.of)
    return kind.nested if isinstance(kind, Struct | Block) else 0


def is_kind(kind: Type, *names: str) -> bool:
    """Return whether the type is elementary and of one of these kinds. Constants without a type count as int or real."""
    kind = plain(kind)
    if isinstance(kind, AnyInt):
        return "int" in names
    if isinstance(kind, AnyReal):
        return "real" in names
    return isinstance(kind, Elementary) and kind.kind in names


def fits(source: Type, target: Type) -> bool:
    """Return whether a value of `source` may be assigned to `target` without an explicit conversion function."""
    source, sink = plain(source), plain(target)
    if isinstance(source, AnyInt):
        if isinstance(target, Subrange):
            return target.low <= source.value <= target.high
        return isinstance(sink, Elementary) and (
            sink.kind == "real" or (sink.kind in ("int", "bits", "bool") and sink.low <= source.value <= sink.high)
        )
    if isinstance(source, AnyReal):
        return is_kind(sink, "real")
    if isinstance(source, Elementary) and isinstance(sink, Elementary):
        return _widens(source, sink)
    if isinstance(source, Null) and isinstance(sink, Pointer):
        return True
    if isinstance(source, Elementary) and source.kind == "char" and isinstance(sink, String):
        return sink.wide == (source == WCHAR)
    if isinstance(source, String) and isinstance(sink, String):
        return source.wide == sink.wide
    if isinstance(sink, Interface) and isinstance(source, Block | Interface | Null):
        return isinstance(source, Null) or source == sink or sink.name.lower() in _implemented(source)
    return source == sink


def _implemented(kind: Block | Interface) -> frozenset[str]:
    return kind.interfaces if isinstance(kind, Block) else kind.bases


def holds_interface(kind: Type) -> bool:
    """Return whether a value of this type is, or contains, a reference to an instance."""
    if isinstance(kind, Array):
        return holds_interface(kind.of)
    return isinstance(kind, Interface) or (isinstance(kind, Struct | Block) and kind.refers)


def holds_union(kind: Type) -> bool:
    """Return whether a variable of this type is, or contains, a union."""
    if isinstance(kind, Array):
        return holds_union(kind.of)
    return isinstance(kind, Struct) and (kind.union or any(holds_union(of) for _, of in kind.fields.values()))


def _widens(source: Elementary, target: Elementary) -> bool:
    if source.kind == target.kind:
        if source.kind == "int":
            return target.low <= source.low and source.high <= target.high
        if source.kind == "char":
            return source == target
        return source.bits <= target.bits
    if source.kind == "int" and target.kind == "real":
        return source.bits <= (16 if target.bits == 32 else 32)
    return source.kind == "bool" and target.kind == "bits"


def is_rounded(source: Elementary, target: Elementary) -> bool:
    """Return whether a value of `source` as a `target`, which is REAL or LREAL, has to be rounded to 32 bits."""
    return target.bits == 32 and (source.kind == "real" or source.bits > 16)


def of_bits(kind: Type | None) -> TypeGuard[Elementary]:
    """Return whether the type is a bit string type or BOOL."""
    return isinstance(kind, Elementary) and kind.kind in ("bits", "bool")


def takes_bits(target: Type | None, source: AnyInt) -> TypeGuard[Elementary]:
    """Return whether an integer constant becomes a bit string (or a BOOL) if the context demands `target`."""
    return of_bits(target) and fits(source, target)


def common(a: Type, b: Type) -> Type | None:
    """Return the type to which both operands convert implicitly, or None if no such type exists."""
    a, b = plain(a), plain(b)
    if isinstance(a, AnyInt) and isinstance(b, AnyInt):
        return AnyInt(0)
    if isinstance(a, AnyInt | AnyReal) and isinstance(b, AnyInt | AnyReal):
        return AnyReal(0.0)
    for constant, other in ((a, b), (b, a)):
        if isinstance(constant, AnyReal) and isinstance(other, Elementary) and other.kind == "int":
            return REAL if fits(other, REAL) else LREAL if fits(other, LREAL) else None
    if fits(a, b):
        return b
    return a if fits(b, a) else None


def standard_blocks(blocks: Mapping[str, type[FunctionBlock]]) -> dict[str, Block]:
    """Return the function blocks of the standard library as types, by their name in lower case."""

    def members(declared: Mapping[str, str]) -> dict[str, tuple[str, Type]]:
        return {name.lower(): (name, ELEMENTARY[kind]) for name, kind in declared.items()}

    return {
        name.lower(): Block(
            name, members(block.inputs), members(block.outputs), (*block.inputs, *block.outputs), standard=block
        )
        for name, block in blocks.items()
    }
