"""`fieldtwin trace`: show the events of a run as text or JSON, or write them for GTKWave, Foxglove or Wireshark."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import click

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.capture.decoding.exchange import Decoded, DecodedExchange
from fieldtwin.capture.decoding.trace_file import read_events, start_utc_ns
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.output_files import replacing
from fieldtwin.cli.recordings.regression_options import ToleranceOptions
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stderr
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.results.trace_about import read_about
from fieldtwin.twin.site.system import System


@click.command("trace", cls=GroupedCommand)
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("system")
@group(
    "Selection",
    click.option(
        "--only", multiple=True, help="Show only the events of this bus, device, tag, program or fault. Repeatable."
    ),
    click.option("--from", "start_s", type=Duration(), default="0s", help="Start of the shown time."),
    click.option("--to", "end_s", type=Duration(), help="End of the shown time."),
    click.option("--problems", is_flag=True, help="Only requests without a good answer, and refused outputs."),
)
@group(
    "Comparison and scenario",
    click.option(
        "--against",
        type=click.Path(path_type=Path),
        help="Compare with an older run. Exit code 1 if a value differs or an answer is slower.",
    ),
    click.option("--as-scenario", type=click.Path(path_type=Path), help="Make a scenario of the run, with tolerances."),
    click.option("--seed", type=int, help="With --as-scenario: the seed of the run."),
    click.option(
        "--set-values",
        is_flag=True,
        help="With --as-scenario: set the devices' values as well, for a different prototype from the run's.",
    ),
    tolerance=ToleranceOptions,
)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Output",
    click.option("--vcd", type=click.Path(path_type=Path), help="Write waveforms (IEEE 1364) for GTKWave instead."),
    click.option("--mcap", type=click.Path(path_type=Path), help="Write an MCAP file for Foxglove instead."),
    click.option("--pcapng", type=click.Path(path_type=Path), help="Write the frames for Wireshark instead."),
    json_option,
)
def command(
    file: Path,
    system: str,
    only: tuple[str, ...],
    start_s: float,
    end_s: float | None,
    problems: bool,
    vcd: Path | None,
    mcap: Path | None,
    pcapng: Path | None,
    against: Path | None,
    as_scenario: Path | None,
    seed: int | None,
    set_values: bool,
    tolerance: ToleranceOptions,
    sources: TemplateSearchOptions,
    as_json: bool,
) -> int:
    """Show FILE, a trace (simulate --trace) or a capture (run --capture) of SYSTEM, with decoded frames. With --json,
    each request with its answer, and each message, is one line.

    \b
    fieldtwin trace new.jsonl observatory --against old.jsonl --tolerance 1%
    fieldtwin trace run.jsonl observatory --as-scenario run.scenario.yaml

    --against compares two runs by states and their order, values, qualities and latencies, not by bytes.
    """
    from fieldtwin.run.template import system_file
    from fieldtwin.twin.site.system import load_system

    ask = sources.ask(
        runs_code=vcd is not None
    )  # only waveforms need the programs' types, so only they import the programs
    plant = load_system(system_file(system, ask, plant=True, profiles=sources.profiles), sources.profiles)
    if against is not None or as_scenario is not None:
        from fieldtwin.cli.recordings import regression_view

        if any((vcd, mcap, pcapng, only, problems)) or (against is not None and as_scenario is not None):
            raise UsageError("--against and --as-scenario use the whole run, without other options")
        allowed = regression_view.allowed_of(tolerance)
        if against is not None:
            return regression_view.show(regression_view.judged(plant, against, file, allowed), against, as_json=as_json)
        assert as_scenario is not None
        return regression_view.write_scenario(
            plant, file, as_scenario, system, allowed=allowed, seed=seed, values=set_values
        )
    start_ns, end_ns = round(start_s * NS_PER_S), None if end_s is None else round(end_s * NS_PER_S)
    outputs = {"--vcd": vcd, "--mcap": mcap, "--pcapng": pcapng}
    if chosen := [option for option, out in outputs.items() if out is not None]:
        if len(chosen) > 1 or only or problems or as_json:
            raise UsageError(
                f"{chosen[0]} takes the whole trace",
                expected="one of --vcd, --mcap and --pcapng, without --only, --problems and --json",
            )

        def inside() -> Iterator[TraceEvent]:
            return (e for e in read_events(file, plant) if e.t_ns >= start_ns and (end_ns is None or e.t_ns <= end_ns))

        (out,) = (out for out in outputs.values() if out is not None)
        if out.exists() and file.exists() and out.samefile(file):
            raise UsageError(f"{chosen[0]} would overwrite the trace", got=str(out), expected="another file")
        with replacing(out) as part:
            said = _written(chosen[0], part, inside, plant, file)
        stderr.print(f"{said}  →  {out}", soft_wrap=True)
        return 0
    events = read_events(file, plant)
    decoder = Decoder(plant)
    for event, decoded in _decoded(decoder, events, end_ns):
        if event.t_ns < start_ns:
            continue
        if as_json or problems:
            _show_refusal(event, decoded, only, as_json=as_json)
            _show_exchanges(decoded.exchanges, only, problems=problems, as_json=as_json)
        elif _wanted(only, event, decoded):
            click.echo(_line(event, decoded))
    if as_json or problems:
        _show_exchanges(decoder.finish(), only, problems=problems, as_json=as_json)
    return 0


def _written(option: str, out: Path, events: Callable[[], Iterator[TraceEvent]], plant: System, file: Path) -> str:
    """Write the events of `file` in the format of the option; return what was written, in words."""
    title = f"{plant.name}, {file.name}"
    if option == "--vcd":
        from fieldtwin.reports.run.machines import machines_of
        from fieldtwin.reports.run.vcd import write_vcd

        found = list(events())
        write_vcd(out, found, plant, machines_of(plant), title)
        return f"{len(found)} events"
    start = start_utc_ns(file)
    if option == "--pcapng":
        from fieldtwin.reports.run.packets import write_packets

        return f"{write_packets(out, events, plant, start_utc_ns=start, comment=title)} packets"
    from fieldtwin.reports.run.mcap import write_mcap

    about = {"source": file.name}
    count = write_mcap(out, events, plant, start_utc_ns=start, about=about, description=read_about(file))
    return f"{count} messages"


def _decoded(
    decoder: Decoder, events: Iterator[TraceEvent], end_ns: int | None
) -> Iterator[tuple[TraceEvent, Decoded]]:
    for event in events:
        if end_ns is not None and event.t_ns > end_ns:
            return
        yield event, decoder.decode(event)


def _wanted(only: tuple[str, ...], event: TraceEvent, decoded: Decoded) -> bool:
    names = {event.where, event.where.partition(".")[0], *(e.device for e in decoded.exchanges)}
    told = decoded.text.partition(":")[0]  # the text of a request already names its device
    return not only or not names.isdisjoint(only) or (event.kind is TraceKind.FRAME and told in only)


def _line(event: TraceEvent, decoded: Decoded) -> str:
    if event.kind is TraceKind.FRAME:
        head = f"{event.where} {'→' if event.data.get('dir') == 'sent' else '←'}"
    else:
        head = event.kind.value
    return f"{event.t_ns / NS_PER_S:12.6f}  {head:<10}  {decoded.text}"


def _show_refusal(event: TraceEvent, decoded: Decoded, only: tuple[str, ...], *, as_json: bool) -> None:
    """Report a write that did not reach its device: nothing was sent, so no exchange shows it."""
    if event.kind is not TraceKind.REFUSED or not _wanted(only, event, decoded):
        return
    if as_json:
        click.echo(json.dumps({"t_s": event.t_ns / NS_PER_S, "refused": event.where, **event.data}))
    else:
        click.echo(_line(event, decoded))


def _show_exchanges(
    exchanges: list[DecodedExchange] | tuple[DecodedExchange, ...],
    only: tuple[str, ...],
    *,
    problems: bool,
    as_json: bool,
) -> None:
    for exchange in exchanges:
        if (problems and exchange.ok) or (only and not {exchange.bus, exchange.device}.intersection(only)):
            continue
        if as_json:
            click.echo(json.dumps({"t_s": exchange.t_ns / NS_PER_S, "bus": exchange.bus, **exchange.describe()}))
        else:
            click.echo(f"{exchange.t_ns / NS_PER_S:12.6f}  {exchange.bus:<10}  {exchange.text}: {exchange.reply_text}")
