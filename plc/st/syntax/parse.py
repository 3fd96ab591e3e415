"""Parse Structured Text to a tree, with lark (LALR). An error has line, column, and the tokens that were expected."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Any

from lark import Lark, Token, UnexpectedCharacters, UnexpectedEOF, UnexpectedToken, v_args
from lark.exceptions import UnexpectedInput, VisitError
from lark.lexer import PatternStr
from lark.tree import Meta

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.sfc import ChartRules, chart_of
from fieldtwin.plc.st.syntax.source import MAX_NAME, blanked, shortened

MAX_EXPECTED = 8
"""How many of the expected tokens an error names."""

_UNSUPPORTED = {
    word: construct
    for construct, words in {
        "classes and methods": (
            "METHOD END_METHOD CLASS END_CLASS EXTENDS THIS SUPER ABSTRACT FINAL PUBLIC PRIVATE PROTECTED INTERNAL VAR_INST"
        ),
        "interfaces": "INTERFACE END_INTERFACE IMPLEMENTS",
        "properties": "PROPERTY END_PROPERTY GET END_GET SET END_SET",
        "namespaces": "NAMESPACE END_NAMESPACE USING",
        "pointers and references": "POINTER REF_TO REFERENCE ^ REF=",
        "VAR_CONFIG and VAR_ACCESS": "VAR_CONFIG VAR_ACCESS",
        "labels and jumps": "JMP",
    }.items()
    for word in words.split()
}
"""The words of constructs that other compilers know, by which an error names the construct."""
_ENDS = re.compile(
    r"""'(?:[^$'\n]|\$.)*'|"(?:[^$"\n]|\$.)*"|\b(?P<end>END_(?:PROGRAM|FUNCTION_BLOCK|FUNCTION|TYPE|CONFIGURATION))\b|\S\s*\Z""",
    re.IGNORECASE,
)
"""The ends of POUs and TYPE blocks, and the end of the text. Strings are skipped."""

_DECLARED = re.compile(r"\b(?:FUNCTION_BLOCK|FUNCTION|TYPE)\s+([A-Za-z_]\w*)", re.IGNORECASE)

_READABLE = {
    "NAME": "a name", "CASE_NAME": "a name", "INTEGER": "a number", "REAL": "a number", "BASED": "a number", "TYPED": "a number",
    "DURATION": "a duration", "DATE": "a date", "TIME_OF_DAY": "a time of day", "DATE_AND_TIME": "a date",
    "STRING_LITERAL": "a string", "WSTRING_LITERAL": "a string", "ENUM_REF": "a name", "VAR_KIND": "VAR", "SEMICOLON": ";",
    "COLON": ":", "COMMA": ",", "DOT": ".", "LPAR": "(", "RPAR": ")", "LSQB": "[", "RSQB": "]", "SIGN": "+ or -",
    "FACTOR": "* or /", "ORDER": "<", "EQUALITY": "=", "POWER": "**", "$END": "the end of the file", "DIRECT": "an address",
    "STRING_TYPE": "STRING", "MESSAGES": "MESSAGES", "QUALIFIER": "RETAIN or CONSTANT",
}  # fmt: skip


def parse(text: str, path: str = "", dialect: Dialect = STANDARD, before: tuple[int, int] = (0, 0)) -> t.SourceUnit:
    """Return the tree of `text`. Raises `FileInvalid` with line and column.

    `before`: for a part of a file, the lines before it, and the columns before it in its first line. Positions in the tree are
    those in the file; an error has its position in the part.
    """
    warnings: list[StWarning] = []
    text = blanked(text, path, dialect, warnings)
    try:
        unit: t.SourceUnit = _Build(path, before).transform(_parser().parse(text, start="start"))
        return replace(unit, warnings=tuple(warnings))
    except UnexpectedInput as e:
        raise _invalid(e, text, path) from e
    except VisitError as e:
        if not isinstance(e.orig_exc, _Bad):
            raise
        raise e.orig_exc.at(path) from e


