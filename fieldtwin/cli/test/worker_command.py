"""`fieldtwin test-host`: the process that the pytest plugin starts, also for tests in other languages."""

from __future__ import annotations

import click

from fieldtwin.cli.template_question import TRUST


@click.command("test-host")
@click.option("--trust", **TRUST)
def command(trust: bool) -> int:
    """Emulate devices for tests in any language, controlled over standard input and output.

    Requests and answers are lines of JSON: {"v": 1, "id": 1, "command": "device", "args": {"device": "ctd-reference"}}.
    docs/reference/pytest-plugin.md lists the commands. The pytest plugin of fieldtwin starts this program, which ends when
    its input ends. It cannot ask for confirmation, so without --trust it runs no code of a template.
    """
    from fieldtwin.gateway.wallclock import run
    from fieldtwin.testing.worker.host import Host
    from fieldtwin.twin.plant.child import allow_open_files

    allow_open_files()
    return run(Host(trust=trust).serve())
