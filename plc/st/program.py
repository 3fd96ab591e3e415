"""A PROGRAM in Structured Text as a `Program` of the soft PLC.

Variables that can be tags (BOOL, numbers, times, enumerations) are declared under the names of the source; locals that cannot
be tags (strings, arrays, structures, blocks) are not published. An input that never had a value keeps its initial value;
IS_GOOD of it is then false. Times are tags in ns, enumerations are tags with their numbers, and ULINT and LWORD are tags with
their two's complement.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MethodType
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.plc.program import (
    InternalVariable,
    Program,
    Role,
    ScanInfo,
    SourceLine,
    Variable,
    VariableReader,
    message_input,
    message_output,
)
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.classes.instance_variables import is_instance_variable
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.configurations.instances import CompiledInstance, declared_name
from fieldtwin.plc.st.compiler.pous.programs import METHODS, CompiledProgram, ProgramVariable, connection
from fieldtwin.plc.st.compiler.scope import identifier
from fieldtwin.plc.st.coverage.recording import active_recording
from fieldtwin.plc.st.decisions.reading import Decided, DecisionReader, reader
from fieldtwin.plc.st.decisions.statements import Decisions, decisions_of
from fieldtwin.plc.st.dialects import STANDARD, Dialect
from fieldtwin.plc.st.drawing.live import Pictures, Reading, pictures_of
from fieldtwin.plc.st.inspection import shown_value
from fieldtwin.plc.st.project import compile_source
from fieldtwin.plc.st.resource import Resource, Together, attributes_of, state_of
from fieldtwin.plc.st.runtime.lines import SOURCE, Record, forget, indices_of, is_line, line_of, record_of
from fieldtwin.plc.st.runtime.parts import assign, reached, value_of
from fieldtwin.plc.st.runtime.retention import described, described_part, dump, load, most_bytes, retained_part
from fieldtwin.plc.st.state_diagram import StateDiagram
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.variable_paths import VariablePaths

WRITES = "st_writes"
"""The message input through which servers write variables: a JSON object with values by name (`StProgram.put`)."""
_ROLES = {"input": Role.INPUT, "output": Role.OUTPUT, "local": Role.LOCAL}


class StProgram(Program):
    """The base class of the classes that `program_class` creates."""

    st_unit: CompiledUnit
    st_declared: CompiledProgram
    st_paths: VariablePaths
    st_decisions: DecisionReader
    st_pictures: Pictures | None
    """The drawings and the state machine, once they are made."""
    st_instance: str = ""
    """The program of a configuration whose connections are used, if it has any."""
    st_internal: frozenset[str] = frozenset()
    """The variables that could be tags, but have none in the process image of the running PLC."""

    def __init__(self, together: Together | None = None) -> None:
        """Create the program. `together` holds the resources that the programs of one PLC share: one for each file."""
        self.st_resource = Resource.of(self.st_unit, together)
        self.st_body: Any = self.st_resource.created(f"P_{identifier(self.st_declared.name)}")
        """The instance of the compiled program, its variables as ``v_<name>`` in lower case."""
        self.st_resource.add(self.st_body)
        self.st_variables = {v.name: v for v in self.st_declared.variables if v.name not in self.st_internal}
        """The variables that have tags, or can have them, by name."""
        inputs = [v for v in self.st_variables.values() if v.role == "input" and _tag_kind(v.kind) is not None]
        self.st_inputs = [_Input(v) for v in inputs if not v.shared and not v.steps]
        self.st_shared_inputs = [_Input(v) for v in inputs if v.shared and not v.steps]
        """The inputs that are global variables with an address."""
        self.st_part_inputs = [_Input(v) for v in inputs if v.steps]
        """The inputs that are parts of variables, and the other parts after them."""
        self.st_parts = [v for v in self.st_variables.values() if v.role != "input" and v.steps]
        self.st_converted: list[tuple[str, str, Callable[[Any], Any]]] = []
        """The outputs and locals whose tags hold other values than the variables."""
        self.st_shared: list[tuple[str, str, Callable[[Any], Any] | None]] = []
        """The outputs and locals that are global variables with an address."""
        same: list[tuple[str, str]] = []
        for v in self.st_declared.variables:
            if v.role == "output" and isinstance(v.kind, ty.MessagesOut):
                setattr(self.st_body, str(v.attribute), self.__dict__[v.name])
            elif v.role != "input" and _tag_kind(v.kind) is not None and v.name in self.st_variables and not v.steps:
                attribute, convert = str(v.attribute), _to_tag(v.kind)
                if v.shared:
                    self.st_shared.append((v.name, attribute, convert))
                elif convert is not None:
                    self.st_converted.append((v.name, attribute, convert))
                else:
                    same.append((v.name, attribute))
        self.st_outputs = [name for name, _ in same]
        self.st_read = reader([attribute for _, attribute in same])
        """Reads the values of `st_outputs`, all at once, because a large program has hundreds."""
        self.st_keys = self.st_published_by_machine_code({attribute: name for name, attribute in same})
        """The names under which machine code publishes the variables that it changes; None if Python code may change some."""
        self.st_shown = False
        """Whether the tags have the values that the variables had after the last scan, which ended without an error."""
        self.st_retained = [v for v in self.st_declared.variables if v.retain or self.st_kept(v) is not None]
        self.st_lines = {
            name: (line_of(str(v.attribute)), indices_of(str(v.attribute)))
            for name, v in self.st_variables.items()
            if not v.shared and not v.steps
        }
        """For the variables of the PROGRAM itself: the attributes with the line and the indices of their last assignment."""
        self.st_places: dict[tuple[str, int], SourceLine] = {}
        """The lines that assigned outputs so far; all changes by one line share its object."""
        self.st_show()

    def execute(self, scan: ScanInfo) -> None:
        self.st_resource.begin(scan, self.tag)
        body, namespace = self.st_body, self.__dict__
        for message in namespace.get(WRITES, ()):
            for name, value in json.loads(message.data).items():
                self.put(name, value)
        for item in self.st_shared_inputs:
            item.put(self.st_resource.globals, namespace[item.name])
        if self.st_instance:
            getattr(body, connection(self.st_instance, into=True))()
        for item in self.st_inputs:
            item.put(body, namespace[item.name])
        for item in self.st_part_inputs:
            item.put(self.st_holder(item.variable), namespace[item.name])
        context = self.st_resource.context
        keys = self.st_keys if self.st_shown else None
        context.published = None if keys is None else (namespace, keys)
        self.st_shown = False
        try:
            body.execute()
        except RecursionError as e:
            raise _too_deep(e) from None
        if self.st_instance:
            getattr(body, connection(self.st_instance, into=False))()
        if keys is not None and context.published is None:
            self.st_show_others()
        else:
            self.st_show()
        self.st_shown = True

    def whole_state(self, now_ns: int) -> Any:
        """Return the state on which the next scans depend: variables, blocks with the phase of their timers, global
        variables.
        """
        resource = self.st_resource
        held = [attributes_of(self.st_body), vars(resource.globals)]
        numbers = resource.numbers(self.st_body)
        own = tuple(
            [tuple([state_of(v, now_ns, numbers) for name, v in of.items() if not is_line(name)]) for of in held]
        )
        return (own, now_ns) if resource.absolute else own

    def st_show(self) -> None:
        body, namespace = self.st_body, self.__dict__
        namespace.update(zip(self.st_outputs, self.st_read(body), strict=True))
        self.st_show_others()

    def st_show_others(self) -> None:
        """Publish the variables whose tags hold other values, and those that are elsewhere."""
        body, namespace = self.st_body, self.__dict__
        for name, attribute, to_tag in self.st_converted:
            namespace[name] = to_tag(getattr(body, attribute))
        for name, attribute, convert in self.st_shared:
            value = getattr(self.st_resource.globals, attribute)
            namespace[name] = convert(value) if convert else value
        for part in self.st_parts:
            value, convert = self.st_value(part), _to_tag(part.kind)
            namespace[part.name] = convert(value) if convert else value

    def st_published_by_machine_code(self, names: Mapping[str, str]) -> tuple[str | None, ...] | None:
        """Return the name of each variable of the machine code that is published as it is. `names` has them by attribute.

        Return None without machine code, or if Python code may change variables too.
        """
        code = self.st_unit.machine_code
        attributes = code.published(type(self.st_body).__name__) if code is not None else None
        if attributes is None or self.st_instance:
            return None
        return tuple(names.get(attribute) for attribute in attributes)

    def st_holder(self, variable: ProgramVariable) -> Any:
        """Return the object, or the list, that holds a variable's value as its attribute or element `variable.attribute`."""
        return reached(self.st_resource.globals if variable.shared else self.st_body, variable.steps)

    def st_value(self, variable: ProgramVariable) -> Any:
        """Return the value of a variable as the program holds it."""
        return value_of(self.st_holder(variable), variable.attribute)

    def st_assign(self, variable: ProgramVariable, value: Any) -> None:
        """Set a variable to a value as the program holds it."""
        assign(self.st_holder(variable), variable.attribute, value)

    def put(self, name: str, value: Scalar) -> None:
        super().put(name, value)
        found = self.st_variables.get(name)
        if found is not None:
            convert = _from_tag(found.kind)
            self.st_assign(found, convert(value) if convert else value)
            if self.st_record(found):
                forget(*self.st_kept_in(found))

    def st_kept_in(self, variable: ProgramVariable) -> tuple[Any, str, tuple[int, ...]]:
        """Return the object and the attribute that hold a variable, and the indices of an element of an array."""
        steps = (*variable.steps, variable.attribute)
        end = max(n for n, step in enumerate(steps) if isinstance(step, str))
        owner = reached(self.st_resource.globals if variable.shared else self.st_body, steps[:end])
        return owner, str(steps[end]), tuple(step for step in steps[end + 1 :] if isinstance(step, int))

    def st_record(self, variable: ProgramVariable) -> Record:
        """Return the record of the last assignment of a variable; empty if it is not known."""
        if variable.steps:
            return record_of(*self.st_kept_in(variable), self.source_path)
        owner = self.st_resource.globals if variable.shared else self.st_body
        return record_of(owner, str(variable.attribute), (), self.source_path)

    def bound_as(self, name: str) -> None:
        self.st_resource.call(self.st_body, name)

    def last_assignment(self, name: str) -> tuple[SourceLine | None, Decided | None]:
        """Return the line that assigned the output, and its statement with what decided; for an output with its initial value,
        the line of its declaration.
        """
        found, body = self.st_variables.get(name), self.st_body
        lines = self.st_lines.get(name)
        if lines is not None:
            line = getattr(body, lines[0], 0)
            if type(line) is int and line and not getattr(body, lines[1], ()):  # most of the changes of a scan
                place = self.st_place((self.source_path, line))
                return place, self.st_decisions.read_own(body, self.st_resource, name, (self.source_path, line))
        record = self.st_record(found) if found is not None else ()
        if found is None or not record:
            return None, None
        place = self.st_place(record[1][:SOURCE])
        return place, self.st_decisions.read(body, self.st_resource, name, record)

    def st_place(self, source: tuple[str, int]) -> SourceLine:
        """Return the line of a source; all changes by one line share its object."""
        place = self.st_places.get(source)
        if place is None:
            place = self.st_places[source] = SourceLine(*source)
        return place

    def check(self, name: str, value: Scalar) -> None:
        found = self.st_variables.get(name)
        convert = _from_tag(found.kind) if found is not None else None
        if found is not None and isinstance(found.kind, ty.Enum) and value not in found.kind.values.values():
            named = ", ".join(f"{number} ({word})" for word, number in found.kind.values.items())
            raise UsageError(f"{name} is a {found.kind}", expected=named, got=repr(value))
        try:
            if convert is not None:
                convert(value)
        except values.LogicError as e:
            raise UsageError(f"{name} cannot be forced to that", expected=e.expected, got=repr(value)) from e

    def internal_names(self) -> Iterator[str]:
        shown = {v.name for v in self.st_parts}
        names = self.st_paths.internal_names(self.st_body, self.st_resource.globals)
        return (name for name in names if name not in shown)

    def internal(self, path: str) -> InternalVariable | None:
        return self.st_paths.internal(path, self.st_body, self.st_resource.globals)

    def variable_reader(self, path: str) -> VariableReader | None:
        found = self.st_paths.reading(path)
        if found is None:
            return None
        kind, read = found
        unit = "ns" if ty.is_kind(kind, "duration") else ""
        return VariableReader(str(kind), lambda: shown_value(kind, read(self.st_body, self.st_resource.globals)), unit)

    @classmethod
    def st_pictured(cls) -> Pictures:
        """Return the pictures of the program. They are made once for a class."""
        if cls.st_pictures is None:
            variables = [(v.name, v.kind) for v in cls.st_declared.variables]
            cls.st_pictures = pictures_of(cls.st_unit, cls.st_declared.declared_name, variables)
        return cls.st_pictures

    def drawings(self) -> list[tuple[str, str]]:
        return [(live.name, live.svg) for live in self.st_pictured().drawings]

    def state_diagram(self) -> StateDiagram | None:
        return self.st_pictured().machine

    def drawn(self, number: int) -> dict[str, Any]:
        live = self.st_pictured().drawings[number]
        body, shared, paths = self.st_body, self.st_resource.globals, self.st_paths
        if not live.path:
            return Reading(live, lambda path: paths.typed(path, body, shared), body).values()
        instance = paths.typed(live.path, body, shared)
        if instance is None:
            return {}
        return Reading(live, lambda path: paths.within(instance, f".{path}"), instance[1]).values()

    # -- online change ----------------------------------------------------------------------------------------------------

    def st_become(self, new: StProgram) -> None:
        """Become `new`, the same program in a new version, which must not be used any more.

        The object and its dictionary stay the same, because the scan and the output image refer to them. Inputs and mailboxes
        stay as well.
        """
        own = self.__dict__
        kept = {
            name: own[name] for name, v in new.variables.items() if v.role is Role.INPUT or v.kind is TagKind.MESSAGE
        }
        if "_lookup" in own:
            kept["_lookup"] = own["_lookup"]
        for v in new.st_declared.variables:
            if v.role == "output" and isinstance(v.kind, ty.MessagesOut):
                setattr(new.st_body, str(v.attribute), own[v.name])
        fresh = {**new.__dict__, **kept}
        self.__class__ = type(new)
        own.clear()
        own.update(fresh)
        self.st_show()

    # -- retained variables -----------------------------------------------------------------------------------------------

    def retained(self) -> dict[str, Any]:
        """Return every VAR RETAIN by name, as data for JSON, including those that are not tags. Of other variables, return the
        parts that are RETAIN in their function blocks.
        """
        return {v.name: self.st_kept(v) for v in self.st_retained}

    def st_kept(self, v: ProgramVariable) -> Any:
        """Return what is retained of a variable, as data for JSON; None for nothing."""
        value = self.st_value(v)
        return dump(value) if v.retain else retained_part(value)

    def retain_layout(self) -> Any:
        return [
            [v.name, (described if v.retain else described_part)(v.kind, self.st_value(v), self.st_unit.blocks)]
            for v in self.st_retained
        ]

    def retain_bytes(self) -> int:
        return sum(10 + len(v.name) + most_bytes(v.kind, self.st_kept(v)) for v in self.st_retained)

    def restore(self, kept: dict[str, Any]) -> None:
        """Restore what `retained` returned: variables that are in `kept` take its values."""
        for v in self.st_retained:
            if v.name in kept:
                self.st_assign(v, load(self.st_value(v), kept[v.name]))
        self.st_show()


