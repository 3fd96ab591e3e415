"""Reads the values of a decision's variables from a running program, and follows what it read: global variables, outputs of
function blocks, elements of arrays and members of structures, also through VAR_IN_OUT and pointers.

So `fieldtwin plc why` can show which statement gave a tag its value, also inside the function blocks that the program uses, and
what decided that it was executed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import msgspec

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.pous.programs import CompiledProgram
from fieldtwin.plc.st.compiler.scope import identifier
from fieldtwin.plc.st.decisions.access import Access, Accesses, Found, NotFollowed
from fieldtwin.plc.st.decisions.statements import Decision, Decisions, Read
from fieldtwin.plc.st.inspection import Inspection, elements, literal
from fieldtwin.plc.st.resource import Resource
from fieldtwin.plc.st.runtime.lines import RECORD_HEAD, SOURCE, Record
from fieldtwin.plc.st.runtime.references import Element, MemberReference, Whole
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import reference, text_of

MAX_DEPTH = 8
"""How deep instances inside instances, and elements in the statements of elements, are followed."""
MAX_INSIDE = 8
"""The largest number of statements that are recorded after that of a program."""
MAX_NOTES = 4
"""The largest number of reasons why variables of one statement are not followed."""
MAX_INSTANCES = 1000
"""The largest number of instances and structures among which the path of an instance is looked for."""


_UNKNOWN: Any = object()


class DecisionReader:
    """Reads the variables of a decision in the POU `pou` from a running program. `hidden` are variables in lower case that are
    not wanted.
    """

    def __init__(
        self,
        unit: CompiledUnit,
        pou: str,
        variables: Sequence[tuple[str, ty.Type]],
        decisions: Decisions,
        hidden: frozenset[str] = frozenset(),
    ) -> None:
        self.pou = pou.lower()
        self.path = next((one.path for one in unit.programs if one.name.lower() == self.pou), "")
        self._variables = tuple(variables)
        self._inspection = Inspection(unit, variables)
        self._unit, self._decisions, self._hidden = unit, decisions, hidden
        self._accesses = Accesses(self._inspection, unit, self.pou)
        self._in_outs = frozenset(self._accesses.visible(self.pou)) - {name.lower() for name, _ in variables}
        self._plans: dict[tuple[Any, str], _Plan | None] = {}
        """The decisions that were read, by the source of their records and the assigned variable."""
        self._blocks: dict[str, DecisionReader] = {}
        """The readers of function blocks, and of other programs, by their names in lower case; those of a block are shared by
        all its instances.
        """
        self._programs = {f"P_{identifier(one.name)}": one for one in unit.programs}
        """The programs of the unit by the names of their Python classes."""
        self._where: Where | None = None
        """That of the decision that was read last, because most decisions of a scan have the same one."""

    def read(self, body: Any, resource: Resource, name: str, record: Record) -> Decided | None:
        """Return the decision that assigned the variable `name`, with the present values; None if its statement is not known.

        `record` is that of the assignment. The variables that the decision uses are followed to the statements that assigned
        them. `resource` has the global variables of the program.
        """
        if not record:
            return None
        reader, instance = self._writer(body, record)
        where = self._where
        if where is None or where.root is not body or where.writer is not instance or where.resource is not resource:
            where = self._where = Where(self, body, resource, instance)
        plan = reader.plan(record[1], name)
        if plan is None:
            return None
        if not plan.followed:
            values = plan.values_of(instance) if instance is not None else ()
            return Decided(plan, values, record[RECORD_HEAD:], plan.notes, where)
        inside: list[Inside] = []
        found, further = reader._values(plan, record, where)
        self._follow(where, further, found, 0, inside, set())
        return msgspec.structs.replace(found, inside=tuple(inside)) if inside else found

    def read_own(self, body: Any, resource: Resource, name: str, source: tuple[str, int]) -> Decided | None:
        """Do the same for an assignment by a statement of the program itself, without indices, in the line `source`.

        Nearly all changes of a scan are such assignments, and `read` takes three times as long.
        """
        known = self._plans.get((source, name), _UNKNOWN)
        if known is _UNKNOWN or (known is not None and known.followed):
            return self.read(body, resource, name, (None, source, body))
        if known is None:
            return None
        return Decided(known, known.values_of(body), (), known.notes, Where(self, body, resource, body))

    def _writer(self, body: Any, record: Record) -> tuple[DecisionReader, Any]:
        """Return the reader and the object of the POU that made a record in this program; no object for a function."""
        instance = record[2]
        if instance is body or instance is None:
            return self, instance
        program = self._programs.get(type(instance).__name__)
        return (self.block(instance.kinds[0]) if program is None else self._program(program)), instance

    def _program(self, program: CompiledProgram) -> DecisionReader:
        """Return the reader of a program as others see it, which also shows its inputs."""
        return self._other(program.declared_name.lower(), program.own)

    def _values(self, plan: _Plan, record: Record, where: Where) -> tuple[Decided, list[tuple[Access, Found]]]:
        """Return a decision with its values, and the variables that are followed."""
        values: list[Any] = []
        notes = list(plan.notes)
        if where.writer is not None:
            values += plan.values_of(where.writer)
        elif plan.of_function:
            notes.append(("", "the variables of a function are not kept after the call"))
        further: list[tuple[Access, Found]] = []
        for access in plan.followed:
            try:
                found = access.find(where.writer, where.resource.globals, record)
            except NotFollowed as e:
                notes.append((reference(access.ref), str(e)))
                continue
            values.append(found.value)
            further.append((access, found))
        ended = len(plan.followed) != len(further)
        kept = tuple([access for access, _ in further]) if ended else plan.followed
        return Decided(plan, tuple(values), record[RECORD_HEAD:], tuple(notes), where, kept), further

    def _follow(
        self,
        where: Where,
        further: Sequence[tuple[Access, Found]],
        of: Decided,
        depth: int,
        inside: list[Inside],
        seen: set[Any],
    ) -> None:
        """Add the statements that assigned the variables of a decision to `inside`, each before those of the variables that it
        uses.
        """
        for access, found in further if depth < MAX_DEPTH else ():
            key = (id(found.owner), found.attribute, found.at)
            record = found.record(self._path_of(found.owner)) if key not in seen and len(inside) < MAX_INSIDE else ()
            if not record:
                continue
            seen.add(key)
            reader, writer = self._writer(where.root, record)
            plan = reader.plan(record[1], found.attribute.partition("_")[2], reference(access.ref))
            if plan is None:
                inside.append(Inside(of, access, found.owner, record, None))
                continue
            decided, more = reader._values(plan, record, where._replace(writer=writer))
            inside.append(Inside(of, access, found.owner, record, decided))
            self._follow(where, more, decided, depth + 1, inside, seen)

    def _path_of(self, owner: Any) -> str:
        """Return the file of the program whose object `owner` is; that of this program for any other object."""
        program = self._programs.get(type(owner).__name__)
        return program.path if program is not None else self.path

    def block(self, name: str) -> DecisionReader:
        """Return the reader of a function block."""
        return self._other(name, self._unit.blocks[name])

    def _other(self, name: str, variables: Sequence[tuple[str, ty.Type]]) -> DecisionReader:
        if name not in self._blocks:
            made = DecisionReader(self._unit, name, variables, self._decisions)
            made._blocks = self._blocks
            self._blocks[name] = made
        return self._blocks[name]

    def name_of(self, pou: str) -> str:
        """Return the name of a POU as it is declared."""
        return self._unit.names.get(pou, pou)

    def instance_path(self, where: Where, instance: Any) -> str:
        """Return the path of an instance, a structure or an array in the program, in its global variables, or in another program
        with the same global variables; empty for the program itself and for an unknown one.
        """
        if instance is where.root:
            return ""
        path, _, program = self._placed(where, instance)
        return f"{path}{' of ' if path and program else ''}{program}"

    def variable_path(self, where: Where, held: Any) -> str:
        """Return the path of the variable to which a reference refers; empty for an unknown one."""
        owner = held.v if isinstance(held, Whole) else getattr(held, "owner", None)
        path, kind, program = self._placed(where, owner)
        if isinstance(held, Element):
            if not isinstance(kind, ty.Array) or len(kind.ranges) > 1:
                return ""
            path += f"[{held.at + kind.ranges[0][0]}]"
        elif isinstance(held, MemberReference):
            names = {attribute: name for name, attribute in self._attributes(where, owner, kind)}
            if held.name not in names:
                return ""
            path = f"{path}{'.' if path else ''}{names[held.name]}"
        return f"{path} of {program}" if path and program else path

    def _attributes(self, where: Where, owner: Any, kind: ty.Type | None) -> Iterator[tuple[str, str]]:
        """Yield the variables that `owner` has, a part of a program or the object of one, with their attributes."""
        if owner is where.resource.globals:
            yield from ((v.name if "." not in key else key, v.attribute) for key, v in self._unit.globals.items())
        elif isinstance(kind, ty.Struct):
            yield from ((name, f"m_{key}") for key, (name, _) in kind.fields.items())
        else:
            program = self._programs.get(type(owner).__name__)
            declared = self._inspection.variables_of(kind) if isinstance(kind, ty.Block) else ()
            yield from ((name, f"v_{name.lower()}") for name, _ in (program.own if program is not None else declared))

    def _placed(self, where: Where, part: Any) -> _Place:
        """Return the place of an instance, a structure or an array."""
        shared = where.resource.globals
        of_globals = [
            (v.name if "." not in key else key, v.kind, getattr(shared, v.attribute, None))
            for key, v in self._unit.globals.items()
        ]
        for waiting in (self._of_body(where.root), of_globals):
            if (found := self._place_in(waiting, part)) is not None:
                return found
        for body, called in zip(where.resource.bodies, where.resource.names, strict=True):
            program = self._programs.get(type(body).__name__)
            if program is not None and body is not where.root:
                name = f"program {called or program.name}"
                if body is part:
                    return "", None, name
                found = self._place_in(self._program(program)._of_body(body), part)
                if found is not None:
                    return found[0], found[1], name
        return "", None, ""

    def _of_body(self, body: Any) -> list[tuple[str, ty.Type, Any]]:
        return [(name, kind, getattr(body, f"v_{name.lower()}", None)) for name, kind in self._variables]

    def _place_in(self, waiting: list[tuple[str, ty.Type, Any]], part: Any) -> _Place | None:
        """Return the place of `part` in variables, given with their paths and types."""
        for _ in range(MAX_INSTANCES):
            if not waiting:
                break
            path, kind, value = waiting.pop(0)
            if value is part:
                return path, kind, ""
            if isinstance(kind, ty.Array) and isinstance(kind.of, ty.Array | ty.Struct | ty.Block):
                waiting += [(f"{path}{at}", kind.of, each) for at, each in elements(kind, value)]
            elif isinstance(kind, ty.Struct) or (isinstance(kind, ty.Block) and kind.standard is None):
                waiting += [(f"{path}.{name}", of, each) for name, of, each in self._inspection.members(kind, value)]
        return None

    def plan(self, source: tuple[Any, ...], *names: str) -> _Plan | None:
        """Return how the decision of a record with this `source` is read, which assigned a variable with one of `names`."""
        key = (source, names[0])
        if key not in self._plans:
            path, line = source[:SOURCE]
            words = [word for name in names for word in re.findall(r"[A-Za-z_]\w*", name)]
            decision = self._decisions.at(path, line, words)
            self._plans[key] = self._made(decision, source) if decision is not None else None
        return self._plans[key]

    def _made(self, decision: Decision, source: tuple[Any, ...]) -> _Plan:
        fixed: list[tuple[str, str, ty.Type]] = []
        followed: list[Access] = []
        notes: list[tuple[str, str]] = []
        target = decision.statement.target if isinstance(decision.statement, t.Assign) else None
        refs = [*(read.ref for read in decision.reads), *([target] if target is not None else [])]
        pou, known = decision.pou, self._accesses
        indices = dict(pair for ref in refs for pair in known.index_names(ref, pou, source))
        reads = [*decision.reads, *([Read(decision.source)] if decision.source is not None else [])]
        for read in reads:
            name = read.ref.name.lower()
            if name in self._hidden or not known.is_variable(read.ref, pou) or read.path in indices:
                continue
            kept = known.is_own(read.ref, pou) and name not in self._in_outs
            found = self._inspection.attribute(read.path) if kept else None
            if found is not None and isinstance(found[1], ty.Pointer) and found[1].word == "REFERENCE TO":
                found = None
            if found is not None and not _is_followed(found[0]):
                if read.ref is not decision.source:
                    fixed.append((read.path, *found))
                continue
            try:
                if read.doubtful:
                    raise NotFollowed(f"{read.doubtful} may have changed between the condition and this line")
                followed.append(known.access(read.ref, pou, source))
            except NotFollowed as e:
                if read.ref.selectors or known.is_in_out(read.ref, pou):
                    notes.append((read.path, str(e)))
        variables = tuple([(path, kind) for path, _, kind in fixed])
        codes = [code for _, code, _ in fixed]
        of_function = pou.partition(".")[0] != self.pou
        return _Plan(decision, variables, reader(codes), tuple(followed), tuple(notes), indices, of_function)


def _is_followed(code: str) -> bool:
    """Return whether the statement is looked for that assigned the variable with this Python code: a member, or an output of a
    block.
    """
    owner, _, attribute = code.rpartition(".")
    return bool(owner) and attribute.startswith(("m_", "v_"))


def reader(attributes: list[str]) -> _Reader:
    """Return a function that reads these attributes of an object, with one call for all of them."""
    if len(attributes) > 1:
        return attrgetter(*attributes)
    each = [attrgetter(attribute) for attribute in attributes]
    return lambda body: tuple([read(body) for read in each])


_Variables = tuple[tuple[str, ty.Type], ...]
"""The paths and types of variables."""
_Reader = Callable[[Any], tuple[Any, ...]]
"""A function that returns the values of some attributes of an object."""


_Place = tuple[str, ty.Type | None, str]
"""The path and the type of a part of a program, and the program if it is another one; empty for an unknown part."""


class Where(NamedTuple):
    """Where a statement was executed: the `reader` of the program for whose tag it is shown, the object `root` of this program,
    the resource with its global variables, and the object `writer` of the POU with the statement, None for a function.
    """

    reader: DecisionReader
    root: Any
    resource: Resource
    writer: Any


@dataclass(frozen=True, slots=True)
class _Plan:
    """A decision, with the variables that one call of `values_of` reads, and those that are found and followed in each case."""

    decision: Decision
    variables: _Variables
    values_of: _Reader
    followed: tuple[Access, ...]
    notes: tuple[tuple[str, str], ...]
    """The variables that are not shown, each with the reason."""
    indices: dict[str, int]
    """The variables in indices, with the places of their values after the first part of a record."""
    of_function: bool
    """Whether the statement is in a function, whose variables are not kept."""

    def index_texts(self, values: Sequence[Any]) -> dict[str, str]:
        """Return the variables in indices with their values."""
        return {name: str(values[at]) for name, at in self.indices.items() if at < len(values)}


class Decided(msgspec.Struct, frozen=True, gc=False):
    """An executed decision, with the values of its variables after the scan, and the statements that assigned the outputs of
    function blocks, elements and members that it used, each before those that it used itself.
    """

    plan: _Plan
    values: tuple[Any, ...]
    indices: tuple[Any, ...]
    """The values of variables in indices when the statement was executed."""
    notes: tuple[tuple[str, str], ...]
    where: Where
    followed: tuple[Access, ...] = ()
    inside: tuple[Inside, ...] = ()

    @property
    def decision(self) -> Decision:
        return self.plan.decision

    def describe(self) -> dict[str, Any]:
        """Return data for JSON."""
        indices = self.plan.index_texts(self.indices)
        variables = list(self.plan.variables)
        variables += [(concrete(one.ref, indices), one.kind) for one in self.followed]
        program, writer = self.where.reader, self.where.writer
        pointed = {
            one.pointer: program.variable_path(self.where, self.indices[one.pointed])
            for one in self.followed
            if one.pointer
        }
        shown = {
            path: literal(kind, value)
            for (path, kind), value in zip(variables, self.values, strict=False)
            if not isinstance(kind, ty.Array | ty.Struct | ty.Block)
        }
        if self.decision.source is not None:
            shown.pop(concrete(self.decision.source, indices), None)
        found: dict[str, Any] = {
            "statement": self.decision.text,
            "conditions": [
                {"line": one.line, "text": one.text, "holds": one.holds} for one in self.decision.conditions
            ],
            "variables": shown,
        }
        more = {
            "executed_in": program.instance_path(self.where, writer) if writer is not None else "",
            "indices": indices,
            "pointed": {pointer: path for pointer, path in pointed.items() if path},
            "notes": [f"{path}: {why}" if path else why for path, why in self.notes[:MAX_NOTES]],
            "inside": [one.describe() for one in self.inside],
        }
        return {**found, **{key: value for key, value in more.items() if value}}


class Inside(msgspec.Struct, frozen=True, gc=False):
    """The statement that assigned a variable which the decision `user` used: that of `access`, an attribute of `owner`."""

    user: Decided
    access: Access
    owner: Any
    record: Record
    decided: Decided | None
    """None if no statement for the variable is known in the line, such as for a call in a condition."""

    @property
    def place(self) -> tuple[str, int]:
        path, line = self.record[1][:SOURCE]
        return path, line

    def describe(self) -> dict[str, Any]:
        """Return data for JSON: the instance whose output it is, or the element or member, with the block of the statement."""
        program, root, _, body = where = self.user.where
        writer, access = self.record[2], self.access
        at = program.instance_path(where, body) if access.of_pou else ""
        path = concrete(access.ref, self.user.plan.index_texts(self.user.indices))
        if access.whole:
            path = program.variable_path(where, self.user.indices[access.pointed]) or path
        shown = f"{at}.{path}" if at else path
        if writer is self.owner and writer is not body and writer is not root:
            shown = program.instance_path(where, writer) or shown
        block = program.name_of(writer.kinds[0]) if writer is not None and hasattr(writer, "kinds") else ""
        scan = {"scan": self.record[0]} if self.record[0] else {}
        place = ":".join(map(str, self.place))
        unknown = {"statement": "", "conditions": [], "variables": {}}
        decided = self.decided.describe() if self.decided is not None else unknown
        found = {"instance": shown, "block": block, "place": place, **scan, **decided}
        if found.get("executed_in") == shown:
            del found["executed_in"]
        return found


def concrete(ref: t.Ref, indices: Mapping[str, str]) -> str:
    """Return a variable with the values that its indices had, as far as they are known."""
    selectors = [
        f"[{', '.join(str(_number(one, indices)) for one in selector.indices)}]"
        if isinstance(selector, t.Index)
        else reference(t.Ref(ref.pos, "", (selector,)))
        for selector in ref.selectors
    ]
    return "".join((ref.name, *selectors))


def _number(expr: t.Expr, indices: Mapping[str, str]) -> int | str:
    """Return the value of an index; its text if the value is not known."""
    if isinstance(expr, t.Binary):
        left, right = _number(expr.left, indices), _number(expr.right, indices)
        if isinstance(left, int) and isinstance(right, int) and expr.op in ("+", "-", "*"):
            return left + right if expr.op == "+" else left - right if expr.op == "-" else left * right
        return text_of(expr)
    text = indices.get(text_of(expr), text_of(expr))
    return int(text) if re.fullmatch(r"-?[0-9]+", text) else text
