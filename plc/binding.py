"""Connects programs with a plant: sources, bindings, and the process image that follows from them.

All configuration errors are found here, before the first scan: a variable that does not exist or is not bound, kinds
that differ, two programs that write one tag. This module uses no shared memory, clock or cycle.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.image.image import ImageLayout, TagKind, TagSpec, process_image
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.plc.program import Program, Role, Variable
from fieldtwin.plc.source_files import SUFFIXES

if TYPE_CHECKING:
    from fieldtwin.plc.st.program import StProgram

_SOURCES = (
    "python: module:Class, or FILE.st, FILE.xml, FILE.TcPOU or a folder of such files, "
    "followed by :PROGRAM if there are several"
)


@dataclass(frozen=True, slots=True)
class InputBinding:
    """The source of an input (a tag of the plant, or another program's ``program.variable``), and its policy for bad values.

    `if_bad` decides what the program sees while the source is BAD. ``"pass"``: the value as it is, BAD. ``"hold"``: the last
    value that was not BAD, as UNCERTAIN. A number: this number, as SUBSTITUTED. ``"trip"``: the task stops, with its outputs at
    their safe values, when a value that was good becomes bad.
    """

    tag: str
    if_bad: str | float = "pass"


@dataclass(frozen=True, slots=True)
class BoundProgram:
    """A program under its name in the system file, with its variables bound to tags of the plant.

    An output or local that is not bound is published as ``<program>.<variable>``.
    """

    name: str
    program: Program
    inputs: Mapping[str, InputBinding] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.program.bound_as(self.name)

    def variables(self, role: Role) -> list[Variable]:
        return [v for v in self.program.variables.values() if v.role is role]

    def published(self) -> list[tuple[Variable, str]]:
        """Return the outputs and locals, with the tag under which each is published."""
        both = self.variables(Role.OUTPUT) + self.variables(Role.LOCAL)
        return [(v, self.outputs.get(v.name, f"{self.name}.{v.name}")) for v in both]


def load_program(
    source: str,
    python_path: Sequence[str] = (),
    together: dict[Any, Any] | None = None,
    dialect: str = "standard",
    libraries: Sequence[str] = (),
    *,
    takes_writes: bool = False,
    machine_code: bool = False,
    published: Sequence[str] = (),
) -> Program:
    """Create the program that `source` names, searching the folders of `python_path` first. Raises `FileInvalid`.

    All programs of one PLC are created with the same dictionary `together`, which is empty at first. Through it, the programs
    of one Structured Text file share their VAR_GLOBAL.

    `source` is ``python: module:Class``, or a file of Structured Text (``relay.st``), a PLCopen export (``plant.xml``) or a
    folder of such files (``plc``), followed by ``:NAME`` if there are several programs. `dialect` is the dialect of a text
    (`fieldtwin.plc.st.dialects`), and `libraries` are files or folders with declarations that it uses, searched like `source`.
    `takes_writes`: a program in Structured Text has a message input for writes of servers (`fieldtwin.plc.st.program.WRITES`).
    `machine_code`: a program in Structured Text is compiled to machine code (`fieldtwin.plc.st.native`). `published`: paths of
    members and elements of its variables that get tags, too.
    """
    language, _, rest = source.partition(":")
    made: Callable[[], Program]
    if language.strip() == "python":
        made = _python_class(source, rest, python_path)
    else:
        found = _text_class(
            source,
            python_path,
            dialect,
            libraries,
            takes_writes=takes_writes,
            machine_code=machine_code,
            published=published,
        )
        made = partial(found, together)
    return _created(source, made)


def created_again(source: str, program: Program, together: dict[Any, Any]) -> Program:
    """Return a new instance of a program without reading its files. `source` and `together`: see `load_program`."""
    made = type(program)
    return _created(source, partial(made, together) if made.source_files else made)


def _created(source: str, made: Callable[[], Program]) -> Program:
    try:
        return made()
    except FieldtwinError:
        raise
    except Exception as e:  # the constructor is the user's code: it can raise any error, which is translated here, once
        raise FileInvalid(f"program {source!r} cannot be created: {type(e).__name__}: {e}") from e


def _python_class(source: str, rest: str, python_path: Sequence[str]) -> type[Program]:
    module_name, _, class_name = rest.strip().partition(":")
    if not module_name or not class_name:
        raise FileInvalid("not the source of a program", expected=_SOURCES, got=source)
    for folder in reversed(python_path):
        if folder not in sys.path:
            sys.path.insert(0, folder)
    try:
        found = getattr(importlib.import_module(module_name.strip()), class_name.strip(), None)
    except Exception as e:  # a user's module can raise any error while it is imported; it is translated here, once
        raise FileInvalid(f"program {source!r} cannot be imported: {type(e).__name__}: {e}") from e
    if not (isinstance(found, type) and issubclass(found, Program)):
        raise FileInvalid(
            "not a program", expected=f"a class {class_name} derived from fieldtwin.plc.program.Program", got=source
        )
    return found


def _found(name: str, folders: Sequence[str]) -> Path:
    places = [Path(folder) / name for folder in folders if not Path(name).is_absolute()] + [Path(name)]
    return next((p for p in places if p.exists()), places[0])


def text_source(source: str, folders: Sequence[str]) -> tuple[Path, str] | None:
    """Return the file or folder of a program in Structured Text, and the name of the program in it ("" for the only one).

    Return None for a source in Python, or for no source at all.
    """
    name, _, program = source.strip().partition(":")
    found = _found(name, folders)
    is_text = name.lower().endswith(SUFFIXES) or (name and found.is_dir())
    return (found, program.strip()) if is_text else None


def _text_class(
    source: str,
    folders: Sequence[str],
    dialect: str,
    libraries: Sequence[str],
    *,
    takes_writes: bool,
    machine_code: bool,
    published: Sequence[str],
) -> type[StProgram]:
    found = text_source(source, folders)
    if found is None:
        raise FileInvalid("not the source of a program", expected=_SOURCES, got=source)
    from fieldtwin.plc.st.dialects import dialect_of
    from fieldtwin.plc.st.program import load_source  # load the compiler only if there is something to compile

    places = library_places(libraries, folders)
    return load_source(
        *found,
        dialect_of(dialect),
        places,
        takes_writes=takes_writes,
        machine_code=machine_code,
        published=published,
    )


def library_places(libraries: Sequence[str], folders: Sequence[str]) -> tuple[Path, ...]:
    """Return the files or folders of libraries."""
    return tuple(_found(library, folders) for library in libraries)


def image_for(
    programs: Sequence[BoundProgram], plant: Mapping[str, TagSpec], watched: Iterable[str] = ()
) -> ImageLayout:
    """Return the process image that `programs` need of a plant whose tags are `plant`. Raises `FileInvalid`.

    INPUTS holds every tag to which an input is bound, then the `watched` tags; OUTPUTS holds every output and local. An input may
    also be bound to another program's variable: ``<program>.<variable>``.
    """
    inputs: dict[str, TagSpec] = {}
    outputs: dict[str, TagSpec] = {}
    writers: dict[str, str] = {}
    own = {
        tag: _own_spec(tag, v)
        for bound in programs
        for v, tag in bound.published()
        if tag not in plant and v.kind is not TagKind.MESSAGE
    }
    for bound in programs:
        _check_names(bound)
        for variable in bound.variables(Role.INPUT):
            if variable.name not in bound.inputs:
                continue
            if bound.inputs[variable.name].tag in own:
                _plant_tag(bound, variable, bound.inputs[variable.name].tag, own)
                continue
            spec = _plant_tag(bound, variable, bound.inputs[variable.name].tag, plant)
            substitute(spec, bound.inputs[variable.name].if_bad)
            inputs[spec.name] = spec
        for variable, tag in bound.published():
            if tag in writers:
                raise FileInvalid(f"tag {tag} is written by two programs", got=f"{writers[tag]} and {bound.name}")
            writers[tag] = bound.name
            if variable.name in bound.outputs:
                outputs[tag] = _plant_tag(bound, variable, tag, plant)
            else:
                outputs[tag] = _own_spec(tag, variable)
    for tag in watched:
        if tag in own:
            continue
        if tag not in plant:
            raise FileInvalid("a tag that does not exist", expected="a device's, or program.variable", got=tag)
        inputs.setdefault(tag, plant[tag])
    return process_image(list(inputs.values()), list(outputs.values()))


def _own_spec(tag: str, v: Variable) -> TagSpec:
    return TagSpec(tag, v.kind, v.unit, v.max_bytes, v.depth, v.limits, v.words)


def _check_names(bound: BoundProgram) -> None:
    for what, names, role in (("input", bound.inputs, Role.INPUT), ("output", bound.outputs, Role.OUTPUT)):
        declared = {v.name for v in bound.variables(role)}
        for name in names:
            if name not in declared:
                raise FileInvalid(
                    f"program {bound.name} has no {what} {name!r}", expected=", ".join(sorted(declared)) or "none"
                )
    for variable in bound.variables(Role.INPUT):
        if variable.name not in bound.inputs and variable.needs_tag:
            raise FileInvalid(f"input {variable.name!r} of program {bound.name} is bound to no tag")


def _plant_tag(bound: BoundProgram, variable: Variable, tag: str, plant: Mapping[str, TagSpec]) -> TagSpec:
    where = f"{variable.role.value} {variable.name!r} of program {bound.name}"
    spec = plant.get(tag)
    if spec is None:
        raise FileInvalid(f"{where} is bound to {tag}, which does not exist")
    check_kind(bound.name, variable, spec)
    return spec


def check_kind(program: str, variable: Variable, spec: TagSpec) -> None:
    """Raise `FileInvalid` if a variable and the tag to which it is bound differ in kind. An integer may go into a REAL."""
    source, sink = (spec.kind, variable.kind) if variable.role is Role.INPUT else (variable.kind, spec.kind)
    if source is sink or (source is TagKind.INT and sink is TagKind.REAL):
        return
    bit = (variable.kind, spec.kind) == (TagKind.BOOL, TagKind.INT) and spec.limits == (0, 1)
    raise FileInvalid(
        f"{variable.role.value} {variable.name!r} of program {program} and {spec.name} differ in kind",
        expected=f"a variable of kind {spec.kind.value}, as the tag",
        got=variable.kind.value,
        hint="a bit of a register is a bool with `type: bool` in the profile" if bit else "",
    )


def substitute(spec: TagSpec, if_bad: str | float) -> Scalar | None:
    """Return the number with which `if_bad` replaces a BAD value of tag `spec`; None if the policy is not a number.

    Raises `FileInvalid` for an invalid policy or value.
    """
    if isinstance(if_bad, str):
        if if_bad not in ("hold", "pass", "trip"):
            raise FileInvalid(f"if_bad of {spec.name}", expected="hold, pass, trip or a number", got=repr(if_bad))
        return None
    if spec.kind is TagKind.REAL:
        return float(if_bad)
    whole = int(if_bad)
    if spec.kind is TagKind.MESSAGE or whole != if_bad or (spec.kind is TagKind.BOOL and whole not in (0, 1)):
        raise FileInvalid(f"if_bad of {spec.name}", expected=f"a value of kind {spec.kind.value}", got=repr(if_bad))
    return bool(whole) if spec.kind is TagKind.BOOL else whole
