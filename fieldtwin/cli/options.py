"""Options that several commands share, and the parsing of their values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from fieldtwin.gateway.core.errors import UsageError

_DURATION = re.compile(r"^([0-9]+(?:\.[0-9]+)?)(ms|s|m|min|h)?$")
_NEGATIVE = re.compile(r"-(0x[0-9a-f]+|[0-9]+\.?[0-9]*(e[+-]?[0-9]+)?|\.[0-9]+(e[+-]?[0-9]+)?|inf)", re.IGNORECASE)
_UNIT_S = {"ms": 0.001, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


if TYPE_CHECKING:
    _OfFloat = click.ParamType[float]
    _OfText = click.ParamType[str]
else:  # `ParamType` is generic since click 8.4
    _OfFloat = _OfText = click.ParamType


class NegativeNumbers(click.Command):
    """A command that takes negative numbers as arguments anywhere among its options: ``force TAG -1 --yes``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        known = {option for param in self.params for option in (*param.opts, *param.secondary_opts)} | {"--", "--help"}
        words = [a for a in args if a.startswith("-") and a != "-" and not _NEGATIVE.fullmatch(a)]
        if all(word.partition("=")[0] in known for word in words):  # any other unknown option is still an error
            ctx.ignore_unknown_options = True
        return super().parse_args(ctx, args)


class Duration(_OfFloat):
    """A number with its unit: ``500ms``, ``20s``, ``2m`` (or ``2min``), ``1h``. Only ``0`` needs no unit.

    ``--timeout 500`` is an error, because some users mean milliseconds and others seconds.
    """

    name = "duration"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, float):
            return value
        match = _DURATION.match(str(value))
        if not match:
            self.fail(f"{value!r} is not a duration such as 20s, 500ms or 2m", param, ctx)
        number, unit = float(match[1]), match[2]
        if unit is None and number:
            self.fail(f"{value!r} has no unit: write {match[1]}ms, {match[1]}s, {match[1]}m or {match[1]}h", param, ctx)
        return number * _UNIT_S[unit or "s"]


class Secret(_OfText):
    """A secret: ``@FILE`` for the first line of a file, or an environment variable.

    Every user of the computer can read a command line. So a secret on the command line is an error, and the message does not
    repeat it.
    """

    name = "secret"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        text = str(value)
        if not text.startswith("@"):
            named = param.name if param is not None else None
            if ctx is not None and named and ctx.get_parameter_source(named) is ParameterSource.COMMANDLINE:
                self.fail(
                    "every user of this computer can read the command line: use @FILE, or the environment", param, ctx
                )
            return text
        try:
            lines = Path(text[1:]).read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as e:
            self.fail(f"{text[1:]}: {getattr(e, 'strerror', None) or 'not text'}", param, ctx)
        if not lines or not lines[0].strip():
            self.fail(f"{text[1:]} is empty", param, ctx)
        return lines[0].strip()


def pairs(values: tuple[str, ...], what: str) -> dict[str, str]:
    """Return ``NAME=VALUE`` options as a dictionary. Raises `UsageError`."""
    out: dict[str, str] = {}
    for value in values:
        name, equals, rest = value.partition("=")
        if not equals or not name or not rest:
            raise UsageError(f"cannot read {what} {value!r}", expected="NAME=VALUE")
        out[name] = rest
    return out


JSON: dict[str, Any] = {"is_flag": True, "help": "Print data as JSON on stdout."}
"""The arguments of `json_option`, for use in groups of options."""
json_option = click.option("--json", "as_json", **JSON)
PROFILES: dict[str, Any] = {
    "multiple": True,
    "type": click.Path(exists=True, file_okay=False, path_type=Path),
    "help": "A folder of profiles, or with devices/ and systems/, searched before FIELDTWIN_PROFILES, ./profiles and the "
    "shipped ones.",
}
"""The arguments of `profiles_option`, for use in groups of options."""
profiles_option = click.option("--profiles", **PROFILES)
