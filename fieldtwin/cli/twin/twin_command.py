"""`fieldtwin twin`: a digital twin: it plans, simulates, and commands the plant."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import click

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.cli.twin.shadow_command import ShadowOutput, print_shadow, why_nothing
from fieldtwin.console import stderr
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.core.statemachine import decode_period, encode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.shadow.rules import Plans, PythonPlanner, load_planner, questions_of
from fieldtwin.run.shadow.shadow import limits_of
from fieldtwin.run.shadow.twin import Twinning
from fieldtwin.run.template import system_file
from fieldtwin.run.what_if.asking import Asking, ForkSubject
from fieldtwin.twin.model.mape.plan import RulePlanner
from fieldtwin.twin.model.mape.what_if import Question
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import System, load_system


@click.command("twin", cls=GroupedCommand)
@click.argument("system")
@group(
    "Plant and knowledge",
    click.option(
        "--from",
        "place",
        required=True,
        metavar="URL",
        help="Address of the plant's thread, as for `fieldtwin shadow`.",
    ),
    click.option(
        "--store", default="", metavar="FILE|URL", help="Store of the knowledge; default: in the run directory."
    ),
    click.option(
        "--for",
        "duration_s",
        type=Duration(),
        default=0.0,
        help="Stop after a time such as 20s; default: run until Ctrl-C.",
    ),
    click.option("--instance", default="", help="Name of the run directory; default: the system's name and -twin."),
)
@group(
    "Commands",
    click.option("--plan", "planner", default="", metavar="FILE", help='Rules (YAML), or "python: module:Class".'),
    click.option(
        "--command", "periods", multiple=True, type=int, metavar="SECONDS", help="A period to plan at the start."
    ),
)
@group(
    "Simulation before a command",
    click.option(
        "--what-if",
        "horizon_s",
        type=Duration(),
        default=0.0,
        metavar="TIME",
        help="Simulate each command for this time, such as 30min, before it is sent.",
    ),
    click.option(
        "--require", multiple=True, metavar="EXPRESSION", help="With --what-if: an expression that must always hold."
    ),
    click.option(
        "--finally",
        "finally_",
        multiple=True,
        metavar="EXPRESSION",
        help="With --what-if: an expression that must hold at the end.",
    ),
    click.option(
        "--what-if-timeout",
        "timeout_s",
        type=Duration(),
        default="60s",
        show_default=True,
        help="Time for the simulation; without a result the command is refused.",
    ),
    click.option(
        "--prototype-file",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="Prototype file of the simulation; default: next to the system file.",
    ),
)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Output",
    json_option,
)
def command(
    system: str,
    place: str,
    planner: str,
    periods: tuple[int, ...],
    horizon_s: float,
    require: tuple[str, ...],
    finally_: tuple[str, ...],
    timeout_s: float,
    prototype_file: Path | None,
    store: str,
    duration_s: float,
    instance: str,
    sources: TemplateSearchOptions,
    as_json: bool,
) -> int:
    """Run the digital twin of SYSTEM: like `fieldtwin shadow`, and command the plant by rules for its findings.

    Each command is first checked against the digital model and the limits in the system file; with --what-if, or if the rules
    require it, also in a simulation that starts from the twin's knowledge. Only accepted commands are sent. The plant
    executes a command only while its own switch is set to `remote`, within the limits and the rate of its own file, and never
    the same command number twice.
    """
    folders = sources.profiles
    runs_code = bool(horizon_s or planner)  # for prototypes and planners in Python from a template
    ask = sources.ask(runs_code=runs_code)
    system = system_file(system, ask, virtual=True, prototype_file=prototype_file, profiles=folders)
    loaded = load_system(system, folders)
    plans = load_planner(planner, loaded) if planner else Plans(RulePlanner(()), limits=limits_of(loaded))
    question = _question(horizon_s, require, finally_) or plans.question
    questions = [*([question] if question else []), *questions_of(plans.planner)]
    with Instance(instance or f"{loaded.name}-twin") as here:
        by_hand = [encode_period(period) for period in periods]
        talks = TwinOutput(quiet=as_json)
        subject = ForkSubject(loaded, folders, prototype_file)
        asking = (
            Asking(subject, WallClock(), timeout_s, talks.asks)
            if questions or isinstance(plans.planner, PythonPlanner)
            else None
        )
        twinning = Twinning(
            loaded, place, here, store=store, on_verdict=talks, on_command=talks.sent, on_refusal=talks.refused,
            planner=plans.planner, limits=plans.limits, asking=asking, question=question,
        )  # fmt: skip
        twinning.on_trouble = talks.trouble
        for plan in by_hand:
            twinning.plan(plan)
        seen = asyncio.run(_run(loaded, place, twinning, duration_s, as_json, asking, questions))
    if as_json:
        json.dump(seen, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_shadow(seen)
        asked = f", {seen['asked']} simulated" if questions else ""
        there = f", {seen['refused_by_plant']} refused by the plant" if seen["refused_by_plant"] else ""
        counts = f"{seen['planned']} planned{asked}, {seen['sent']} sent, {seen['refused']} refused{there}"
        stderr.print(f"  commands   {counts}", soft_wrap=True)
    if not seen["origins"]:
        raise Unreachable(f"the plant's thread: {why_nothing(seen, place)}", where=place)
    return 0 if seen["agreed"] == seen["statuses"] else 1


class TwinOutput(ShadowOutput):
    """The console output of a twin: that of a shadow, and the commands that are simulated, sent and refused."""

    def asks(self, command: COMMAND, question: Question) -> None:
        self._say("asks", f"a prototype of period {decode_period(command)} s, {question.horizon_s:g} s ahead")

    def sent(self, command: COMMAND) -> None:
        self._say("command", f"period {decode_period(command)} s")

    def refused(self, why: str) -> None:
        self._say("refused", why)

    def _say(self, word: str, text: str) -> None:
        if not self._quiet:
            self.line(f"{word:10}", text)


def _question(horizon_s: float, require: tuple[str, ...], finally_: tuple[str, ...]) -> Question | None:
    if not horizon_s and not require and not finally_:
        return None
    if not horizon_s or not (require or finally_):
        raise UsageError(
            "--what-if is incomplete", expected="--what-if TIME, and what must hold: --require or --finally EXPRESSION"
        )
    return Question(horizon_s, require, finally_)


async def _run(
    system: System,
    place: str,
    twinning: Twinning,
    duration_s: float,
    as_json: bool,
    asking: Asking | None,
    questions: list[Question],
) -> dict[str, Any]:
    if asking is not None:
        await asking.check(questions)
    stop = stop_signal()
    if not as_json:
        stderr.print(f"[bold]twin[/bold] of {system.name}, from {place}", soft_wrap=True, markup=True)
    await twinning.run(stop, duration_s)
    return twinning.describe()
