"""`fieldtwin shadow`: a digital shadow that follows a plant, or its prototype, from another computer."""

from __future__ import annotations

import asyncio
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from fieldtwin.cli.options import Duration, json_option, profiles_option
from fieldtwin.console import stderr
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.run.shadow.shadow import Shadowing
from fieldtwin.run.template import system_file
from fieldtwin.twin.model.mape.messages import AnalysisFinding
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import System, load_system

STYLE = {"mismatch": "bold red", "outside": "red", "bad": "yellow", "stale": "yellow", "unreadable": "red"}


class ShadowOutput:
    """The console output of a shadow: each finding of the comparison as it is reached, and each change of the state on
    which plant and model agree.
    """

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._states: dict[str, str] = {}

    def __call__(self, verdict: AnalysisFinding) -> None:
        known = verdict.finding == "agree" and self._states.get(verdict.subject) == verdict.text
        if self._quiet or known or (verdict.again and verdict.fine):
            return
        if verdict.finding == "agree":
            self._states[verdict.subject] = verdict.text
        when = _clock(datetime.fromtimestamp(verdict.t_ms / 1000, UTC))
        style = STYLE.get(verdict.finding, "")
        word = f"[{style}]{verdict.finding:10}[/]" if style else f"{verdict.finding:10}"
        subject = f"{verdict.subject}: " if not verdict.text.startswith(verdict.subject) else ""
        stderr.print(f"{when} {word} {escape(subject + verdict.text)}", soft_wrap=True)

    def trouble(self, where: str, text: str) -> None:
        """Print a problem of the digital thread or of its store, or that it has recovered if `text` is empty."""
        if not self._quiet:
            self.line(f"[bold yellow]{where:10}[/]", text or "recovered")

    def line(self, word: str, text: str) -> None:
        """Print a line that begins with the present time and the label `word`."""
        stderr.print(f"{_clock(datetime.now(UTC))} {word} {escape(text)}", soft_wrap=True)


def _clock(when: datetime) -> str:
    """Return the time of day, UTC, to the millisecond."""
    return when.strftime("%H:%M:%S.%f")[:-3]


@click.command("shadow")
@click.argument("system")
@click.option(
    "--from",
    "place",
    required=True,
    metavar="URL",
    help="Address of the plant's thread: as `fieldtwin run --thread` prints it, or mqtt://HOST/GROUP/NODE.",
)
@click.option("--store", default="", metavar="FILE|URL", help="Store of the knowledge; default: in the run directory.")
@click.option(
    "--for",
    "duration_s",
    type=Duration(),
    default=0.0,
    help="Stop after a time such as 20s; default: run until Ctrl-C.",
)
@click.option("--instance", default="", help="Name of the run directory; default: the system's name and -shadow.")
@profiles_option
@json_option
def command(
    system: str, place: str, store: str, duration_s: float, instance: str, profiles: tuple[Path, ...], as_json: bool
) -> int:
    """Follow SYSTEM as its digital shadow: receive the plant's data, update the digital model, and report differences.

    It reports a state that differs from the model's, values outside their limits, bad and stale values, and how often and
    with which delay plant and model agree. A shadow sends no commands. Exit code 1 if the states differed, or if none was
    received from a system that reports states. SYSTEM may be a template.
    """
    loaded = load_system(system_file(system, lambda template: True, plant=True), profiles)
    with Instance(instance or f"{loaded.name}-shadow") as here:
        seen = asyncio.run(_run(loaded, place, here, store, duration_s, as_json))
    if as_json:
        json.dump(seen, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_shadow(seen)
    if not seen["origins"]:
        raise Unreachable(f"the plant's thread: {why_nothing(seen, place)}", where=place)
    return exit_code(seen)


async def _run(
    system: System, place: str, instance: Instance, store: str, duration_s: float, as_json: bool
) -> dict[str, Any]:
    stop = stop_signal()
    talks = ShadowOutput(quiet=as_json)
    shadowing = Shadowing(system, place, instance, store=store, on_verdict=talks)
    shadowing.on_trouble = talks.trouble
    if not as_json:
        stderr.print(f"[bold]shadow[/bold] of {system.name}, from {escape(place)}", soft_wrap=True)
    await shadowing.run(stop, duration_s)
    return shadowing.describe()


def exit_code(seen: dict[str, Any]) -> int:
    """Return 1 if a state differed, or if none was received from a system that reports states; else 0."""
    received = seen["statuses"] or not seen["reports_state"]
    return 0 if received and seen["agreed"] == seen["statuses"] else 1


def why_nothing(seen: dict[str, Any], place: str) -> str:
    """Return why the shadow received nothing from its plant at `place`, without repeating the place."""
    thread = seen["thread"]
    why = str(thread.get("trouble") or thread.get("silent") or "no entry of its log was received")
    return why.removeprefix(f"{place}: ")


def variables_text(variables: dict[str, Any], undeclared: int) -> str:
    """Return as text how many variables the model has, how many of them were received, and how many of these are good."""
    heard = [variable for variable in variables.values() if variable["t_ms"] is not None]
    good = sum(variable["quality"] == "good" for variable in heard)
    more = f"; {undeclared} values of tags that it does not declare" if undeclared else ""
    return f"{len(variables)}, {len(heard)} of them received, {good} good{more}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def print_shadow(seen: dict[str, Any]) -> None:
    if not seen["origins"]:
        return
    kind = "a prototype" if seen["prototype"] else "a plant"
    lag, rate, thread = seen["lag_ms"], seen["twinning_rate_hz"], seen["thread"]
    compared = seen["reports_state"]
    states = f"{seen['statuses']}, {seen['agreed']} of them agree with the model"
    lines = [
        *([("model", f"{seen['state']}, period {seen['period_s']} s")] if compared else []),
        ("variables", variables_text(seen["variables"], seen["undeclared"])),
        ("from", f"{', '.join(seen['origins'])}, {kind}"),
        ("statuses", states) if compared else ("states", "not compared: no device of this system reports one"),
        (
            "twinning",
            f"{f'{rate:.1f} reports a second' if rate else 'too few reports'}, {seen['backfilled']} backfilled",
        ),
        ("lag", f"median {lag['median']} ms, 95 % {lag['p95']} ms, most {lag['max']} ms" if lag else "unknown"),
        ("thread", f"{_count(thread['links'], 'link')}, {_count(thread['duplicates'], 'event')} came twice"),
    ]
    if thread["trouble"]:
        lines.append(("trouble", thread["trouble"]))
    if seen.get("store_trouble"):
        lines.append(("store", seen["store_trouble"]))
    lines += [("wrong now", f"{name}: {', '.join(what)}") for name, what in seen["wrong"].items()]
    for name, text in lines:
        stderr.print(f"  {name:10} {escape(text)}", soft_wrap=True)
