"""`fieldtwin test-host`: the process that the pytest plugin starts, also for tests in other languages."""

from __future__ import annotations

import click

from fieldtwin.cli.template_question import trust_option


@click.command("test-host")
@trust_option
def command(trust: bool) -> int:
    """Emulated devices for somebody's tests, made and ended over standard input and output.

    Requests are lines of JSON, and so are answers: {"v": 1, "id": 1, "verb": "device", "args": {"device": "ctd-reference"}}.
    The pytest plugin of fieldtwin starts it; docs/testing.md has the verbs. It ends when its input does. Nobody is
    there to be asked: without --trust nothing of a stranger's template is run.
    """
    from fieldtwin.gateway.wallclock import run
    from fieldtwin.testing.worker.host import Host
    from fieldtwin.twin.plant.child import allow_open_files

    allow_open_files()
    return run(Host(trust=trust).serve())