def parse_expression(text: str, at: t.Pos) -> t.Expr:
    """Return the tree of one expression of a drawing; all its parts are at the element `at`. Raises `FileInvalid`."""
    try:
        text = blanked(text, at.path)
        return _Build(at.path, at=at).transform(_parser().parse(text, start="expression"))  # type: ignore[no-any-return]
    except UnexpectedInput as e:
        error = _invalid(e, text, at.path)
    except VisitError as e:
        if not isinstance(e.orig_exc, _Bad):
            raise
        error = e.orig_exc.at(at.path)
    except FileInvalid as e:
        error = e
    raise FileInvalid(
        f"{at.element}: {shortened(text.strip())}: {error.message}",
        path=at.path, line=at.line, column=at.column, expected=error.expected, got=error.got,
    )  # fmt: skip


def parse_all(text: str, path: str = "", dialect: Dialect = STANDARD) -> t.SourceUnit:
    """Return the tree of `text`. Raises `FileInvalid` for its first error, with the first errors of the other POUs and types.

    A parser cannot go on after an error. So after one, each POU and each TYPE block is parsed alone.
    """
    try:
        return parse(text, path, dialect)
    except FileInvalid as whole:
        try:
            blank = blanked(text, path, dialect)
        except FileInvalid:  # a comment or a literal does not end
            raise whole from None
        found = ErrorCollector()
        for part, line, column in _parts(blank):
            try:
                parse(part, path)
            except FileInvalid as e:
                found.add(_moved(e, line, column))
                if len(found.errors) > FileInvalid.MAX_OTHERS:
                    break
        found.raise_all()
        raise


def parse_parts(
    text: str, path: str = "", dialect: Dialect = STANDARD
) -> Iterator[tuple[t.SourceUnit, tuple[str, ...], FileInvalid | None]]:
    """Parse each POU and TYPE block of `text` alone. Yield its tree; or an empty tree, the names that it declares, and its error.

    Raises `FileInvalid` if a comment or a pragma makes the whole text unusable.
    """
    for part, line, column in _parts(blanked(text, path, dialect)):
        try:
            yield parse(part, path, dialect, (line, column)), (), None
        except FileInvalid as e:
            yield t.SourceUnit(), tuple(found[1] for found in _DECLARED.finditer(part)), _moved(e, line, column)


def _parts(text: str) -> Iterator[tuple[str, int, int]]:
    """Return each POU and TYPE block of a text without comments, the lines before it, and the columns before it in its line."""
    begin = line = line_begin = 0
    for found in _ENDS.finditer(text):
        end = found.end()
        if found["end"] is None and end < len(text):
            continue
        yield text[begin:end], line, begin - line_begin
        line += text.count("\n", begin, end)
        line_begin = max(line_begin, text.rfind("\n", begin, end) + 1)
        begin = end


def _moved(error: FileInvalid, lines: int, columns: int) -> FileInvalid:
    """Return an error in a part of a text with its position in the whole text."""
    return FileInvalid(
        error.message,
        path=error.path,
        line=error.line + lines,
        column=error.column + (columns if error.line == 1 else 0),
        expected=error.expected,
        got=error.got,
        hint=error.hint,
    )


@cache
def _parser() -> Lark:
    grammar = resources.files("fieldtwin.plc.st.syntax").joinpath("grammar.lark").read_text(encoding="utf-8")
    starts = ["start", "expression"]
    return Lark(
        grammar, start=starts, parser="lalr", propagate_positions=True, maybe_placeholders=False, g_regex_flags=re.ASCII
    )


class _Bad(Exception):
    """A token that is well formed but has no valid meaning."""

    def __init__(self, token: Token, message: str) -> None:
        super().__init__(message)
        self.token = token

    def at(self, path: str) -> FileInvalid:
        line, column = self.token.line or 1, self.token.column or 1
        return FileInvalid(str(self), path=path, line=line, column=column, got=shortened(str(self.token)))


@dataclass(frozen=True, slots=True)
class _Task:
    """A TASK of a configuration or resource."""

    name: str


@dataclass(frozen=True, slots=True)
class _InTask:
    """A program of a configuration or resource, and the name of its task, if it states one."""

    instance: t.Instance
    task: Token | None


