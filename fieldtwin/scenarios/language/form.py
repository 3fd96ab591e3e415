"""Reads a scenario file and checks it against its system: every error has file, line, column and the nearest known word."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from fieldtwin.emulators.faults.schema import FaultSpec, checked, parse_fault, seconds
from fieldtwin.gateway.core.conditions.expression import QUALITIES, Expression, Words
from fieldtwin.gateway.core.conditions.located_expression import read_expression
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError, collecting
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate
from fieldtwin.gateway.runtime.alarms.state_machine import ALARM_STATES
from fieldtwin.scenarios.bench import Can
from fieldtwin.scenarios.language.invariants import Invariants
from fieldtwin.scenarios.language.names import incomplete_parts, invariants_of, names_of
from fieldtwin.scenarios.language.probe_form import ScenarioProbe, read_probe
from fieldtwin.scenarios.language.words import (
    WORDS,
    BoundsForm,
    Cycle,
    Expect,
    Rate,
    ScenarioForm,
    Set,
    Step,
    Time,
    WireForm,
)
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.group import SystemGroup, load_group
from fieldtwin.twin.site.system import System, load_system

_TOGETHER = {
    "tag": ("tag", "value", "tolerance", "quality", "like", "within", "during"),
    "updates": ("tag", "quality", "updates_per_s", "during"),
    "wire": ("wire", "access", "function", "register", "value", "times", "within"),
    "rate": ("wire", "access", "function", "register", "value", "requests_per_s", "during"),
    "that": ("that", "within", "during"),
}
"""The permitted keys of an expectation for each subject (`tag`, `wire`, `that`)."""


@dataclass(frozen=True)
class Scenario:
    """A scenario file, checked against its system."""

    path: Path
    form: ScenarioForm
    file: YamlFile
    system: System
    needs: tuple[Can, ...]
    always: tuple[Expression, ...]
    never: tuple[Expression | WireForm, ...]
    known: tuple[str, ...] = ()
    """The names that expressions may contain."""
    own: tuple[str, ...] = ()
    """The names in `known` that belong to the system, without those of probes."""
    words: Mapping[str, Words] = field(default_factory=dict)
    """The texts that the system's names can equal, as `names_of` returns them."""
    probes: tuple[ScenarioProbe, ...] = ()
    profiles: tuple[Path, ...] = ()
    group: SystemGroup | None = None
    """The group of systems, if the scenario names a group; `system` is then `group.whole`."""
    used: set[str] = field(default_factory=set, compare=False)
    """The tags and variables that the scenario uses."""
    invariants: Invariants = field(default_factory=Invariants)
    """The invariants of the system file, or of each system file of the group."""
    incomplete: frozenset[str] = frozenset()
    """The devices, buses and programs that have errors in the system file, so that references to them cannot be checked."""

    def line(self, *loc: Key) -> str:
        """Return FILE:LINE of a part of the scenario."""
        line, _ = self.file.positions.get(loc, (1, 1))
        return f"{self.path}:{line}"

    def expression(self, text: str, *loc: Key) -> Expression:
        """Return `text` as an expression. Raises `FileInvalid` with its place."""
        expression = read_expression(self.file, loc, text, self.known, self.words, incomplete=self.incomplete)
        self.used.update(expression.names)
        return expression


def load_scenario(path: Path, profiles: tuple[Path, ...] = (), errors: ErrorCollector | None = None) -> Scenario:
    """Read a scenario and check it. Raises `FileInvalid`, `UsageError`.

    With `errors`, the errors of its separate parts, and those of its system file, are added to it; the result must not be
    run then.
    """
    return read_scenario(load(path), path, profiles, errors)


def read_scenario(
    file: YamlFile, path: Path, profiles: tuple[Path, ...] = (), errors: ErrorCollector | None = None
) -> Scenario:
    """Check a parsed scenario, as `load_scenario` does. References to other files are relative to the folder of `path`."""
    _check_one_thing(file)
    form = validate(file, ScenarioForm)
    with collecting(errors) as collector:
        return _resolve(path, file, form, profiles, collector)


