"""The interface of a program to the process image, which is laid out once and therefore cannot change while a PLC runs.

Variables to which the system file binds tags, and those that other programs read, have to stay as they are. Any other local
variable or output may be added and removed: a new one has no tag until the system is run again, and the tag of a removed one has
no value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.program import Role, Variable
from fieldtwin.plc.st.program import StProgram, with_interface


def fitted(
    made: type[StProgram], running: BoundProgram, readers: Mapping[str, list[str]]
) -> tuple[type[StProgram], list[str]]:
    """Return the class `made` with the interface of the program that runs, and the reasons why it cannot replace that program.

    `readers` has, by tag, what uses variables of programs, such as ``program pump`` or ``alarm high``.
    """
    before, after = running.program.variables, made.variables
    reasons = [*_bound(running, before, after, readers), *_added(running, after)]
    if before == after:
        return made, reasons
    return with_interface(made, before), reasons


def _bound(
    running: BoundProgram,
    before: Mapping[str, Variable],
    after: Mapping[str, Variable],
    readers: Mapping[str, list[str]],
) -> Iterator[str]:
    tags = {v.name: tag for v, tag in running.published()} | {name: b.tag for name, b in running.inputs.items()}
    for name, old in before.items():
        new, user, form = after.get(name), "", _form
        remedy = "change its user as well and restart the run"
        if name in running.inputs or name in running.outputs:
            user = f"the system file binds it to {tags[name]}"
            remedy = "change the system file as well and restart the run"
        elif old.kind is TagKind.MESSAGE:
            user = "its messages are in the process image"
        elif used_by := readers.get(tags.get(name, "")):
            user = f"{_listed(used_by)} use{'s' if len(used_by) == 1 else ''} it"
            remedy, form = _remedy(used_by), _read_form
        if new is None:
            if user:
                yield f"{old.role.value} {name} is removed, but {user}: keep it, or {remedy}"
        elif user and form(old) != form(new):
            change = f"({_text(old)} -> {_text(new)})"
            yield f"{old.role.value} {name} changes {change}, but {user}: keep its declaration, or {remedy}"
        elif renamed := _renamed(old, new):
            yield (
                f"{name} has other numbers for its values, which displays would name wrongly: {renamed}: keep the number of "
                "each name and use new numbers for new names, or restart the run"
            )


def _added(running: BoundProgram, after: Mapping[str, Variable]) -> Iterator[str]:
    for name, new in after.items():
        if new.role is Role.INPUT and new.needs_tag and name not in running.inputs:
            yield (
                f"input {name} is new, and the system file has to bind it to a tag: add it there and restart the run, or "
                "declare it in VAR"
            )
        elif new.kind is TagKind.MESSAGE and name not in running.program.variables:
            yield f"output {name} is new, and its messages need a place in the process image: restart the run"


def _remedy(users: Sequence[str]) -> str:
    """Return what else can be done if `users` prevent the change. Servers follow the addresses in the source at a start."""
    changed = [user for user in users if not user.startswith("server ")]
    return f"change {_listed(changed)} as well and restart the run" if changed else "restart the run"


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _form(v: Variable) -> tuple[object, ...]:
    return v.role, v.kind, v.max_bytes, v.depth


def _read_form(v: Variable) -> tuple[object, ...]:
    """Return the properties on which what reads a variable depends: an output may become a local, and the reverse."""
    return v.role is Role.INPUT, v.kind


def _text(v: Variable) -> str:
    size = f"[{v.max_bytes}, {v.depth}]" if v.max_bytes else ""
    return f"{v.role.value} of kind {v.kind.value}{size}"


def _renamed(old: Variable, new: Variable) -> str:
    """Return the first number whose name differs; "" if all names are the same. The process image holds the names."""
    names = dict(new.words)
    for number, word in old.words:
        if names.get(number, word) != word:
            return f"{number} was {word} and is {names[number]}"
    return ""
