"""The variables of a symbolic execution: objects, lists and the local variables of calls, on one path after the other.

Objects and lists are those of a real program; only the values in them are symbolic. `Memory` notes each assignment on a path, so
that the values of two paths can be merged where they meet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fieldtwin.plc.st.model_checking.execution.merging import merged
from fieldtwin.plc.st.model_checking.execution.symbolic import UNDEFINED, Condition, both, negated


@dataclass(slots=True)
class _Slot:
    """A variable: an attribute of `owner`, or an item of it if `owner` is a list or a dictionary. `old` is its earlier value."""

    owner: Any
    key: Any
    old: Any

    def get(self) -> Any:
        if isinstance(self.owner, dict):
            return self.owner.get(self.key, UNDEFINED)
        return self.owner[self.key] if isinstance(self.owner, list) else getattr(self.owner, self.key, UNDEFINED)

    def put(self, value: Any) -> None:
        if isinstance(self.owner, dict | list):
            self.owner[self.key] = value
        else:
            setattr(self.owner, self.key, value)


_Journal = dict[tuple[int, Any], _Slot]


class Memory:
    """The assignments on the present path, and the conditions under which it is taken."""

    def __init__(self) -> None:
        self._path: list[Condition] = []
        self._journals: list[_Journal] = []

    @property
    def path(self) -> Condition:
        """Return the condition under which the present path is taken."""
        return both(*self._path)

    def put(self, owner: Any, key: Any, value: Any) -> None:
        """Assign `value` to an attribute or an item of `owner`."""
        slot = _Slot(owner, key, None)
        if self._journals:
            journal, place = self._journals[-1], (id(owner), key)
            if place not in journal:
                slot.old = slot.get()
                journal[place] = slot
        slot.put(value)

    def open(self, condition: Condition) -> None:
        """Begin a path that is taken if `condition` is true. `close` ends it."""
        self._path.append(condition)
        self._journals.append({})

    def close(self) -> None:
        """End the path that began last: each variable has its new value if the condition is true, else its earlier value."""
        condition = self._path[-1]
        for slot, new in self._undo():
            self.put(slot.owner, slot.key, merged(condition, new, slot.old))

    def branch(self, condition: Condition, yes: Callable[[], None], no: Callable[[], None]) -> None:
        """Execute `yes` if `condition` is true, else `no`; if it is not known, both, and merge the variables."""
        if isinstance(condition, bool):
            (yes if condition else no)()
            return
        self.open(condition)
        yes()
        after_yes = {(id(slot.owner), slot.key): (slot, new) for slot, new in self._undo()}
        self.open(negated(condition))
        no()
        after_no = {(id(slot.owner), slot.key): (slot, new) for slot, new in self._undo()}
        for place in after_yes | after_no:
            slot = (after_yes.get(place) or after_no[place])[0]
            a = after_yes[place][1] if place in after_yes else slot.old
            b = after_no[place][1] if place in after_no else slot.old
            self.put(slot.owner, slot.key, merged(condition, a, b))

    def _undo(self) -> list[tuple[_Slot, Any]]:
        """End a path: restore the variables that it assigned, and return them with the values that they had at its end."""
        self._path.pop()
        found = [(slot, slot.get()) for slot in self._journals.pop().values()]
        for slot, _ in found:
            slot.put(slot.old)
        return found
