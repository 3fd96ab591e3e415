"""The state machines of a system's programs: their states and possible transitions."""

from __future__ import annotations

from fieldtwin.plc.binding import load_program
from fieldtwin.plc.states import StateTable
from fieldtwin.results.model import Machine
from fieldtwin.twin.site.system import System


def machines_of(system: System) -> tuple[Machine, ...]:
    """Return the state machine of every program that has a table (`fieldtwin.plc.states`).

    Raises `FileInvalid` for a program that cannot be created.
    """
    found = []
    for name, form in system.plc.programs.items():
        folder = [str(system.path.parent)]
        program = load_program(form.source, folder, dialect=form.dialect, libraries=form.libraries)
        table = getattr(program, "table", None)
        if isinstance(table, StateTable) and "state" in program.variables:
            steps = [(state, t.target) for state in table.states for t in table.leaving(state) if t.target != state]
            found.append(Machine(f"{name}.state", table.states, tuple(dict.fromkeys(steps))))
    return tuple(found)
