"""`fieldtwin campaign`: join what several computers recorded in their ledgers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.table import Table

from fieldtwin.cli.campaign_reports import CampaignReports
from fieldtwin.cli.campaigns.st_coverage import show_campaign_coverage
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.output_files import replacing
from fieldtwin.cli.run.virtual_view import coverage_text, shown_time
from fieldtwin.console import stderr, stdout

if TYPE_CHECKING:
    from fieldtwin.run.campaigns.merging import Runs

SHOWN_SEEDS = 10


@click.group("campaign")
def command() -> None:
    """Campaigns of many seeds: join the results of several computers."""


@command.command("merge", cls=GroupedCommand)
@click.argument("ledgers", nargs=-1, required=True, type=click.Path(dir_okay=False, path_type=Path))
@group(
    "Runs",
    click.option(
        "--seeds", default="", metavar="1..200", help="The seeds of the whole campaign: a missing one is an error."
    ),
)
@group(
    "Output",
    click.option(
        "-o",
        "--out",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write the joined ledger to this file, which may be one of LEDGERS.",
    ),
    json_option,
)
@group("Output", reports=CampaignReports)
def merge_command(
    ledgers: tuple[Path, ...], seeds: str, out: Path | None, reports: CampaignReports, as_json: bool
) -> int:
    """Join LEDGERS, which `fieldtwin simulate --seeds ... --ledger FILE` wrote.

    The order of the files has no effect, and a run that several files contain counts once.

    \b
    fieldtwin simulate tank.yaml --for 8h --faults random \\
        --seeds 1..1000 --shard 3/16 --ledger shard-3.jsonl
    fieldtwin campaign merge shard-*.jsonl --seeds 1..1000 \\
        -o all.jsonl --html campaign.html --junit campaign.xml

    Exit code 0 if every run passed; 1 if one failed, if a seed has two different results, or if one of --seeds is missing.
    """
    from fieldtwin.run.campaigns.ledger import read_entries, write_entries
    from fieldtwin.run.campaigns.merging import by_fingerprint, merged
    from fieldtwin.run.campaigns.seeds import parse_seeds

    expected = frozenset(parse_seeds(seeds)) if seeds else frozenset()
    found = []
    for path in ledgers:
        entries, incomplete = read_entries(path)
        if incomplete:
            stderr.print(f"{path}: its last line is incomplete and is not counted", soft_wrap=True, markup=False)
        found.append(entries)
    joined = merged(found)
    groups = by_fingerprint(joined)
    if out is not None:
        with replacing(out) as part:
            write_entries(part, joined)
    if reports.given:
        from fieldtwin.run.campaigns.reporting import campaign_of

        names = [path.name for path in ledgers]
        reports.write([campaign_of(runs, expected, names) for runs in groups])
    if as_json:
        click.echo(json.dumps([_plain(runs, expected) for runs in groups]))
    else:
        _show(groups, expected, len(ledgers))
    whole = bool(groups) and not any(expected - runs.seeds for runs in groups)
    return 0 if whole and not any(runs.failed or runs.different for runs in groups) else 1


def _plain(runs: Runs, expected: frozenset[int]) -> dict[str, object]:
    from fieldtwin.run.campaigns.reporting import campaign_of

    return {
        "what": runs.what,
        "version": runs.version,
        "runs": len(runs.seeds),
        "hours": runs.hours,
        "coverage": runs.coverage.counts(),
        "failed": sorted({entry.seed for entry in runs.failed}),
        "groups": [
            {"check": group.cause, "count": len(group.runs), "seeds": [run.seed for run in group.runs]}
            for group in campaign_of(runs, with_coverage=False).groups
        ],
        "different": runs.different,
        "missing": sorted(expected - runs.seeds),
    }


def _show(groups: list[Runs], expected: frozenset[int], files: int) -> None:
    """Print the runs of each fingerprint, and the seeds that need attention."""
    if not groups:
        stdout.print(f"no run in {files} ledger{'s' if files > 1 else ''}: nothing was tested")
        return
    for runs in groups:
        table = Table(box=None, show_header=False, pad_edge=False)
        table.add_row("campaign", f"{runs.what}, version {runs.version}")
        table.add_row("runs", f"{len(runs.seeds)} from {files} ledger{'s' if files > 1 else ''}")
        table.add_row("virtual time", shown_time(runs.hours * 3600))
        table.add_row("coverage", coverage_text(runs.coverage))
        table.add_row("failed", _listed(sorted({entry.seed for entry in runs.failed})))
        if expected:
            table.add_row("missing", _listed(sorted(expected - runs.seeds)))
        stdout.print(table)
        programs, measured = runs.programs
        show_campaign_coverage(programs, [(measured, len(runs.seeds))])
        for entry in runs.failed[:SHOWN_SEEDS]:
            reason = entry.errors[0] if entry.errors else "no reason is recorded"
            stdout.print(f"  seed {entry.seed}: {reason}", soft_wrap=True, markup=False)
        for seed in runs.different[:SHOWN_SEEDS]:
            stdout.print(
                f"  seed {seed} has different results in these ledgers; the same seed must give the same run, so this is a "
                "defect: compare the traces of both computers (fieldtwin simulate --seed ... --trace FILE)",
                soft_wrap=True,
                markup=False,
            )


def _listed(seeds: list[int]) -> str:
    more = f", and {len(seeds) - SHOWN_SEEDS} more" if len(seeds) > SHOWN_SEEDS else ""
    return f"{len(seeds)} ({', '.join(map(str, seeds[:SHOWN_SEEDS]))}{more})" if seeds else "none"