def _flat(items: Iterable[Any]) -> Iterator[Any]:
    """Yield the items, and in place of a tuple its items."""
    for item in items:
        yield from item if isinstance(item, tuple) else (item,)


def _invalid(e: UnexpectedInput, text: str, path: str) -> FileInvalid:
    if isinstance(e, UnexpectedToken) and e.token.type != "$END":
        got, line, column = str(e.token), e.line, e.column
        names = e.accepts or e.expected
    elif isinstance(e, UnexpectedCharacters):
        got, line, column = e.char, e.line, e.column
        names = e.allowed or set()
    else:  # the end of the text
        before = text.rstrip()
        got, line, column = "the end of the file", before.count("\n") + 1, len(before) - before.rfind("\n")
        names = getattr(e, "accepts", None) or (set() if isinstance(e, UnexpectedEOF) else e.expected)  # type: ignore[attr-defined]
    construct = _unsupported(got, text, line, column)
    if construct:
        return FileInvalid(f"{construct} are not supported", path=path, line=line, column=column, got=shortened(got))
    readable = sorted({_readable(name) for name in names})
    more = f" and {len(readable) - MAX_EXPECTED} more" if len(readable) > MAX_EXPECTED else ""
    return FileInvalid(
        "not Structured Text",
        path=path,
        line=line,
        column=column,
        got=shortened(got if got.isprintable() else repr(got)),
        expected=", ".join(readable[:MAX_EXPECTED]) + more,
    )


def _unsupported(got: str, text: str, line: int, column: int) -> str:
    """Return the construct that the unexpected token `got`, or the word before it, belongs to; "" for an ordinary error."""
    lines = text.split("\n")[:line]
    lines[-1] = lines[-1][: column - 1]
    before = re.search(r"([A-Za-z_]\w*)\s*\Z", "\n".join(lines[-2:]))
    return _UNSUPPORTED.get(got.upper()) or (_UNSUPPORTED.get(before[1].upper(), "") if before else "")


@cache
def _readable(name: str) -> str:
    for terminal in _parser().terminals:
        if terminal.name == name and isinstance(terminal.pattern, PatternStr):
            return str(terminal.pattern.value)
    return _READABLE.get(name, name)