def _resolve(
    path: Path, file: YamlFile, form: ScenarioForm, profiles: tuple[Path, ...], errors: ErrorCollector
) -> Scenario:
    system, group = _system(file, form, profiles, errors)
    served = [one.name for one in system.serving.serve]
    probes: list[ScenarioProbe] = []
    for name, one in form.probes.items():
        with errors.collect():
            probes.append(read_probe(file, name, one, served))
            if name in system.devices or name in system.plc.programs:
                raise file.error(("probes", name), f"{name!r} is already a device or program of the system")
    own = names_of(system, group, errors)
    incomplete = incomplete_parts(system) if group is None else frozenset()
    known = tuple(dict.fromkeys([*own, *(name for probe in probes for name in probe.names)]))
    scenario = Scenario(
        path,
        form,
        file,
        system,
        _needs(file, form, errors),
        (),
        (),
        known,
        tuple(own),
        own,
        tuple(probes),
        profiles,
        group,
        invariants=invariants_of(system, group, errors),
        incomplete=incomplete,
    )
    always: list[Expression] = []
    for n, text in enumerate(form.always):
        with errors.collect():
            always.append(_looks(scenario, text, ("always", n)))
    never: list[Expression | WireForm] = []
    for n, banned in enumerate(form.never):
        with errors.collect():
            if isinstance(banned, str):
                never.append(_looks(scenario, banned, ("never", n)))
            else:
                _check_wire(scenario, banned.wire, banned.register_, banned.value, ("never", n))
                if banned.unless is not None:
                    scenario.expression(banned.unless, "never", n, "unless")
                never.append(banned)
    scenario = replace(scenario, always=tuple(always), never=tuple(never))
    _check_whole_run(scenario, errors)
    for n, tag in enumerate(form.refused):
        with errors.collect():
            _known(file, ("refused", n), "tag", tag, scenario.own, incomplete)
            _refuse_alarm(scenario, tag, ("refused", n), "written", "a tag that a program writes")
            scenario.used.add(tag)
    faults: list[str] = []
    for n, step in enumerate(form.steps):
        with errors.collect():
            _check_step(scenario, step, n)
        if step.fault is not None:
            faults.append(str(step.fault.get("id", f"step {n + 1}")))
        if step.clear is not None:
            with errors.collect():
                _known(file, ("steps", n, "clear"), "fault of an earlier step", step.clear, faults)
    return scenario


def _check_one_thing(file: YamlFile) -> None:
    """Check that each step has only one keyword, before the contents are checked. Two are usually caused by a missing hyphen."""
    steps = file.data.get("steps")
    for n, step in enumerate(steps if isinstance(steps, list) else ()):
        said = [word for word in step if word in WORDS] if isinstance(step, dict) else []
        if len(said) > 1:
            raise file.error(
                ("steps", n), "a step has exactly one key", expected=" or ".join(WORDS), got=", ".join(said)
            )


def _system(
    file: YamlFile, form: ScenarioForm, profiles: tuple[Path, ...], errors: ErrorCollector
) -> tuple[System, SystemGroup | None]:
    """Return the system that the scenario names, from its own folder or the shipped ones, and None.

    If it names a group of systems, return `group.whole` and the group.
    """
    folder = Path(file.path).parent
    beside = folder / form.system
    named = str(beside) if beside.exists() else form.system.removesuffix(".yaml")
    try:
        group = load_group(named, profiles)
        if group is not None:
            _check_of_group(file, form, group)
            return group.whole, group
        system = load_system(named, list(profiles), errors)
    except UsageError as e:
        raise file.error(("system",), e.message, expected=e.expected, got=e.got, hint=e.hint) from e
    if form.prototype is not None and not (folder / form.prototype).is_file():
        there = [one.name for one in sorted(folder.glob("*.yaml"))]
        hint = did_you_mean(form.prototype, there)
        errors.add(file.error(("prototype",), f"no file {form.prototype!r} in the same folder", hint=hint))
    return system, None


def _needs(file: YamlFile, form: ScenarioForm, errors: ErrorCollector) -> tuple[Can, ...]:
    words = [can.value for can in Can]
    asked = []
    for n, need in enumerate(form.needs):
        with errors.collect():
            _known(file, ("needs", n), "need", need, words)
            asked.append(Can(need))
    if form.probes:
        asked.append(Can.PROBE)
    if form.start is not None:
        asked.append(Can.FRESH_START)
    if form.judge is not None:
        asked.append(Can.JUDGE_RUN)
    if any(isinstance(one, WireForm) for one in form.never) or any(one.wire is not None for one in form.rate):
        asked.append(Can.SEE_WIRE)
    asked += [need for step in form.steps for need in needs_of(step)]
    return tuple(dict.fromkeys(asked))