class _Input:
    """An input: how the value in the image is converted to the program's value."""

    __slots__ = ("attribute", "convert", "name", "variable")

    def __init__(self, variable: ProgramVariable) -> None:
        self.variable = variable
        self.name = variable.name
        self.attribute = variable.attribute
        self.convert = _from_tag(variable.kind)

    def put(self, holder: Any, value: Any) -> None:
        """Set the variable in `holder`. Without a `value`, it keeps the one that it has."""
        if value is not None:
            assign(holder, self.attribute, self.taken(value) if self.convert else value)

    def taken(self, value: Any) -> Any:
        """Return `value` as the program uses it. Raises `LogicError` for a value that the variable cannot hold."""
        assert self.convert is not None
        try:
            return self.convert(value)
        except values.LogicError as e:
            raise values.LogicError(f"input {self.name}: {e.message}", expected=e.expected, got=e.got) from e


def _too_deep(error: RecursionError) -> values.LogicError:
    """Return the error of calls that are nested too deep. The compiler refuses recursion, except through interfaces."""
    found = values.LogicError("calls nested too deep", hint="a method calls itself through an interface")
    return found.with_traceback(error.__traceback__)


def program_class(
    unit: CompiledUnit,
    name: str = "",
    decisions: Decisions | None = None,
    pictures: Pictures | None = None,
    *,
    takes_writes: bool = False,
    published: Sequence[str] = (),
) -> type[StProgram]:
    """Return the class of program `name` of a unit, or of its only program if `name` is empty. Raises `FileInvalid`.

    `name` may also be that of a program of a configuration, which states the PROGRAM. With `takes_writes` the program has a
    message input whose messages set its variables, each before the next scan. The paths in `published`, such as ``timer.Q``, get
    tags; those that the program does not have, and those of values that cannot be tags, are left out. `decisions` and `pictures`
    are those of the unit and of the program, if they are known already; the `source` of the unit is not used then.
    """
    missing = {m.name: m for m in unit.missing if m.kind == "program"}
    names = [*(p.name for p in unit.programs if p.declared_name == p.name), *missing]
    instance = instance_of(unit, name)
    wanted = instance.program if instance is not None else name or (names[0] if len(names) == 1 else "")
    found = next((p for p in unit.programs if p.name.lower() == wanted.lower()), None)
    if found is None:
        for m in missing.values():
            if m.name.lower() == wanted.lower():
                raise invalid(m.pos, m.reason)
        raise FileInvalid(
            f"no PROGRAM {name}" if name else "which PROGRAM is meant",
            path=unit.path,
            expected=", ".join((*names, *(one.name for one in unit.instances))) or "a PROGRAM in the file",
            hint="write SOURCE:NAME, because it has several" if len(names) > 1 else "",
        )
    special = [one for one in unit.instances if declared_name(one.program) == found.name and one.is_special]
    if instance is None and special:
        hint = "write SOURCE:NAME with the name of one of them"
        connecting = any(one.connected for one in special)
        why = "connect the variables" if connecting else "have different values for variables"
        message = f"which program of the configuration is meant, because they {why} of {found.name}"
        raise FileInvalid(message, path=unit.path, expected=", ".join(one.name for one in special), hint=hint)
    found = _with_published(unit, found, published)
    connected = instance.connected if instance is not None else frozenset()
    tags = {v.name: made for v in found.variables if (made := _tag_of(v, connected)) is not None}
    if takes_writes:
        tags = {WRITES: replace(message_input(), hidden=True), **tags}
    decided = DecisionReader(
        unit,
        found.declared_name,
        found.own,
        decisions_of(unit.source) if decisions is None else decisions,
        frozenset(v.name.lower() for v in found.variables if v.role == "input"),
    )
    named = instance.name if instance is not None and connected else ""
    internal = frozenset(v.name for v in found.variables if is_instance_variable(v.name))
    return _class_of(unit, found, decided, tags, internal, named, pictures)


