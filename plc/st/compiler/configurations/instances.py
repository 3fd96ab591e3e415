"""The tasks and programs of configurations (IEC 61131-3:2013, 6.8), and the addresses that VAR_CONFIG gives to variables."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NoReturn

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.compiler.scope import Environment
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of, area_of
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.written import text_of

COPY = ".."
"""It separates the names of a PROGRAM and of the program of a configuration for which the PROGRAM is copied."""


def declared_name(name: str) -> str:
    """Return the name of a POU as the source declares it, also of a copy."""
    return name.partition(COPY)[0]


@dataclass(frozen=True, slots=True)
class CompiledTask:
    """A TASK. `interval_ns` is 0 if it has no INTERVAL. `single` is the text of SINGLE, such as ``start``; "" if it has none.

    `priority` is from 0, the highest and the default, to 65535.
    """

    name: str
    interval_ns: int
    priority: int
    single: str
    pos: t.Pos


@dataclass(frozen=True, slots=True)
class CompiledInstance:
    """A program that a configuration runs: its name, the PROGRAM, its task, and the variables of the program that it connects.

    `program` is a copy of the PROGRAM (`with_configured`) if VAR_CONFIG gives this program different values.
    """

    name: str
    program: str
    task: CompiledTask | None
    connected: frozenset[str]

    @property
    def is_special(self) -> bool:
        """Return whether the program differs from others of its type."""
        return bool(self.connected) or declared_name(self.program) != self.program


def compiled_instances(
    env: Environment, unit: t.SourceUnit, declarations: Declarations
) -> tuple[CompiledInstance, ...]:
    """Return the programs of the configurations of a unit with their tasks. Errors are collected in `env`."""
    programs = {pou.name.lower(): pou.name for pou in unit.pous if pou.kind == "PROGRAM"}
    tasks: dict[tuple[str, str], CompiledTask] = {}
    for task in unit.tasks:
        with env.errors.collect():
            key = task.resource.lower(), task.name.lower()
            if key in tasks:
                env.fail(task.pos, f"task {task.name} is declared twice")
            tasks[key] = _task(env, task, declarations)
    found: dict[str, CompiledInstance] = {}
    for one in unit.instances:
        if one.name.lower() in found:
            env.collected(env.error(one.pos, f"program {one.name} is declared twice in configurations"))
        if one.program.lower() in programs:
            made = CompiledInstance(
                one.name,
                programs[one.program.lower()],
                tasks.get((one.resource.lower(), one.task.lower())),
                frozenset(argument.name.lower() for argument in one.arguments),
            )
            found[one.name.lower()] = made
        elif one.program.lower() not in env.missing:
            expected = ", ".join(programs.values())
            env.collected(env.error(one.pos, f"a program {one.program!r} is not declared", expected=expected))
    return tuple(found.values())


def _task(env: Environment, task: t.Task, declarations: Declarations) -> CompiledTask:
    values = dict(task.values)
    interval, priority, single = (values.get(name) for name in ("INTERVAL", "PRIORITY", "SINGLE"))
    interval_ns = int(declarations.constant_of(interval, ty.TIME, "INTERVAL")) if interval is not None else 0
    number = int(declarations.constant_of(priority, ty.ELEMENTARY["UINT"], "PRIORITY")) if priority is not None else 0
    if interval_ns < 0:
        env.fail(task.pos, f"INTERVAL of task {task.name}", expected="a positive duration")
    return CompiledTask(task.name, interval_ns, number, text_of(single) if single is not None else "", task.pos)


def with_configured(unit: t.SourceUnit, *, vendor: bool) -> t.SourceUnit:
    """Return `unit` with the addresses and initial values of VAR_CONFIG in the declarations of its programs.

    If the programs of one type differ in them, each program with different values gets a copy of its PROGRAM (`copy_of`).
    The result keeps the variables of parts (`configured`); each `target` begins with the name of a PROGRAM, or of its copy, or
    of a global variable. In a vendor's dialect a path may begin with the name of a PROGRAM, because its project has no
    CONFIGURATION. Raises `FileInvalid` for a variable that does not exist or already has an address or a value.
    """
    if not unit.configured:
        return unit
    values = _values_of(unit, vendor=vendor)
    programs = {pou.name.lower(): pou for pou in unit.pous if pou.kind == "PROGRAM"}
    of_global = values.pop("", {})
    parts = [replace(one, target=path) for path, one in of_global.items()]
    pous: dict[str, list[t.Pou]] = {}
    renamed: dict[str, str] = {}
    for key, program in programs.items():
        instances = [one.name.lower() for one in unit.instances if one.program.lower() == key]
        own = {name: values[f"{key}{COPY}{name}"] for name in instances if f"{key}{COPY}{name}" in values}
        common = values.get(key, {})
        if _are_common(instances, own):
            common, own = {**common, **next(iter(own.values()), {})}, {}
        copies = {name: copy_of(program, name) for name in own}
        renamed |= {name: copy.name for name, copy in copies.items()}
        changes = [(program, common), *((copy, {**common, **own[name]}) for name, copy in copies.items())]
        pous[key] = [_with_values(of, changed) for of, changed in changes]
        for of, changed in changes:
            parts += [
                replace(one, target=f"{of.name.lower()}.{path}") for path, one in changed.items() if _is_part(path)
            ]
    return replace(
        unit,
        pous=tuple(one for pou in unit.pous for one in (pous[pou.name.lower()] if pou.kind == "PROGRAM" else [pou])),
        instances=tuple(replace(one, program=renamed.get(one.name.lower(), one.program)) for one in unit.instances),
        configured=tuple(parts),
    )


def copy_of(program: t.Pou, instance: str) -> t.Pou:
    """Return the copy of a PROGRAM for one program of a configuration. No source can declare a POU with its name."""
    return replace(program, name=f"{program.name}{COPY}{instance}")


def _are_common(instances: list[str], own: dict[str, dict[str, t.ConfiguredVariable]]) -> bool:
    """Return whether the PROGRAM itself can have the values that VAR_CONFIG states for its `instances`: there is only one, or
    all have the same initial values and no addresses, because programs at one address share one variable.
    """
    if len(instances) <= 1 or not own:
        return True
    first, *others = ({path: (v.location, v.initial) for path, v in of.items()} for of in own.values())
    addresses = any(location for location, _ in first.values())
    return len(own) == len(instances) and not addresses and all(other == first for other in others)


def _values_of(unit: t.SourceUnit, *, vendor: bool) -> dict[str, dict[str, t.ConfiguredVariable]]:
    """Return the variables of VAR_CONFIG by PROGRAM, by program of a configuration (``program..instance``), or "" for global
    ones, and then by their path in it, in lower case.
    """
    found: dict[str, dict[str, t.ConfiguredVariable]] = {}
    for one in unit.configured:
        owner, path = _target(unit, one, vendor=vendor)
        before = found.setdefault(owner, {}).setdefault(path, one)
        if (before.location, before.initial) != (one.location, one.initial):
            place = f"line {before.pos.line}"
            _fail(one, "it has a value already", expected=f"one entry for the variable, which is in {place}")
    return found


def _is_part(path: str) -> bool:
    return "." in path or "[" in path


def _target(unit: t.SourceUnit, one: t.ConfiguredVariable, *, vendor: bool) -> tuple[str, str]:
    """Return the owner of a variable of VAR_CONFIG as in `_values_of`, and the variable's path in it, in lower case."""
    programs = {pou.name.lower(): pou for pou in unit.pous if pou.kind == "PROGRAM"}
    instances = {instance.name.lower(): instance for instance in unit.instances}
    path = [name.lower() for name in one.path]
    if path[0] not in instances and len(path) > 1 and path[1] in instances:
        resource = instances[path[1]].resource
        if path.pop(0) != resource.lower() and resource:
            _fail(one, f"no resource {one.path[0]}", expected=resource)
    instance = instances.get(path[0])
    program = programs.get(instance.program.lower() if instance else path[0] if vendor else "")
    if program is None:
        names = {name.lower() for b in unit.globals for name in (b.list, *(v.name for v in b.variables)) if name}
        if len(path) > 1 and path[0].partition("[")[0] in names:
            return "", ".".join(path)
        known = [i.name for i in unit.instances] or [pou.name for pou in programs.values() if vendor]
        _fail(one, "no program of the configuration has this name", expected=", ".join(known) or "a CONFIGURATION")
    owner = (copy_of(program, instance.name) if instance else program).name.lower()
    declared = {v.name.lower(): v for block in program.blocks for v in block.variables}
    name = path[1].partition("[")[0] if len(path) > 1 else ""
    variable = declared.get(name)
    if variable is None:
        _fail(one, f"{program.name} has no such variable", expected=", ".join(v.name for v in declared.values()))
    inside = ".".join(path[1:])
    if not _is_part(inside) and one.location:
        area = area_of(one.location)
        if address_of(variable.location) or area_of(variable.location) != area:
            wanted = f"{variable.name} AT %{area}* in {program.name}"
            _fail(one, f"{variable.name} cannot get the address {one.location}", expected=wanted)
    return owner, inside


def _with_values(pou: t.Pou, changed: dict[str, t.ConfiguredVariable]) -> t.Pou:
    def configured(v: t.VarDecl) -> t.VarDecl:
        one = changed.get(v.name.lower())
        if one is None:
            return v
        return replace(v, location=one.location or v.location, initial=one.initial or v.initial)

    return replace(
        pou, blocks=tuple(replace(b, variables=tuple(configured(v) for v in b.variables)) for b in pou.blocks)
    )


def _fail(one: t.ConfiguredVariable, message: str, *, expected: str) -> NoReturn:
    raise invalid(one.pos, f"VAR_CONFIG {'.'.join(one.path)}: {message}", expected)
