"""The description of a PLC's programs that does not change while they run: variables, states, transitions and source text.

The answer to the command `about`, for displays. Texts are limited in size, so that an answer fits in one line of the channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from sysconfig import get_paths
from typing import Any

from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.runtime.sources import ProgramSource
from fieldtwin.plc.states import ANY, StateTable

MAX_TEXT_BYTES = 128 * 1024
"""The largest size of the source text of one program. A larger one is not shown."""
MAX_TEXTS_BYTES = 1024 * 1024
"""The largest size of all source texts together. Further programs are described without their text."""
STATE = "state"
"""The variable that holds the code of a program's present state."""
PLCOPEN = ".xml"


def describe_programs(programs: Sequence[BoundProgram], sources: Sequence[ProgramSource]) -> dict[str, Any]:
    """Return the description of each program by its name, as data for JSON. `sources`: the files that the PLC has read."""
    left = MAX_TEXTS_BYTES
    described = {}
    for bound in programs:
        # the first source of a program is its own file; those of imported modules follow
        source = next((s for s in sources if s.program == bound.name), None)
        text = _text(source, min(left, MAX_TEXT_BYTES))
        left -= len(text["text"].encode())
        described[bound.name] = {"variables": _variables(bound), "machine": _machine(bound), "source": text}
    return described


def _variables(bound: BoundProgram) -> dict[str, Any]:
    tags = {v.name: tag for v, tag in bound.published()} | {name: b.tag for name, b in bound.inputs.items()}
    return {
        v.name: {
            "tag": tags.get(v.name, ""),
            "role": v.role.value,
            "kind": v.kind.value,
            "unit": v.unit,
            "type": v.type,
            "words": {str(code): word for code, word in v.words},
        }
        for v in bound.program.variables.values()
        if not v.hidden
    }


def _machine(bound: BoundProgram) -> dict[str, Any] | None:
    """Return the states and transitions of a program; None if its states have no names.

    Without a `StateTable`, or a CASE that assigns the states, no transitions are declared, and the initial state is not known.
    """
    state = bound.program.variables.get(STATE)
    if state is None or not state.words:
        return None
    names = [word for _, word in state.words]
    table = getattr(type(bound.program), "table", None)
    if not isinstance(table, StateTable):
        table = bound.program.state_diagram()
    if table is None or set(table.states) != set(names):
        return {"states": names, "initial": "", "transitions": [], "declared": False}
    transitions = [
        {"source": "" if t.source == ANY else t.source, "target": t.target, "label": t.label} for t in table.transitions
    ]
    return {"states": names, "initial": table.initial, "transitions": transitions, "declared": True}


def _text(source: ProgramSource | None, most: int) -> dict[str, Any]:
    """Return language, file name and text of a program's source. The text of a module of a library is empty."""
    path = Path(source.path) if source is not None and source.path else None
    if source is None or path is None:
        return {"language": "Python", "file": "", "text": "", "reason": "its source is not a file"}
    plcopen = path.suffix.lower() == PLCOPEN
    language = "Python" if not source.compiled else "PLCopen XML" if plcopen else "Structured Text"
    answer = {"language": language, "file": path.name, "text": "", "reason": ""}
    if not source.compiled and _is_library(path):
        return answer | {"reason": "it is a program of a library"}
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as e:
        return answer | {"reason": f"it cannot be read: {e.strerror or e}"}
    if len(data) > most:
        return answer | {"reason": f"it is larger than {most} bytes"}
    if not source.holds(data):
        return answer | {"reason": "the file has changed since the PLC read it"}
    return answer | {"text": data.decode("utf-8-sig", "replace")}


def _is_library(path: Path) -> bool:
    libraries = (get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    folders = [Path(__file__).parents[2], *map(Path, libraries)]
    return any(
        path.absolute().is_relative_to(folder.absolute()) or path.resolve().is_relative_to(folder.resolve())
        for folder in folders
    )