def _with_published(unit: CompiledUnit, program: CompiledProgram, paths: Sequence[str]) -> CompiledProgram:
    """Return `program` with these parts of its variables, and of global variables, as local variables."""
    if not paths:
        return program
    known, declared, found = {v.name for v in program.variables}, VariablePaths(unit, program, ()), []
    for path in (path for path in dict.fromkeys(paths) if path not in known):
        place = declared.place(path)
        if place is not None and place[0].path == path and _tag_kind(place[0].kind) not in (None, TagKind.MESSAGE):
            *steps, last = place[0].keys
            found.append(ProgramVariable(path, "local", place[0].kind, False, last, place[1], steps=tuple(steps)))
    return replace(program, variables=(*program.variables, *found))


def with_interface(made: type[StProgram], interface: Mapping[str, Variable]) -> type[StProgram]:
    """Return the class of the same program with exactly the variables of `interface`, which have tags in the process image.

    A variable of `interface` that the source does not declare with the same kind of value has no value, and a variable of the
    source that is not in `interface` is an internal one.
    """
    own = made.variables
    internal = made.st_internal | {name for name, v in own.items() if not _replaces(v, interface.get(name))}
    tags = {name: v if name in internal or name not in own else own[name] for name, v in interface.items()}
    return _class_of(
        made.st_unit, made.st_declared, made.st_decisions, tags, internal, made.st_instance, made.st_pictures
    )


