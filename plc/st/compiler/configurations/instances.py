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
    """A program that a configuration runs: its name, the PROGRAM, its task, and the variables of the program that it connects."""

    name: str
    program: str
    task: CompiledTask | None
    connected: frozenset[str]


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

    The result keeps those of parts of variables (`configured`); each path begins with the name of a PROGRAM or global variable.
    In a vendor's dialect a path may begin with the name of a PROGRAM, because its project has no CONFIGURATION.
    Raises `FileInvalid` for a variable that does not exist or already has an address, and for programs of one type with
    different values.
    """
    if not unit.configured:
        return unit
    changed: dict[tuple[str, str], t.ConfiguredVariable] = {}
    for one in unit.configured:
        program, name = _target(unit, one, vendor=vendor)
        before = changed.setdefault((program.name.lower() if program else "", name), one)
        if (before.location, before.initial) != (one.location, one.initial):
            _fail(one, "two programs of one type have different values", expected="a PROGRAM for each of them")
    parts = tuple(
        replace(one, path=tuple(part for part in (program, name) if part))
        for (program, name), one in changed.items()
        if "." in name or "[" in name
    )
    pous = tuple(_with_values(pou, changed) if pou.kind == "PROGRAM" else pou for pou in unit.pous)
    return replace(unit, pous=pous, configured=parts)


def _target(unit: t.SourceUnit, one: t.ConfiguredVariable, *, vendor: bool) -> tuple[t.Pou | None, str]:
    """Return the program that declares a variable of VAR_CONFIG, and the variable's path in it, in lower case.

    The program is None for a part of a global variable.
    """
    programs = {pou.name.lower(): pou for pou in unit.pous if pou.kind == "PROGRAM"}
    instances = {instance.name.lower(): programs.get(instance.program.lower()) for instance in unit.instances}
    path = [name.lower() for name in one.path]
    if path[0] not in instances and len(path) > 1 and path[1] in instances:
        path.pop(0)  # the resource
    program = instances.get(path[0]) or (programs.get(path[0]) if vendor else None)
    if program is None:
        names = {name.lower() for b in unit.globals for name in (b.list, *(v.name for v in b.variables)) if name}
        if len(path) > 1 and path[0].partition("[")[0] in names:
            return None, ".".join(path)
        known = [i.name for i in unit.instances] or [pou.name for pou in programs.values() if vendor]
        _fail(one, "no program of the configuration has this name", expected=", ".join(known) or "a CONFIGURATION")
    declared = {v.name.lower(): v for block in program.blocks for v in block.variables}
    name = path[1].partition("[")[0] if len(path) > 1 else ""
    variable = declared.get(name)
    if variable is None:
        _fail(one, f"{program.name} has no such variable", expected=", ".join(v.name for v in declared.values()))
    if len(path) > 2 or "[" in path[1]:
        return program, ".".join(path[1:])
    if one.location and (address_of(variable.location) or area_of(variable.location) != area_of(one.location)):
        wanted = f"{variable.name} AT %{area_of(one.location)}* in {program.name}"
        _fail(one, f"{variable.name} cannot get the address {one.location}", expected=wanted)
    return program, path[1]


def _with_values(pou: t.Pou, changed: dict[tuple[str, str], t.ConfiguredVariable]) -> t.Pou:
    def configured(v: t.VarDecl) -> t.VarDecl:
        one = changed.get((pou.name.lower(), v.name.lower()))
        if one is None:
            return v
        return replace(v, location=one.location or v.location, initial=one.initial or v.initial)

    return replace(
        pou, blocks=tuple(replace(b, variables=tuple(configured(v) for v in b.variables)) for b in pou.blocks)
    )


def _fail(one: t.ConfiguredVariable, message: str, *, expected: str) -> NoReturn:
    raise invalid(one.pos, f"VAR_CONFIG {'.'.join(one.path)}: {message}", expected)
