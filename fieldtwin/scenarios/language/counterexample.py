"""Write the shortest counterexample that a proof (`fieldtwin.plc.prove`) found for a PLC program as a scenario.

The steps are the inputs that can be caused from outside, in scan order. A proof's scans are closer together than messages on a
bus, so the scenario keeps only their order and their minimum spacing. It ends with a check: the outputs that the broken program
showed must never be seen. Inputs that cannot be caused from outside (a mailbox that is not emptied, a user-defined payload)
appear in it as comments.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.core.statemachine import decode_period
from fieldtwin.gateway.core.values import COMMAND, Quality, TagValue
from fieldtwin.plc.program import Program
from fieldtwin.plc.prove import Given, Proof, SearchResult, shown
from fieldtwin.twin.site.system import System

ARRIVES = "5s"
"""Time that the last input may take to reach the program."""
_NEEDS = {"send": "send_command", "set": "set_value", "fault": "inject_fault", "clear": "inject_fault"}


def scenario(system: System, program: str, proof: Proof, result: SearchResult) -> str:
    """Return a scenario file (docs/reference/scenarios.md) for the counterexample `result` of `program`."""
    comment = f"The shortest way that was found ({len(result.way)} scans) to where this does not hold: {result.broken}"
    never = outputs_seen(system, program, proof, result.way)
    requirement = proof.requirement.get(result.broken, "")
    return scenario_file(system, program, result.broken, comment, proof.make(), result.way, never, requirement)


def scenario_file(
    system: System, program: str, broken: str, comment: str, made: Program, way: Sequence[Given], never: str,
    requirement: str = "",
) -> str:  # fmt: skip
    """Return a scenario file with the inputs of `way`, which violates the invariant `broken` of `program`.

    `made` is the program, and `never` a condition of scenarios that must never be true ("" for none).
    """
    steps = list(_steps(system, program, made, way))
    needs = list(dict.fromkeys(_NEEDS[word] for word, _ in steps if word in _NEEDS))
    lines = [
        f"# {comment}",
        f"scenario: {_text(f'{program}: {broken}')}",
        f"system: {_text(system.path.name)}",
    ]
    if needs:
        lines.append(f"needs: [{', '.join(needs)}]")
    if requirement:
        lines.append(f"requirements: [{_text(requirement)}]")
    if never:
        lines += ["never:", f"  - {_text(never)}"]
    lines.append("steps:")
    lines += [f"  # {what}" if word == "#" else f"  - {word}: {what}" for word, what in steps]
    lines.append(f"  - pause: {ARRIVES}")
    return "\n".join(lines) + "\n"


def _text(text: str) -> str:
    """Return `text` as a YAML string, whatever characters it contains."""
    return json.dumps(text, ensure_ascii=False)


def outputs_seen(system: System, program: str, proof: Proof, way: Sequence[Given]) -> str:
    """Return the outputs that the broken program showed, as an expression ``PROGRAM.VARIABLE == VALUE and ...``.

    Outputs that are bound to a device are left out, because the device's tag covers them.
    """
    bound = system.plc.programs[program].outputs
    words = {v.name: dict(v.words) for v in proof.make().variables.values()}
    parts = []
    for name, value in shown(proof, way).items():
        if name not in bound and value is not None:
            word = words[name].get(value) if isinstance(value, int) else None
            parts.append(f"{program}.{name} == {repr(word) if word else repr(value)}")
    return " and ".join(parts)


def _steps(system: System, program: str, made: Program, way: Sequence[Given]) -> Iterator[tuple[str, str]]:
    """Yield (keyword, argument) for each step; the keyword ``#`` is a comment."""
    bindings = system.plc.programs[program].inputs
    before: dict[str, Any] = {}
    bad: set[str] = set()
    waited_ms = 0.0
    for given in way:
        waited_ms += given.ms
        told: list[tuple[str, str]] = []
        for name, value in given.inputs:
            tag = bindings[name].tag if name in bindings else f"{program}.{name}"
            if made.variables[name].kind is TagKind.MESSAGE:
                told += [] if value is None else [_message(tag, value)]
            elif name not in before or before[name] != value:
                told += _input(tag, value, bad)
            before[name] = value
        if not given.taken:
            told.append(("#", "no receiver takes the messages that the program sent"))
        if told:
            yield "pause", f"{waited_ms:g}ms"
            waited_ms = 0.0
            yield from told
    if waited_ms:
        yield "pause", f"{waited_ms:g}ms"


def _message(tag: str, data: bytes) -> tuple[str, str]:
    if tag.endswith(".inbox") and len(data) == 2:
        return "send", f"{{from: topside, period_s: {decode_period(COMMAND(data))}}}"
    return "#", f"a message of {tag}: {data.hex() or 'empty'}"


def _input(tag: str, value: Any, bad: set[str]) -> Iterator[tuple[str, str]]:
    """Yield the steps that set an input `tag` to `value`. `bad` collects the devices that a fault has silenced."""
    device = tag.partition(".")[0]
    if isinstance(value, TagValue):
        if value.quality not in (Quality.GOOD, Quality.BAD):
            yield "#", f"{tag} is {value.quality}"
        value = None if value.quality is Quality.BAD else value.value
    if value is None:
        if device not in bad:
            yield "fault", f"{{id: {_text(f'no-{device}')}, name: silence, device: {_text(device)}}}"
            bad.add(device)
        return
    if device in bad:
        yield "clear", _text(f"no-{device}")
        bad.discard(device)
    yield "set", f"{{tag: {_text(tag)}, value: {json.dumps(value)}}}"
