"""Assigns the arguments of a call to parameters (IEC 61131-3, 6.6.1.4), for standard functions, functions and blocks.

Positional arguments come first and take the parameters in the order of their declarations, also VAR_IN_OUT. A call with more of
them than inputs and VAR_IN_OUT also gives the outputs. Named arguments follow in any order. Each parameter is given at most once.
"""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

from fieldtwin.plc.st.compiler.scope import Environment
from fieldtwin.plc.st.syntax import tree as t

MAX_REPEATED = 1000
"""The largest number of inputs of an extensible function such as ADD or MUX."""


@dataclass(frozen=True, slots=True)
class Formals:
    """The parameter names of a standard function.

    `names` come first, and the last `optional` of them may be left out. An extensible function then has at least `least`
    parameters named `repeats` and a number from `first` on (IN1, IN2, ...).
    """

    names: tuple[str, ...] = ()
    optional: int = 0
    repeats: str = ""
    first: int = 1
    least: int = 0

    def all_names(self, count: int) -> list[str]:
        """Return the names of a call with `count` arguments."""
        repeated = max(self.least, min(count - len(self.names), MAX_REPEATED)) if self.repeats else 0
        return [*self.names, *(f"{self.repeats}{self.first + n}" for n in range(repeated))]

    def place(self, argument: t.Argument) -> int:
        """Return the number, from 1, of the parameter that a named argument of an extensible function gives; 0 for any other
        name.
        """
        digits = argument.name[len(self.repeats) :]
        known = self.repeats and argument.name.upper().startswith(self.repeats) and re.fullmatch("[0-9]{1,4}", digits)
        return len(self.names) + int(digits) - self.first + 1 if known else 0

    def describe(self) -> str:
        """Return the parameters as a message shows them: ``MN, IN, MX`` or ``IN1, IN2, ...``."""
        more = ", ..." if self.repeats else ""
        return ", ".join(self.all_names(0)) + more or "none"


def bind(
    env: Environment, call: t.Call, names: Sequence[str], of: str, outputs: Container[str] = ()
) -> dict[str, t.Argument]:
    """Return the arguments of `call`, but not those with ``=>``, by parameter in lower case. `names` are the parameters in
    their order, `of` is the name of what is called. `outputs` are those parameters, in lower case, that only a positional
    argument may give; `given_outputs` returns them.

    Raises `FileInvalid` for an unknown name, a parameter that is given twice, too many arguments, and a positional
    argument after a named one.
    """
    order = [name.lower() for name in names]
    known = [name for name in names if name.lower() not in outputs]
    positional = sum(argument.value is not None and not argument.name for argument in call.arguments)
    if positional <= len(known):
        order = [name.lower() for name in known]
    found: dict[str, t.Argument] = {}
    named = False
    for argument in call.arguments:
        if argument.value is None:
            continue
        if argument.name:
            named, key = True, argument.name.lower()
            if key not in order or key in outputs:
                env.unknown(argument.pos, f"in {of}, a parameter", argument.name, known)
        elif named:
            env.fail(
                argument.pos, f"a positional argument of {of} after a named one", expected="NAME := value from here on"
            )
        elif len(found) >= len(order):
            expected = f"{len(order)} ({', '.join(names)})" if order else "0"
            given = sum(a.value is not None for a in call.arguments)
            env.fail(argument.pos, f"arguments of {of}", expected=expected, got=str(given))
        else:
            key = order[len(found)]
        if key in found:
            env.fail(
                argument.pos, f"parameter {next(name for name in names if name.lower() == key)} of {of} is given twice"
            )
        found[key] = argument
    return found


def given_outputs(
    env: Environment, call: t.Call, found: dict[str, t.Argument], outputs: Container[str], of: str
) -> list[t.Argument]:
    """Return the arguments for outputs: those with ``=>``, and the positional ones in `found`, which are removed from there."""
    positional = {name: found.pop(name) for name in list(found) if name in outputs}
    made = []
    for name, argument in positional.items():
        if not isinstance(argument.value, t.Ref):
            env.fail(argument.pos, f"an output of {of} needs a variable")
        made.append(replace(argument, name=name, value=None, target=argument.value))
    for argument in call.arguments:
        if argument.target is not None:
            if argument.name.lower() in positional:
                env.fail(argument.pos, f"parameter {argument.name} of {of} is given twice")
            made.append(argument)
    return made


def in_order(env: Environment, call: t.Call, formals: Formals) -> list[t.Expr]:
    """Return the arguments of a standard function in the order of its parameters. Also raises `FileInvalid` for a
    missing one."""
    of = call.ref.name.upper()
    for argument in call.arguments:
        if argument.target is not None:
            env.fail(argument.pos, f"{of} has no output {argument.name}", hint=f"its result is the value of {of}(...)")
    names = formals.all_names(max([len(call.arguments), *map(formals.place, call.arguments)]))
    found = bind(env, call, names, of)
    given = [found.get(name.lower()) for name in names]
    while given and given[-1] is None and len(given) > len(formals.names) - formals.optional and not formals.repeats:
        given.pop()
    missing = next((name for name, argument in zip(names, given, strict=False) if argument is None), "")
    if missing:
        expected = f"{len(formals.all_names(0))}{' or more' if formals.repeats else ''} ({formals.describe()})"
        got = f"{len(found)}, without {missing}" if found else "0"
        env.fail(call.pos, f"arguments of {of}", expected=expected, got=got)
    return [a.value for a in given if a is not None and a.value is not None]
