"""The tasks that the CONFIGURATION of a program's source states (IEC 61131-3:2013, 6.8.2), where the system file states none.

A project of OpenPLC or another tool that keeps to the standard has its tasks in the source. The system file has precedence: with
`tasks` or `cycle_ms` in its section `plc`, nothing is taken from a source.
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.plc.binding import text_source
from fieldtwin.plc.program import Role
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.configurations.instances import CompiledTask
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.program import instance_of, program_class
from fieldtwin.plc.st.project import compile_source
from fieldtwin.plc.st.syntax.addresses import address_of
from fieldtwin.twin.site.schema import PlcForm, ProgramForm, TaskForm

REST = "main"
"""The task of programs without a task. The standard executes them with the lowest priority."""
LOWEST_PRIORITY = 0xFFFF
MAX_INTERVAL_MS = 3_600_000


def with_configured_tasks(file: YamlFile, plc: PlcForm, folder: Path, errors: ErrorCollector) -> PlcForm:
    """Return `plc`, which states neither `tasks` nor `cycle_ms`, with the tasks that its programs have in their sources.

    A source with an error has no tasks here; its errors are found when the programs are compiled. Errors of tasks are added to
    `errors`.
    """
    found = {name: task for name, form in plc.programs.items() if (task := _task_of(form, folder)) is not None}
    if not found:
        return plc
    tasks: dict[str, TaskForm] = {}
    of_tasks: dict[str, CompiledTask] = {}
    programs: dict[str, ProgramForm] = {}
    for name, form in plc.programs.items():
        task = found.get(name)
        own = REST
        if task is not None:
            own = task.name
            if own == REST or of_tasks.get(own, task) != task:
                own = f"{name}_{task.name}"
            of_tasks[own] = task
        if form.task is None:
            programs[name] = form.model_copy(update={"task": own})
        else:
            programs[name] = form
    for own, task in of_tasks.items():
        with errors.collect():
            tasks[own] = _form(file, plc, folder, task)
    if any(form.task == REST for form in programs.values()) or all(form.single for form in tasks.values()):
        tasks[REST] = TaskForm(interval_ms=plc.cycle_ms, priority=LOWEST_PRIORITY)
    return plc.model_copy(update={"tasks": tasks, "programs": programs})


def _unit(form: ProgramForm, folder: Path) -> tuple[CompiledUnit, str] | None:
    """Return the compiled source of a program and the name in it; None for Python, for no CONFIGURATION, and for an error."""
    try:
        source = text_source(form.source, (str(folder),))
        if source is None or not any(b"configuration" in path.read_bytes().lower() for path in source_files(source[0])):
            return None
        libraries = tuple(folder / library for library in form.libraries)
        return compile_source(source[0], dialect_of(form.dialect), libraries), source[1]
    except (FieldtwinError, OSError):
        return None


def _task_of(form: ProgramForm, folder: Path) -> CompiledTask | None:
    found = _unit(form, folder)
    instance = instance_of(*found) if found is not None else None
    return instance.task if instance is not None else None


def _form(file: YamlFile, plc: PlcForm, folder: Path, task: CompiledTask) -> TaskForm:
    at: tuple[Key, ...] = ("plc", "programs")
    place = f"task {task.name} ({task.pos.path}:{task.pos.line})"
    hint = "or `tasks` in the system file, which then has all tasks"
    single = task.single if task.single.upper() not in ("FALSE", "0") else ""
    if single and task.interval_ns:
        raise file.error(at, f"{place} has SINGLE and INTERVAL", expected="one of them", hint=hint)
    if single:
        tag = _trigger(plc, folder, single)
        if tag is None:
            expected = "a located variable that a program offers, such as %IX0.0; an input has to be bound to a tag"
            raise file.error(at, f"{place} has an unknown trigger", expected=expected, got=single, hint=hint)
        return TaskForm(single=tag, priority=task.priority)
    interval_ms, rest = divmod(task.interval_ns, NS_PER_MS)
    if rest or not 1 <= interval_ms <= MAX_INTERVAL_MS:
        expected = f"INTERVAL of 1 to {MAX_INTERVAL_MS} whole ms"
        raise file.error(at, f"{place} has no usable interval", expected=expected, hint=hint)
    return TaskForm(interval_ms=interval_ms, priority=task.priority)


def _trigger(plc: PlcForm, folder: Path, single: str) -> str | None:
    """Return the tag of the variable that SINGLE names, of the first program that offers it; None if no program does."""
    for name, form in plc.programs.items():
        found = _unit(form, folder)
        if found is None:
            continue
        try:
            variables = program_class(*found).variables
        except FieldtwinError:
            continue
        for variable in variables.values():
            if single.lower() != variable.name.lower() and (
                not variable.address or address_of(single) != variable.address
            ):
                continue
            if variable.role is not Role.INPUT:
                return form.outputs.get(variable.name, f"{name}.{variable.name}")
            if variable.name in form.inputs:
                return form.inputs[variable.name].tag
    return None