_IMPLIED = {
    "send": Can.SEND_COMMAND,
    "set": Can.SET_VALUE,
    "fault": Can.INJECT_FAULT,
    "clear": Can.INJECT_FAULT,
    "acknowledge": Can.ACKNOWLEDGE,
}


def needs_of(step: Step) -> list[Can]:
    """Return the capabilities of a target that a step needs."""
    needs = [need for word, need in _IMPLIED.items() if getattr(step, word) is not None]
    if step.expect is not None and step.expect.wire is not None:
        needs.append(Can.SEE_WIRE)
    if step.expect is not None and step.expect.like is not None:
        needs.append(Can.SEE_HELD)
    return needs


def _check_step(scenario: Scenario, step: Step, n: int) -> None:
    file, loc = scenario.file, ("steps", n)
    said = [word for word in WORDS if getattr(step, word) is not None]
    if len(said) != 1:
        raise file.error(
            loc, "a step has exactly one key", expected=" or ".join(WORDS), got=", ".join(said) or "nothing"
        )
    try:
        if step.fault is not None:
            spec = parse_fault(step.fault, file, (*loc, "fault"), n + 1)
            checked(lambda one: _aim(scenario, one), spec, file, (*loc, "fault"))
        if step.wait is not None:
            _looks(scenario, step.wait.until, (*loc, "wait", "until"))
            _time(file, (*loc, "wait", "within"), step.wait.within)
        if step.pause is not None:
            _time(file, (*loc, "pause"), step.pause)
        if step.set is not None:
            _check_set(scenario, step.set, (*loc, "set"))
        if step.acknowledge is not None:
            alarms = [name for name, words in scenario.words.items() if words is ALARM_STATES]
            _known(file, (*loc, "acknowledge"), "alarm", step.acknowledge, alarms)
        if step.expect is not None:
            _check_expect(scenario, step.expect, (*loc, "expect"))
    except UsageError as e:
        raise file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint) from e


def _check_set(scenario: Scenario, said: Set, loc: tuple[Key, ...]) -> None:
    _known(scenario.file, (*loc, "tag"), "tag", said.tag, scenario.own, scenario.incomplete)
    _refuse_alarm(scenario, said.tag, (*loc, "tag"), "set", "a tag that the condition of the alarm uses")
    device, _, name = said.tag.rpartition(".")
    found = scenario.system.devices.get(device)
    if found is None or name not in found.profile.tags or said.value is None:
        return
    if found.profile.tags[name].is_text != isinstance(scenario.system.number_of(said.tag, said.value), str):
        wanted = "a text" if found.profile.tags[name].is_text else "a number"
        names = [one for _, one in found.profile.tags[name].values]
        hint = did_you_mean(str(said.value), names)
        raise scenario.file.error(
            (*loc, "value"), f"{said.tag} is {wanted}", expected=", ".join(names), got=repr(said.value), hint=hint
        )


def _refuse_alarm(scenario: Scenario, name: str, loc: tuple[Key, ...], what: str, expected: str) -> None:
    if scenario.words.get(name) is ALARM_STATES:
        raise scenario.file.error(loc, f"{name!r} is an alarm, which cannot be {what}", expected=expected)


def _aim(scenario: Scenario, spec: FaultSpec) -> None:
    """Check a fault's target. Raises `WrongAim` if neither the system nor the shared medium of a group contains it."""
    if not scenario.incomplete.isdisjoint((spec.aim.device, spec.aim.bus)):
        raise FollowingError("a part of the system has an error", path=scenario.file.path)
    if scenario.group is not None:
        scenario.group.check_fault(spec)
    else:
        target(scenario.system, spec)


def _check_of_group(file: YamlFile, form: ScenarioForm, group: SystemGroup) -> None:
    """Raise an error for keys that a scenario of a group may not have, because they apply to one system only."""
    for key in ("probes", "prototype"):
        if getattr(form, key):
            raise file.error(
                (key,), f"{key!r} has no meaning for a {group.kind}", expected="a scenario of one of its systems"
            )


