"""Record the actions of clients on a prototype, and the reactions of its tags and programs, as a scenario.

A `Recorder` notes actions and changes of one instance; `fieldtwin.studio.scenarios.proposal` turns its `Recording` into a
scenario file.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.runtime.about import STATE
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.twin.prototype.field_status import FieldStatus

LOOK_EVERY_S = 0.25
MOST_ACTIONS = 500
MOST_CHANGES = 50_000
LONGEST_S = 3600.0

Words = Mapping[str, Mapping[int, str]]
"""For each tag PROGRAM.state, the name of each of its values."""


class Action(NamedTuple):
    """An action of a client. `step` is a step of a scenario; without one, `note` describes an action that a scenario cannot
    express.
    """

    t_ns: int
    step: dict[str, Any] | None
    note: str = ""

    @property
    def said(self) -> str:
        """Return the action as text for the user."""
        if self.step is None:
            return self.note
        [(word, what)] = self.step.items()
        if word == "set":
            return f"release {what['tag']}" if what["value"] is None else f"set {what['tag']} to {what['value']}"
        if word == "clear":
            return f"clear {what}"
        return f"inject {what['name']}" + "".join(f", {key} {what[key]}" for key in what if key not in ("name", "id"))


class Seen(NamedTuple):
    """The quality of a tag from `t_ns` on. The value is recorded only for tags whose value a client has set."""

    t_ns: int
    value: Any
    quality: str
    reason: str


class State(NamedTuple):
    """A state of a program from `t_ns` on."""

    t_ns: int
    word: str


@dataclass
class Recording:
    """The actions and observations between two instants on the run's monotonic clock."""

    begin_ns: int
    end_ns: int = 0
    actions: list[Action] = field(default_factory=list)
    tags: dict[str, list[Seen]] = field(default_factory=dict)
    states: dict[str, list[State]] = field(default_factory=dict)
    is_full: bool = False
    """Whether observations are missing because there were too many."""


class Recorder:
    """The recorder of one instance, from `begin` to `end`. It samples four times a second, so shorter changes can be missed."""

    def __init__(self, attachment: Attachment) -> None:
        self.attachment = attachment
        self.recording = Recording(attachment.now_ns())
        self._set: set[str] = set()
        self._changes = 0
        self._nursery = Nursery()

    async def begin(self) -> None:
        """Begin to record. Raises `UsageError` if faults or forces are active, because the scenario would not contain them."""
        field_now = await self.attachment.field_channel.ask("get", FieldStatus)
        plc = self.attachment.plc
        active = [*(fault.id for fault in field_now.faults), *(f"set {tag}" for tag in field_now.set)]
        active += [f"force on {tag}" for tag in (plc.forces if plc is not None else {})]
        if active:
            raise UsageError(
                "a recording begins without faults, set values and forces, because the scenario would not have them",
                got=", ".join(active)[:200],
                hint="clear them first",
            )
        self._look()
        self._nursery.start(self._watch(), "scenario recorder")

    async def end(self) -> Recording:
        """End the recording, and return it."""
        self.recording.end_ns = self.recording.end_ns or self.attachment.now_ns()
        await self._nursery.__aexit__(None, None, None)
        return self.recording

    @property
    def has_ended(self) -> bool:
        """Return whether the recording has ended by itself, after `LONGEST_S` or `MOST_ACTIONS`."""
        return self.recording.end_ns > 0

    def note(self, t_ns: int, step: dict[str, Any] | None, note: str = "") -> None:
        """Note an action of a client. After `MOST_ACTIONS` the recording ends."""
        if self.has_ended:
            return
        if step is not None and "clear" in step and step["clear"] not in self._faults():
            note = f"clear {step['clear']}, which another program had injected"
            step = None
        self.recording.actions.append(Action(t_ns, step, note))
        if step is not None and "set" in step:
            self._set.add(step["set"]["tag"])
            self._look()  # the value before the gateway reads the set one
        if len(self.recording.actions) >= MOST_ACTIONS:
            self.recording.end_ns = self.attachment.now_ns()

    def _faults(self) -> set[str]:
        steps = (action.step or {} for action in self.recording.actions)
        return {step["fault"]["id"] for step in steps if "fault" in step}

    async def _watch(self) -> None:
        while not self.has_ended:
            self._look()
            if self.attachment.now_ns() - self.recording.begin_ns > LONGEST_S * 1e9:
                self.recording.end_ns = self.attachment.now_ns()
            await asyncio.sleep(LOOK_EVERY_S)

    def _look(self) -> None:
        now_ns = self.attachment.now_ns()
        for name in self.attachment.history.names():
            point = self.attachment.history.at(name, now_ns)
            if point is not None:
                value = point.value if name in self._set else None
                self._add_tag(name, Seen(point.t_ns, value, point.quality, point.reason))
        variables = self.attachment.plc.variables if self.attachment.plc is not None else {}
        for name, words in self._state_words().items():
            word = words.get(variables.get(name, -1))
            states = self.recording.states.setdefault(name, [])
            if word is not None and (not states or states[-1].word != word) and self._has_room():
                states.append(State(now_ns, word))

    def _state_words(self) -> Words:
        """Return the names of the programs' states, as the PLC describes them; empty until the PLC has answered."""
        variables = {name: program["variables"].get(STATE) for name, program in self.attachment.programs.items()}
        return {
            f"{name}.{STATE}": {int(code): word for code, word in state["words"].items()}
            for name, state in variables.items()
            if state is not None and state["words"]
        }

    def _add_tag(self, name: str, seen: Seen) -> None:
        changes = self.recording.tags.setdefault(name, [])
        if (not changes or changes[-1][1:] != seen[1:]) and self._has_room():
            changes.append(seen)

    def _has_room(self) -> bool:
        self._changes += 1
        self.recording.is_full = self._changes > MOST_CHANGES
        return not self.recording.is_full
