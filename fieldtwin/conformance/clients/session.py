"""Run a conformance test on this computer's endpoints: open the endpoint, start the program, attach the probe."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field

from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_CASES
from fieldtwin.conformance.clients.canopen.cases import SILENT as CANOPEN_SILENT
from fieldtwin.conformance.clients.canopen.hostile_node import HostileNode
from fieldtwin.conformance.clients.modbus.cases import CASES, SILENT
from fieldtwin.conformance.clients.modbus.hostile_server import HostileServer, traits, wire_for
from fieldtwin.conformance.clients.modbus.pty_line import PtyLine
from fieldtwin.conformance.clients.probe import Classifier, MarkedOutputProbe, OutputProbe, Probe, RegisterProbe
from fieldtwin.conformance.clients.program import OnText, ProgramUnderTest
from fieldtwin.conformance.clients.run import C, ClientPlan, ClientRun
from fieldtwin.conformance.core.observation import Event, Word
from fieldtwin.conformance.core.results import CaseResult
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock

MAX_CLIENTS = 8
CAN_TRAITS = frozenset({"can"})
LISTENING = "tcp://HOST:PORT, rtu+tcp://HOST:PORT, pty:PATH, rtu:PORT or ascii:PORT"


@dataclass(frozen=True)
class Options:
    """The options of a run.

    `words`: the values of the registers or objects: two correct ones, and one that the client must never publish (the
    poison word). `probe`: an address for `RegisterProbe`, ``output``, ``output:TEXT``, or empty for no probe. `ascii`: the
    line carries Modbus ASCII. The fields from `objects` to `bitrate` are for CANopen only: fixed objects, the size in bytes
    of all others, the node IDs that send a boot-up message at the start, the heartbeat period, the bit rate. `command` is
    the program under test.
    """

    listen: Endpoint
    plan: ClientPlan
    words: tuple[int, int, int]
    probe: str = ""
    stands_for_none: frozenset[str] = frozenset()
    held: Mapping[tuple[Table, int], int] = field(default_factory=dict)
    ascii: bool = False
    objects: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    size: int = 4
    nodes: frozenset[int] = frozenset()
    heartbeat_s: float = 1.0
    bitrate: int = 125_000
    command: Sequence[str] = ()


@dataclass(frozen=True)
class Listener:
    """The callbacks of a test: `print_line` receives a line of console output, `on_result` each result, `log` each event."""

    print_line: Callable[[str], None]
    on_result: Callable[[CaseResult], None]
    log: Callable[[Event], None] = lambda event: None


async def check_modbus_client(options: Options, listener: Listener) -> list[CaseResult]:
    """Test a Modbus client; return the results in the order of the cases.

    Raises `UsageError`, `Unreachable` or `EndpointBusy`. SIGTERM ends the test, and the program with it.
    """
    if options.listen.scheme not in ("tcp", "rtu+tcp", "pty", "rtu", "ascii"):
        raise UsageError("the endpoint for the client or master", expected=LISTENING, got=str(options.listen))
    in_ascii = options.ascii or options.listen.scheme == "ascii"
    if in_ascii and options.listen.scheme in ("tcp", "rtu+tcp"):
        raise UsageError("Modbus ASCII needs a serial line", expected="pty:PATH or ascii:PORT", got=str(options.listen))
    line = options.listen.is_serial or options.listen.scheme == "pty"
    scheme = "ascii" if in_ascii else "rtu" if line else options.listen.scheme
    stage = HostileServer(wire_for(scheme), options.words, options.held)
    async with AsyncExitStack() as closing:
        nursery = await closing.enter_async_context(Nursery())
        theirs = await _open(options.listen, stage, nursery, closing, "ascii" if in_ascii else "rtu")
        here = traits(scheme) | (PtyLine.traits() if options.listen.scheme == "pty" else frozenset())
        probe, on_text = _probe(options, nursery)
        run = ClientRun(stage, CASES, SILENT, options.plan, here, probe, listener.on_result)
        return await _judged(run, options, theirs, on_text, listener)


async def check_canopen_master(options: Options, listener: Listener) -> list[CaseResult]:
    """Test the SDO client and NMT master on a CAN bus. A software bus is created here."""
    if not options.listen.is_can:
        expected = "can:fieldtwin/HOST:PORT or can:socketcan/INTERFACE"
        raise UsageError("the endpoint for the client or master", expected=expected, got=str(options.listen))
    stage = HostileNode(
        options.words,
        size=options.size,
        held=dict(options.objects),
        nodes=sorted(options.nodes),
        heartbeat_s=options.heartbeat_s,
    )
    async with AsyncExitStack() as closing:
        bus = await OsPorts().can_bus(options.listen, options.bitrate, paced=True)
        closing.push_async_callback(bus.aclose)
        connection = await bus.join("hostile nodes")
        closing.push_async_callback(connection.aclose)
        nursery = await closing.enter_async_context(Nursery())
        nursery.start(stage.serve(connection), "nodes")
        probe, on_text = _probe(options, nursery)
        here = CAN_TRAITS | ({"heartbeat"} if options.heartbeat_s else set())
        run = ClientRun(stage, CANOPEN_CASES, CANOPEN_SILENT, options.plan, here, probe, listener.on_result)
        return await _judged(run, options, bus.bound, on_text, listener)


async def _judged(
    run: ClientRun[C], options: Options, theirs: Endpoint, on_text: OnText, listener: Listener
) -> list[CaseResult]:
    """Run the cases, together with the program under test if the options name one.

    `theirs` is the endpoint that the client opens, `on_text` receives the program's output.
    """
    task = asyncio.current_task()
    assert task is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    run.stage.recorder.on_event = listener.log
    listener.print_line(f"listening on {options.listen}; the client or master connects to {theirs}")
    if not options.command:
        return await run.run()
    program = ProgramUnderTest(options.command, theirs, on_text, run.ended)
    try:
        async with program:
            run.restart = program.restart
            return await run.run()
    finally:
        if run.exit_code is not None:
            listener.print_line(f"the program ended early, exit code {run.exit_code}; its last output:")
            for line in program.said:
                listener.print_line(f"  {line}")


async def _open(
    listen: Endpoint, stage: HostileServer, nursery: Nursery, closing: AsyncExitStack, framing: str
) -> Endpoint:
    """Begin to serve at `listen`, and return the endpoint that the client opens."""
    if listen.scheme in ("tcp", "rtu+tcp"):
        server = await OsPorts().listen(listen, stage.serve, MAX_CLIENTS)
        closing.push_async_callback(server.aclose)
        return server.bound
    if listen.is_serial:
        port = await OsConnector().open_bytes(listen)
        closing.push_async_callback(port.aclose)
        nursery.start(stage.serve(port), "line")
        return listen.with_path("the other end of the line")
    line = await PtyLine.open(listen, stage)
    closing.push_async_callback(line.aclose)
    nursery.start(line.run(), "line")
    return Endpoint(framing, path=line.named.path, params=listen.params)


def _probe(options: Options, nursery: Nursery) -> tuple[Probe | None, OnText]:
    """Return the probe, None if the options name none, and the function that receives the program's output."""
    if not options.probe:
        return None, lambda text, log: None
    kind, _, mark = options.probe.partition(":")
    if kind == "output":
        if not options.command:
            raise UsageError("nothing prints", expected="a program after -- for --probe output")
        if mark:
            marked = MarkedOutputProbe(mark, Classifier(options.words[2], options.stands_for_none))
            return marked, marked.feed
        words = dict(zip(options.words, (Word.FIRST, Word.SECOND, Word.POISON), strict=True))
        printed = OutputProbe(words)
        return printed, printed.feed
    classifier = Classifier(options.words[2], options.stands_for_none)
    probe = RegisterProbe(options.probe, OsConnector(), WallClock(), classifier)
    nursery.start(probe.run(), "probe")
    return probe, lambda text, log: None