def _check_expect(scenario: Scenario, expect: Expect, loc: tuple[Key, ...]) -> None:
    said = [word for word in ("tag", "wire", "that") if getattr(expect, word) is not None]
    if len(said) != 1:
        raise scenario.file.error(
            loc, "an expectation has exactly one of tag, wire and that", expected="tag, wire or that"
        )
    kind = "rate" if expect.requests_per_s is not None else "updates" if expect.updates_per_s is not None else said[0]
    for name in sorted(expect.model_fields_set):
        key = type(expect).model_fields[name].alias or name
        if key not in _TOGETHER[kind]:
            raise scenario.file.error(
                (*loc, key), f"{key!r} has no meaning for this expectation", expected=", ".join(_TOGETHER[kind])
            )
    if kind in ("rate", "updates") and expect.during is None:
        raise scenario.file.error(loc, "a rate needs a time", expected="during: 10s")
    _check_numbers(scenario.file, expect, loc)
    if expect.quality is not None:
        _known(scenario.file, (*loc, "quality"), "quality", expect.quality, QUALITIES)
    if expect.tag is not None:
        _known(scenario.file, (*loc, "tag"), "tag", expect.tag, scenario.known, scenario.incomplete)
        words = scenario.words.get(expect.tag, ())
        if words is ALARM_STATES and expect.value is not None and not isinstance(expect.value, str):
            expected, got = ", ".join(ALARM_STATES), repr(expect.value)
            raise scenario.file.error((*loc, "value"), f"the state of {expect.tag}", expected=expected, got=got)
        if words and isinstance(expect.value, str):
            _known(scenario.file, (*loc, "value"), f"value of {expect.tag}", expect.value, tuple(words))
        elif isinstance(words, Mapping) and isinstance(expect.value, str):
            raise scenario.file.error((*loc, "value"), f"{expect.tag} is a number", got=repr(expect.value))
        scenario.used.add(expect.tag)
    if expect.like is not None and (expect.tag or "").rpartition(".")[0] not in scenario.system.devices:
        raise scenario.file.error((*loc, "like"), "`like: device` needs a tag of a device", expected="tag: DEVICE.TAG")
    if expect.wire is not None:
        _check_wire(scenario, expect.wire, expect.register_, expect.value, loc)
    if expect.that is not None:
        _looks(scenario, expect.that, (*loc, "that"))


def _check_wire(scenario: Scenario, device: str, register: str | None, value: object, loc: tuple[Key, ...]) -> None:
    """Check that `register` is a tag of the device. A `value` needs a register: without one it would never match."""
    _known(scenario.file, (*loc, "wire"), "device", device, list(scenario.system.devices), scenario.incomplete)
    if register is not None:
        tags = scenario.system.devices[device].profile.tags
        _known(scenario.file, (*loc, "register"), f"tag of {device}", register, tuple(tags))
        if isinstance(value, str) and not tags[register].is_text:
            raise scenario.file.error((*loc, "value"), f"{device}.{register} is a number", got=repr(value))
    elif value is not None:
        raise scenario.file.error((*loc, "value"), "the register of the value is missing", expected="register: TAG")


def _check_numbers(file: YamlFile, expect: Expect, loc: tuple[Key, ...]) -> None:
    """Check the times, and that the bounds can be both met and missed."""
    if expect.during is not None and _time(file, (*loc, "during"), expect.during) <= 0:
        raise file.error((*loc, "during"), "an observation needs a time above 0", expected="during: 10s")
    if expect.within is not None:
        _time(file, (*loc, "within"), expect.within)
    _check_bounds(file, (*loc, "requests_per_s"), expect.requests_per_s)
    _check_bounds(file, (*loc, "times"), expect.times if isinstance(expect.times, BoundsForm) else None)
    rate = list(expect.updates_per_s or (0, 0))
    if len(rate) != 2 or rate[0] > rate[1]:
        raise file.error(
            (*loc, "updates_per_s"), "a rate needs bounds: [LOWEST, HIGHEST]", expected="[9, 11]", got=str(rate)
        )


def _looks(scenario: Scenario, text: str, loc: tuple[Key, ...]) -> Expression:
    """Return `text` as an expression that names at least one tag or variable. Raises `FileInvalid` for a constant."""
    expression = scenario.expression(text, *loc)
    if expression.is_constant:
        raise scenario.file.error(
            loc, "the expression refers to no value", expected="a tag or a variable in it", got=text
        )
    return expression