def _replaces(new: Variable, old: Variable | None) -> bool:
    """Return whether the place of `old` in the process image can hold `new`."""
    return old is not None and old.kind is new.kind and (old.role is Role.INPUT) is (new.role is Role.INPUT)


def _class_of(
    unit: CompiledUnit,
    found: CompiledProgram,
    decisions: DecisionReader,
    tags: Mapping[str, Variable],
    internal: frozenset[str],
    instance: str,
    pictures: Pictures | None,
) -> type[StProgram]:
    """Return the class of program `found` with the variables `tags`. Those in `internal` could be tags as well."""
    own = [v for v in found.variables if not v.shared and not v.steps]
    hidden = [v for v in own if _tag_kind(v.kind) is None or v.name in internal]
    body: dict[str, Any] = {
        "st_unit": unit,
        "st_declared": found,
        "st_instance": instance,
        "st_paths": VariablePaths(unit, found, hidden),
        "st_decisions": decisions,
        "st_internal": internal,
        "st_pictures": pictures,
        "source_path": found.path,
        "source_files": tuple(sorted(unit.files, key=lambda file: (file != found.path, file))),
        "source_warnings": tuple(map(str, unit.warnings)),
        "__module__": __name__,
        **{name: _Method(getattr(StProgram, name)) if name in METHODS else tag for name, tag in tags.items()},
    }
    made: type[StProgram] = type(found.declared_name, (StProgram,), body)
    made.variables = {**StProgram.variables, **{name: replace(tag, name=name) for name, tag in tags.items()}}
    return made


