"""Global variables that programs of different tasks write."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from fieldtwin.plc.st.dialects import StWarning
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes


def written_by_several_tasks(unit: t.SourceUnit, tasks: Mapping[str, str]) -> Iterator[StWarning]:
    """Yield a finding for each global variable that programs of several tasks write, also through function blocks and functions.

    `tasks` has the task of each PROGRAM, or program of a configuration, that the PLC runs; "" stands for the only PROGRAM.
    """
    pous = {pou.name.lower(): pou for pou in unit.pous}
    programs = [pou for pou in unit.pous if pou.kind == "PROGRAM"]
    of_instances = {one.program.lower(): tasks[one.name.lower()] for one in unit.instances if one.name.lower() in tasks}
    tasks = {**of_instances, **tasks}
    shared = {v.name.lower(): v.name for block in unit.globals for v in block.variables}
    first: dict[str, tuple[t.Pou, str]] = {}
    reported: set[str] = set()
    for program in programs:
        task = tasks.get(program.name.lower(), tasks.get("") if len(programs) == 1 else None)
        if task is None:
            continue
        for name, pos in _written(program, pous, frozenset(shared)).items():
            other, other_task = first.setdefault(name, (program, task))
            if other_task != task and name not in reported:
                reported.add(name)
                message = (
                    f"{shared[name]} is written by {other.name} (task {other_task}) and {program.name} (task {task})"
                )
                yield StWarning("ST108", message, pos.path, pos.line, pos.column)


def _written(program: t.Pou, pous: Mapping[str, t.Pou], shared: frozenset[str]) -> dict[str, t.Pos]:
    """Return the global variables that a program writes, each with a place."""
    found: dict[str, t.Pos] = {}
    waiting, seen = [(program, frozenset[str]())], {program.name.lower()}
    while waiting:
        pou, outer = waiting.pop()
        own = outer | {v.name.lower() for b in pou.blocks if b.kind != "VAR_EXTERNAL" for v in b.variables}
        waiting += [(method, own) for method in pou.methods]
        if pou.kind == "INTERFACE":
            waiting += [(one, frozenset()) for one in _implementing(pou, pous) if one.name.lower() not in seen]
        for node in nodes((pou.blocks, pou.body, pou.actions, pou.chart, pou.extends)):
            for ref in _targets(node):
                if ref.name.lower() in shared - own:
                    found.setdefault(ref.name.lower(), ref.pos)
            used = node.name if isinstance(node, t.NamedType) else node.ref.name if isinstance(node, t.Call) else ""
            if used.lower() in pous and used.lower() not in seen:
                seen.add(used.lower())
                waiting.append((pous[used.lower()], frozenset()))
    return found


def _implementing(interface: t.Pou, pous: Mapping[str, t.Pou]) -> Iterator[t.Pou]:
    """Yield the POUs that implement or extend an interface; a call through it can execute their methods."""
    for pou in pous.values():
        if interface.name.lower() in (name.name.lower() for name in (*pou.implements, *pou.extends)):
            yield pou


def _targets(node: object) -> Iterator[t.Ref]:
    if isinstance(node, t.Assign):
        yield node.target
    elif isinstance(node, t.For):
        yield node.variable
    elif isinstance(node, t.Argument) and node.target is not None:
        yield node.target
    elif isinstance(node, t.Association):
        yield t.Ref(node.pos, node.action)