def _check_bounds(file: YamlFile, loc: tuple[Key, ...], bounds: BoundsForm | None) -> None:
    if bounds is None:
        return
    if bounds.min is None and bounds.max is None:
        raise file.error(loc, "these bounds are always met", expected="min or max")
    if bounds.max is None and bounds.min is not None and bounds.min <= 0:
        got = f"min {bounds.min:g}"
        raise file.error(loc, "these bounds are always met", expected="min above 0, or max", got=got)
    if bounds.max is not None and bounds.max < 0:
        raise file.error(
            loc, "a count or a rate is never negative", expected="max of 0 or more", got=f"max {bounds.max:g}"
        )
    if bounds.min is not None and bounds.max is not None and bounds.min > bounds.max:
        raise file.error(loc, "these bounds can never be met", got=f"min {bounds.min:g}, max {bounds.max:g}")


def _check_whole_run(scenario: Scenario, errors: ErrorCollector) -> None:
    """Check the rules of the whole run: `within`, `rate`, `cycle`."""
    for n, within in enumerate(scenario.form.within):
        for key, text in (("after", within.after), ("then", within.then)):
            with errors.collect():
                _looks(scenario, text, ("within", n, key))
        with errors.collect():
            _time(scenario.file, ("within", n, "within"), within.within)
    for n, rate in enumerate(scenario.form.rate):
        with errors.collect():
            _check_rate(scenario, rate, ("rate", n))
    for n, cycle in enumerate(scenario.form.cycle):
        with errors.collect():
            _check_cycle(scenario, cycle, ("cycle", n))


def _check_rate(scenario: Scenario, rate: Rate, loc: tuple[Key, ...]) -> None:
    file = scenario.file
    ours = (rate.tag is not None, rate.updates_per_s is not None, rate.wire is None, rate.requests_per_s is None)
    if len(set(ours)) != 1:
        expected = "tag and updates_per_s, or wire and requests_per_s"
        raise file.error(loc, "a rate needs a tag or a wire", expected=expected)
    if rate.tag is not None:
        _known(file, (*loc, "tag"), "tag", rate.tag, scenario.known, scenario.incomplete)
        scenario.used.add(rate.tag)
    if rate.wire is not None:
        _known(file, (*loc, "wire"), "device", rate.wire, list(scenario.system.devices), scenario.incomplete)
    _check_bounds(file, (*loc, "updates_per_s"), rate.updates_per_s)
    _check_bounds(file, (*loc, "requests_per_s"), rate.requests_per_s)
    if _time(file, (*loc, "over"), rate.over) <= 0:
        raise file.error((*loc, "over"), "a rate needs a time", expected="over: 10s")
    if rate.while_ is not None:
        scenario.expression(rate.while_, *loc, "while")


def _check_cycle(scenario: Scenario, cycle: Cycle, loc: tuple[Key, ...]) -> None:
    file = scenario.file
    bounds = (cycle.min is not None or cycle.max is not None) and cycle.changes_of is not None
    if bounds == (cycle.late is not None):
        raise file.error(loc, "a cycle needs bounds", expected="changes_of: NAME with min or max; or late: 5ms")
    if cycle.changes_of is not None:
        known, incomplete = scenario.known, scenario.incomplete
        _known(file, (*loc, "changes_of"), "tag or variable", cycle.changes_of, known, incomplete)
        scenario.used.add(cycle.changes_of)
    times = {
        key: _time(file, (*loc, key), said)
        for key in ("min", "max", "late")
        if (said := getattr(cycle, key)) is not None
    }
    if times == {"min": 0}:
        raise file.error((*loc, "min"), "this bound is always met", expected="min above 0, or max", got="min 0")
    if times.get("min", 0) > times.get("max", times.get("min", 0)):
        raise file.error(loc, "these bounds can never be met", got=f"min {cycle.min}, max {cycle.max}")
    if cycle.while_ is not None:
        scenario.expression(cycle.while_, *loc, "while")


def _time(file: YamlFile, loc: tuple[Key, ...], text: Time) -> float:
    try:
        return seconds(text)
    except UsageError as e:
        raise file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint) from e


def _known(
    file: YamlFile,
    loc: tuple[Key, ...],
    what: str,
    name: str,
    known: Sequence[str],
    incomplete: Container[str] = frozenset(),
) -> None:
    if name in known:
        return
    if name.partition(".")[0] in incomplete:
        raise FollowingError("a part of the system has an error", path=file.path)
    hint = did_you_mean(name, known)
    raise file.error(loc, f"no {what} {name!r}", expected=", ".join(known) if len(known) < 30 else "", hint=hint)