class _Method:
    """A method whose name is also that of a variable. As it can be set, it has precedence over the value in the instance."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __get__(self, program: StProgram | None, _: type[StProgram]) -> Callable[..., Any]:
        return self.function if program is None else MethodType(self.function, program)

    def __set__(self, program: StProgram, value: object) -> None:
        raise AttributeError(f"{self.function.__name__} is a method")


def _tag_of(v: ProgramVariable, connected: frozenset[str]) -> Variable | None:
    """Return a variable as it is declared to the PLC; None if it cannot be a tag. `connected`: those that need no tag."""
    if isinstance(v.kind, ty.MessagesIn):
        return message_input()  # type: ignore[no-any-return]
    if isinstance(v.kind, ty.MessagesOut):
        return message_output(v.kind.max_bytes, v.kind.depth)  # type: ignore[no-any-return]
    kind = _tag_kind(v.kind)
    if kind is None or is_instance_variable(v.name):
        return None
    return Variable(
        v.name,
        _ROLES[v.role],
        kind,
        unit="ns" if ty.is_kind(v.kind, "duration") else "",
        retain=v.retain,
        limits=(float(v.kind.low), float(v.kind.high)) if isinstance(v.kind, ty.Subrange) else None,
        words=tuple((code, word) for word, code in v.kind.values.items()) if isinstance(v.kind, ty.Enum) else (),
        address=v.location,
        needs_tag=not (v.optional or v.name.lower() in connected),
        located=v.optional and not v.unused,
        type=str(ty.plain(v.kind)),
    )


def instance_of(unit: CompiledUnit, name: str = "") -> CompiledInstance | None:
    """Return the program of a configuration that `name` means: its name, or the PROGRAM that only this one has.

    An empty `name` stands for the only PROGRAM of the unit. Return None if no program or several programs match.
    """
    programs = [p.name for p in unit.programs if p.declared_name == p.name]
    wanted = (name or (programs[0] if len(programs) == 1 else "")).lower()
    if wanted not in {program.lower() for program in programs}:
        return next((one for one in unit.instances if one.name.lower() == wanted), None)
    found = [one for one in unit.instances if declared_name(one.program).lower() == wanted]
    return found[0] if len(found) == 1 else None


def load_source(
    path: Path,
    name: str = "",
    dialect: Dialect = STANDARD,
    libraries: tuple[Path, ...] = (),
    *,
    takes_writes: bool = False,
    machine_code: bool = False,
    published: Sequence[str] = (),
) -> type[StProgram]:
    """Read and compile a file (Structured Text, or a PLCopen XML export) or a folder of them. Raises `FileInvalid`.

    It has probes for coverage if a recording is active. Otherwise `machine_code` gives it machine code. `published`: as in
    `program_class`.
    """
    recording = active_recording()
    if recording is not None:
        unit = recording.compiled(path, dialect, libraries)
    else:
        unit = compile_source(path, dialect, libraries, machine_code=machine_code)
    return program_class(unit, name, takes_writes=takes_writes, published=published)


def _tag_kind(kind: ty.Type) -> TagKind | None:
    """Return the tag kind for a variable of this type; None if it cannot be a tag."""
    if isinstance(kind, ty.MessagesIn | ty.MessagesOut):
        return TagKind.MESSAGE
    if isinstance(kind, ty.Enum):
        return TagKind.INT
    kind = ty.plain(kind)
    if not isinstance(kind, ty.Elementary) or kind.kind == "char":
        return None
    return {"bool": TagKind.BOOL, "real": TagKind.REAL}.get(kind.kind, TagKind.INT)


def _from_tag(kind: ty.Type) -> Callable[[Any], Any] | None:
    """Return the conversion from a tag's value to the program's value; None if they are the same."""
    held = ty.plain(kind)
    if isinstance(kind, ty.Subrange):
        return lambda x: values.inside(x, kind.low, kind.high)
    if isinstance(held, ty.Elementary) and held.kind in ("int", "bits"):
        if held.bits == 64 and held.low == 0:
            return lambda x: x & held.high
        return lambda x: values.inside(x, held.low, held.high)
    return values.real if kind == ty.REAL else None


def _to_tag(kind: ty.Type) -> Callable[[Any], Any] | None:
    kind = ty.plain(kind)
    unsigned = isinstance(kind, ty.Elementary) and kind.bits == 64 and kind.low == 0 and kind.high > 0
    return (lambda x: values.signed(x, 64)) if unsigned else None
