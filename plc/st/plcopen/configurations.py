"""The configurations of a PLCopen XML file as Structured Text: tasks, and the programs that they run."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.plcopen.elements import Element
from fieldtwin.plc.st.syntax.parse import parse_expression
from fieldtwin.plc.st.syntax.tree import Pos, Ref

_DURATION = re.compile(r"L?T(?:IME)?#[0-9.dhmsun_]+", re.IGNORECASE | re.ASCII)
_ISO_DURATION = re.compile(r"PT(?:(\d+)H)?(?:(\d+)M)?(?:(\d+(?:\.\d+)?)S)?", re.ASCII)
"""The form in which CODESYS writes an interval, such as ``PT0.02S``."""


def configuration_text(configuration: Element, programs: Container[str]) -> str:
    """Return a ``<configuration>`` as Structured Text in one line. `programs` are the PROGRAMs of the file, in lower case.

    Tasks without a usable name, interval or trigger are left out, and so are programs that are not in the file, because the
    system file may state both.
    """
    parts = [f"CONFIGURATION {_name(configuration) or 'Config'}"]
    for number, resource in enumerate(one for one in configuration.children if one.tag == "resource"):
        parts.append(f"RESOURCE {_name(resource) or f'Resource{number}'} ON PLC")
        parts += _resource(resource, programs)
        parts.append("END_RESOURCE")
    return " ".join((*parts, "END_CONFIGURATION"))


def _resource(resource: Element, programs: Container[str]) -> Iterator[str]:
    tasks = [(task, _name(task), _values(task)) for task in resource.children if task.tag == "task"]
    for _, name, values in tasks:
        if name and values:
            yield f"TASK {name}({', '.join(values)});"
    running = [(task, f" WITH {name}" if name and values else "") for task, name, values in tasks]
    for place, within in ((resource, ""), *running):
        for instance in place.children:
            kind = instance.attributes.get("typeName", "")
            if instance.tag == "pouInstance" and _name(instance) and kind.lower() in programs:
                yield f"PROGRAM {_name(instance)}{within} : {kind};"


def _values(task: Element) -> list[str]:
    """Return the properties of a task; none if it has neither an interval nor a trigger."""
    interval, single, priority = (task.attributes.get(name, "").strip() for name in ("interval", "single", "priority"))
    found = [f"INTERVAL := {duration}" for duration in [_duration(interval)] if duration]
    if not found and single and _is_reference(single):
        found = [f"SINGLE := {single}"]
    if found and priority.isascii() and priority.isdigit():
        found.append(f"PRIORITY := {priority}")
    return found


def _duration(text: str) -> str:
    if _DURATION.fullmatch(text):
        return text
    found = _ISO_DURATION.fullmatch(text)
    parts = [f"{number}{unit}" for number, unit in zip(found.groups(), "hms", strict=True) if number] if found else []
    return f"T#{''.join(parts)}" if parts else ""


def _name(element: Element) -> str:
    """Return the name of an element; "" if it is not a valid name."""
    name = element.attributes.get("name", "")
    return name if name.isidentifier() and _is_reference(name) else ""


def _is_reference(text: str) -> bool:
    try:
        return isinstance(parse_expression(text, Pos(1, 1)), Ref)
    except FileInvalid:
        return False