@v_args(meta=True)
class _Build(ChartRules):
    """The transformer that builds the tree bottom up: children are already nodes, tokens are still tokens.

    It is not recursive, so the nesting depth has no limit."""

    def __init__(self, path: str, before: tuple[int, int] = (0, 0), at: t.Pos | None = None) -> None:
        super().__init__()
        self._path = path
        self._lines, self._columns = before
        self._at = at

    def _pos(self, where: Meta | Token) -> t.Pos:
        if self._at is not None:
            return self._at
        line, column = where.line or 1, where.column or 1
        return t.Pos(line + self._lines, column + (self._columns if line == 1 else 0), self._path)

    def NAME(self, token: Token) -> Token:
        if len(token) > MAX_NAME:
            raise _Bad(token, f"a name of more than {MAX_NAME} characters")
        return token

    def start(self, meta: Meta, items: list[Any]) -> t.SourceUnit:
        types = tuple(one for item in items if isinstance(item, list) for one in item)
        return t.SourceUnit(
            types,
            tuple(each for each in _flat(items) if isinstance(each, t.VarBlock)),
            tuple(i for i in items if isinstance(i, t.Pou)),
            instances=tuple(each for each in _flat(items) if isinstance(each, t.Instance)),
        )

    def configuration(self, meta: Meta, items: list[Any]) -> tuple[t.VarBlock | t.Instance, ...]:
        """Return the globals and the programs of a configuration, with those of its resources."""
        tasks = {item.name.lower() for item in items if isinstance(item, _Task)}
        for item in items:
            if isinstance(item, _InTask) and item.task is not None and item.task.lower() not in tasks:
                raise _Bad(item.task, f"a task {str(item.task)!r} is not declared in this configuration or resource")
        parts = [item.instance if isinstance(item, _InTask) else item for item in items]
        return tuple(each for each in _flat(parts) if isinstance(each, t.VarBlock | t.Instance))

    resource = configuration

    def task(self, meta: Meta, items: list[Any]) -> _Task:
        return _Task(str(items[0]))

    def task_value(self, meta: Meta, items: list[Any]) -> None:
        return None

    def instance(self, meta: Meta, items: list[Any]) -> _InTask:
        name, *task, program = items
        return _InTask(t.Instance(self._pos(program), str(name), str(program)), task[0] if task else None)

    def _pou(self, kind: str, meta: Meta, items: list[Any]) -> t.Pou:
        name, *rest = items
        returns = rest.pop(0) if isinstance(rest[0], t.TypeSpec) else None
        body = tuple(i for i in rest[-1] if not isinstance(i, t.Action | t.Step | t.Transition))
        actions = tuple(i for i in rest[-1] if isinstance(i, t.Action))
        return t.Pou(self._pos(name), kind, str(name), returns, tuple(rest[:-1]), body, actions, chart_of(rest[-1]))

    def program(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("PROGRAM", meta, items)

    def function(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("FUNCTION", meta, items)

    def function_block(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("FUNCTION_BLOCK", meta, items)

    # -- declarations

    def global_vars(self, meta: Meta, items: list[Any]) -> t.VarBlock:
        return self.var_block(meta, items)

    def var_block(self, meta: Meta, items: list[Any]) -> t.VarBlock:
        kind, *rest = items
        qualifiers = frozenset(i.upper() for i in rest if isinstance(i, str))
        variables = tuple(v for i in rest if not isinstance(i, str) for v in i)
        return t.VarBlock(self._pos(kind), kind.upper(), qualifiers, variables)

    def qualifier(self, meta: Meta, items: list[Any]) -> str:
        return str(items[0])

    def var_decl(self, meta: Meta, items: list[Any]) -> list[t.VarDecl]:
        names = [i for i in items if isinstance(i, Token)]
        location = next((i[1] for i in items if isinstance(i, tuple) and i[0] == "at"), "")
        spec, initial = _spec(items), _initial(items)
        edge = next((i[1] for i in items if isinstance(i, tuple) and i[0] == "edge"), "")
        return [t.VarDecl(self._pos(n), str(n), spec, initial, location, edge) for n in names]

    def location(self, meta: Meta, items: list[Any]) -> tuple[str, str]:
        return "at", str(items[0])

    def edge(self, meta: Meta, items: list[Any]) -> tuple[str, str]:
        return "edge", str(items[0]).upper()

    def initial(self, meta: Meta, items: list[Any]) -> tuple[str, t.Init]:
        return "initial", items[0]

    def field(self, meta: Meta, items: list[Any]) -> list[t.VarDecl]:
        return self.var_decl(meta, items)

    def type_block(self, meta: Meta, items: list[Any]) -> list[Any]:
        return items

    def struct_decl(self, meta: Meta, items: list[Any]) -> t.StructDecl:
        name, *fields = items
        return t.StructDecl(self._pos(name), str(name), tuple(f for group in fields for f in group))

    def enum_decl(self, meta: Meta, items: list[Any]) -> t.EnumDecl:
        name, *rest = items
        bases = [t.NamedType(self._pos(i), str(i)) for i in rest if isinstance(i, Token)]
        if len(bases) > 1:
            raise _Bad(name, "an enumeration with two types of its values")
        values = tuple(i for i in rest if isinstance(i, tuple) and i[0] != "initial")
        return t.EnumDecl(self._pos(name), str(name), values, _initial(rest), bases[0] if bases else None)

    def enum_value(self, meta: Meta, items: list[Any]) -> tuple[str, int | None]:
        return str(items[0]), items[1] if len(items) > 1 else None

    def signed_integer(self, meta: Meta, items: list[Any]) -> int:
        number = _integer(items[-1])
        return -number if str(items[0]) == "-" else number

    def alias_decl(self, meta: Meta, items: list[Any]) -> t.AliasDecl:
        return t.AliasDecl(self._pos(items[0]), str(items[0]), _spec(items), _initial(items))

    def named_type(self, meta: Meta, items: list[Any]) -> t.NamedType:
        return t.NamedType(self._pos(meta), str(items[0]))

    def subrange_type(self, meta: Meta, items: list[Any]) -> t.SubrangeType:
        return t.SubrangeType(self._pos(meta), str(items[0]), items[1], items[2])

    def string_type(self, meta: Meta, items: list[Any]) -> t.StringType:
        return t.StringType(self._pos(meta), items[0].upper() == "WSTRING", items[1] if len(items) > 1 else None)

    def messages_type(self, meta: Meta, items: list[Any]) -> t.MessagesType:
        sizes = [*items[1:], None, None]
        return t.MessagesType(self._pos(meta), sizes[0], sizes[1])

    def array_type(self, meta: Meta, items: list[Any]) -> t.ArrayType:
        return t.ArrayType(self._pos(meta), tuple(items[:-1]), items[-1])

    def range(self, meta: Meta, items: list[Any]) -> tuple[t.Expr, t.Expr]:
        return items[0], items[1]

    def bound(self, meta: Meta, items: list[Any]) -> t.Expr:
        return items[0]  # type: ignore[no-any-return]

    def init_expression(self, meta: Meta, items: list[Any]) -> t.Expr:
        return items[0]  # type: ignore[no-any-return]

    def init_array(self, meta: Meta, items: list[Any]) -> t.InitArray:
        return t.InitArray(self._pos(meta), tuple(items))

    def one_item(self, meta: Meta, items: list[Any]) -> tuple[int, t.Init]:
        return 1, items[0]

    def repeated_item(self, meta: Meta, items: list[Any]) -> tuple[int, t.Init | None]:
        return _integer(items[0]), items[1] if len(items) > 1 else None

    def init_struct(self, meta: Meta, items: list[Any]) -> t.InitStruct:
        return t.InitStruct(self._pos(meta), tuple(items))

    def member_init(self, meta: Meta, items: list[Any]) -> tuple[str, t.Init]:
        return str(items[0]), items[1]

    # -- statements

    def body(self, meta: Meta, items: list[Any]) -> tuple[t.Statement, ...]:
        return tuple(i for i in items if i is not None)

    pou_body = body

    def action(self, meta: Meta, items: list[Any]) -> t.Action:
        name, body = items
        return t.Action(self._pos(name), str(name), body)

    def empty(self, meta: Meta, items: list[Any]) -> None:
        return None

    def assign(self, meta: Meta, items: list[Any]) -> t.Assign:
        return t.Assign(self._pos(meta), items[0], items[1])

    def call_statement(self, meta: Meta, items: list[Any]) -> t.CallStatement:
        return t.CallStatement(self._pos(meta), items[0])

    def if_statement(self, meta: Meta, items: list[Any]) -> t.If:
        otherwise = items.pop()[1] if len(items) % 2 else ()
        return t.If(self._pos(meta), tuple(zip(items[::2], items[1::2], strict=True)), otherwise)

    def else_part(self, meta: Meta, items: list[Any]) -> tuple[str, tuple[t.Statement, ...]]:
        return "else", items[0]

    def case_statement(self, meta: Meta, items: list[Any]) -> t.Case:
        selector, *rest = items
        has_else = bool(rest) and rest[-1][0] == "else"
        otherwise = rest.pop()[1] if has_else else ()
        return t.Case(self._pos(meta), selector, tuple(rest), otherwise, has_else)

    def case_branch(self, meta: Meta, items: list[Any]) -> tuple[tuple[t.CaseLabel, ...], tuple[t.Statement, ...]]:
        return tuple(items[:-1]), items[-1]

    def case_label(self, meta: Meta, items: list[Any]) -> t.CaseLabel:
        return t.CaseLabel(self._pos(meta), items[0], items[1] if len(items) > 1 else None)

    def next_label(self, meta: Meta, items: list[Any]) -> t.CaseLabel:
        return t.CaseLabel(self._pos(meta), items[0], items[1] if len(items) > 1 else None)

    def case_number(self, meta: Meta, items: list[Any]) -> t.Expr:
        literal = t.Literal(self._pos(meta), items[-1].type, str(items[-1]))
        return t.Unary(self._pos(meta), "-", literal) if str(items[0]) == "-" else literal

    def case_name(self, meta: Meta, items: list[Any]) -> t.Expr:
        first, *members = [name for item in items for name in str(item).split(".")]
        return t.Ref(self._pos(meta), first, tuple(t.Member(self._pos(meta), name) for name in members))

    def case_enum(self, meta: Meta, items: list[Any]) -> t.Expr:
        return t.Literal(self._pos(meta), "ENUM_REF", str(items[0]))

    def for_statement(self, meta: Meta, items: list[Any]) -> t.For:
        variable, first, last, *step, body = items
        return t.For(self._pos(meta), variable, first, last, step[0] if step else None, body)

    def while_statement(self, meta: Meta, items: list[Any]) -> t.While:
        return t.While(self._pos(meta), items[0], items[1])

    def repeat_statement(self, meta: Meta, items: list[Any]) -> t.Repeat:
        return t.Repeat(self._pos(meta), items[0], items[1])

    def exit(self, meta: Meta, items: list[Any]) -> t.Jump:
        return t.Jump(self._pos(meta), "EXIT")

    def continue_(self, meta: Meta, items: list[Any]) -> t.Jump:
        return t.Jump(self._pos(meta), "CONTINUE")

    def return_(self, meta: Meta, items: list[Any]) -> t.Jump:
        return t.Jump(self._pos(meta), "RETURN")

    # -- expressions

    def binary(self, meta: Meta, items: list[Any]) -> t.Binary:
        return t.Binary(self._pos(items[1]), items[1].upper(), items[0], items[2])

    def unary(self, meta: Meta, items: list[Any]) -> t.Unary:
        return t.Unary(self._pos(meta), items[0].upper(), items[1])

    def call(self, meta: Meta, items: list[Any]) -> t.Call:
        return t.Call(self._pos(meta), items[0], tuple(items[1:]))

    def operator(self, meta: Meta, items: list[Any]) -> t.Ref:
        return t.Ref(self._pos(meta), str(items[0]))

    def positional(self, meta: Meta, items: list[Any]) -> t.Argument:
        return t.Argument(self._pos(meta), "", items[0])

    def named(self, meta: Meta, items: list[Any]) -> t.Argument:
        return t.Argument(self._pos(meta), str(items[0]), items[1])

    def output(self, meta: Meta, items: list[Any]) -> t.Argument:
        return t.Argument(self._pos(meta), str(items[-2]), None, items[-1], inverted=len(items) == 3)

    def reference(self, meta: Meta, items: list[Any]) -> t.Ref:
        return t.Ref(self._pos(meta), str(items[0]), tuple(items[1:]))

    def member(self, meta: Meta, items: list[Any]) -> t.Member:
        return t.Member(self._pos(meta), str(items[0]))

    def bit(self, meta: Meta, items: list[Any]) -> t.Bit:
        return t.Bit(self._pos(meta), _integer(items[0]))

    def index(self, meta: Meta, items: list[Any]) -> t.Index:
        return t.Index(self._pos(meta), tuple(items))

    def literal(self, meta: Meta, items: list[Any]) -> t.Literal:
        return t.Literal(self._pos(meta), items[0].type, str(items[0]))


def _spec(items: list[Any]) -> t.TypeSpec:
    return next(i for i in items if isinstance(i, t.TypeSpec))


def _initial(items: list[Any]) -> t.Init | None:
    return next((i[1] for i in items if isinstance(i, tuple) and i[0] == "initial"), None)


def _integer(token: Token) -> int:
    """Return the value of an integer literal: underscores, ``16#``, ``8#``, ``2#``, with or without a type before
    it."""
    *_, base, digits = ["10", *token.replace("_", "").split("#")]
    try:
        return int(digits, int(base))
    except ValueError as e:
        raise _Bad(token, "not a whole number that any type holds") from e


__all__ = ["parse", "parse_all", "parse_parts"]
