"""`fieldtwin bridge`: connect Modbus TCP clients to units on a serial line, or serial clients to TCP devices."""

from __future__ import annotations

import json
import sys

import click

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option, pairs
from fieldtwin.console import stderr
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.runtime.bridge.policy import LOOPBACK, network
from fieldtwin.gateway.wallclock import run
from fieldtwin.run.live.bridge import BridgeOptions, run_bridge

ANYWHERE = ("127.0.0.1", "::1", "localhost", "")


@click.command("bridge", cls=GroupedCommand)
@click.argument("listen")
@click.argument("target")
@group(
    "Clients",
    click.option(
        "--allow",
        "networks",
        multiple=True,
        metavar="NETWORK",
        help="Network that may connect; default: this host. Repeatable.",
    ),
    click.option(
        "--role",
        "roles",
        multiple=True,
        metavar="ROLE",
        help="tls: only clients whose certificate has this role. Repeatable.",
    ),
    click.option("--allow-writes", is_flag=True, help="Forward every function; default: only functions that read."),
    click.option(
        "--clients", type=click.IntRange(1, 1000), default=16, show_default=True, help="Maximum number of connections."
    ),
    click.option(
        "--queue", type=click.IntRange(1, 64), default=32, show_default=True, help="Maximum number of queued requests."
    ),
    click.option(
        "--idle", "idle_s", type=Duration(), default="0", help="Disconnect clients that are silent for this time."
    ),
)
@group(
    "Requests",
    click.option(
        "--unit",
        "units",
        multiple=True,
        metavar="UNIT=UNIT",
        help="Map a client's unit ID to the target's. Repeatable.",
    ),
    click.option(
        "--timeout", "timeout_s", type=Duration(), default="1s", show_default=True, help="Reply timeout of a unit."
    ),
    click.option(
        "--retries", type=click.IntRange(0, 10), default=1, show_default=True, help="Repetitions of unanswered reads."
    ),
    click.option(
        "--cache", "cache_s", type=Duration(), default="0", help="Answer reads from cached replies of at most this age."
    ),
    click.option(
        "--broadcast", is_flag=True, help="Forward broadcasts (unit 0) to the line; the client gets no answer."
    ),
    click.option(
        "--answer-broadcast", is_flag=True, help="Forward broadcasts, and confirm their transmission to the client."
    ),
    click.option("--pause", "pause_s", type=Duration(), default="0", help="Pause between two exchanges on TARGET."),
    click.option("--echo", is_flag=True, help="Serial TARGET: the adapter echoes the sent bytes (RS-485)."),
)
@group(
    "Output",
    click.option("--instance", default="", help="Name of the run directory, which contains the audit log."),
    json_option,
)
def command(
    listen: str,
    target: str,
    networks: tuple[str, ...],
    allow_writes: bool,
    units: tuple[str, ...],
    timeout_s: float,
    retries: int,
    cache_s: float,
    clients: int,
    queue: int,
    broadcast: bool,
    answer_broadcast: bool,
    pause_s: float,
    echo: bool,
    idle_s: float,
    roles: tuple[str, ...],
    instance: str,
    as_json: bool,
) -> int:
    """Connect Modbus clients at LISTEN to the units behind TARGET.

    \b
    TCP clients, and serial units:
      fieldtwin bridge tcp://0.0.0.0:502 \\
          "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1" --allow 10.0.0.0/24
    The same with TLS:
      fieldtwin bridge "tls://0.0.0.0:802?cert=us.pem&key=us.key&ca=clients.pem" \\
          rtu:/dev/ttyUSB0 --allow 0.0.0.0/0
    A client on a serial line, and a TCP device:
      fieldtwin bridge "rtu:/dev/ttyS1?baudrate=19200" tcp://plc:502 --unit 1=255

    By default the bridge is read-only and accepts only clients of this host. It answers requests to unknown units with
    exception 0A, and requests to silent units with 0B; it then pauses the requests to a silent unit.
    """
    here = Endpoint.parse(listen)
    if roles and here.scheme != "tls":
        raise UsageError("roles are in clients' certificates", expected="tls://HOST:PORT", got=listen)
    options = BridgeOptions(
        listen=here,
        target=Endpoint.parse(target),
        networks=tuple(network(text) for text in networks) or LOOPBACK,
        allow_writes=allow_writes,
        units=tuple((_unit(a), _unit(b)) for a, b in pairs(units, "--unit").items()),
        timeout_s=timeout_s,
        retries=retries,
        cache_ms=round(1000 * cache_s),
        clients=clients,
        queue=queue,
        broadcast=broadcast,
        answer_broadcast=answer_broadcast,
        pause_s=pause_s,
        echo=echo,
        idle_s=idle_s,
        roles=frozenset(roles) or None,
        instance=instance,
    )
    if not networks and options.listen.host not in ANYWHERE:
        stderr.print("only clients of this host have access; --allow NETWORK admits others")
    result = run(run_bridge(options, lambda text: stderr.print(text, soft_wrap=True, markup=False)))
    if as_json:
        json.dump(result, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        counted = ", ".join(f"{k} {v}" for k, v in result["target"].items() if v)
        stderr.print(f"{result['requests']} requests" + (f": {counted}" if counted else ""))
    return 0


def _unit(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) > 255:
        raise UsageError("a unit id", expected="0 to 255", got=repr(text))
    return int(text)
