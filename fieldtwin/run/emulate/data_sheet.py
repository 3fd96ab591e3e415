"""Emulate a CANopen node from its EDS or from a log alone: `fieldtwin emulate FILE.eds|FILE.log --on can:...`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from fieldtwin.capture.recordings.log_sheet import LogSheet, nodes_of
from fieldtwin.console import stderr
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, load_eds
from fieldtwin.emulators.canopen.eds.remarks import Remark
from fieldtwin.emulators.canopen.lss.slave import UNCONFIGURED
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.emulators.host import EmulatorHost
from fieldtwin.emulators.models.canopen.by_profile import model_for
from fieldtwin.emulators.models.canopen.emulated_node import NodeOptions, node_remarks
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.objects import recorded_objects
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.emulate.can_bus import only_bus, open_bus
from fieldtwin.run.emulate.serve_until import serve_until

DEFAULT_NODE_ID = 1


async def run_data_sheet(
    path: Path,
    endpoints: tuple[str, ...],
    node_id: int | None,
    bitrate: int | None = None,
    log: Path | None = None,
    options: NodeOptions | None = None,
) -> int:
    """Serve until SIGINT or SIGTERM; raise the error that ended the serving. Repairs made to the file are reported first.

    The node ID is `node_id`, else the one that a DCF commissions, else 1. The bit rate of a bus that is made here is
    `bitrate`, else that of the DCF, else 125 kbit/s. `log` is a candump -L log of such a node; the emulated node holds
    the recorded values. Raises `FileInvalid` for a file that cannot be used, `UsageError` for endpoints that are not
    one bus and for a log without frames of the node.
    """
    options = options or NodeOptions()
    dictionary = load_eds(path, parameter_values=options.parameter_values)
    for note in dictionary.notes:
        stderr.print(f"{path.name}, {note}", soft_wrap=True)
    wires = [Endpoint.parse(url) for url in endpoints]
    wire = only_bus(wires)
    node = _node(dictionary, node_id or dictionary.node_id or DEFAULT_NODE_ID, log, options)
    if log is None or options.model is not None:  # the behaviour of a node from a log comes from its recording
        print_remarks(path.name, node_remarks(dictionary, node.node_id, node.context.model, options))
    report_second_node(node)
    host, stop = EmulatorHost(WallClock(), OsPorts()), stop_signal()
    try:
        port, where = await open_bus(wire, bitrate or dictionary.bit_rate)
        await host.serve_nodes(str(wire), port, {path.stem: node})
        stderr.print(f"{_named(node)} on {where}", soft_wrap=True)
        await serve_until(stop, host)
    finally:
        await host.aclose()
    return 0


async def run_log(path: Path, endpoints: tuple[str, ...], node_id: int | None, bitrate: int | None = None) -> int:
    """Serve like `run_data_sheet`, with a data sheet made from the log, so that the node has exactly the logged objects."""
    log = CanLog(path)
    there = nodes_of(log.frames())
    if node_id is None and len(there) != 1:
        if not there:
            raise UsageError(f"{path.name} contains no node")
        raise UsageError(f"{path.name}: the node is not given", expected=f"--node, one of {', '.join(map(str, there))}")
    node_id = node_id or there[0]
    text = LogSheet(log.frames(), node_id).eds(path.stem)
    stderr.print(f"node {node_id} has what {path.name} has of it; names and meanings are not known", soft_wrap=True)
    with TemporaryDirectory(prefix="fieldtwin-") as folder:
        sheet = Path(folder) / f"{path.stem}.eds"
        sheet.write_text(text, encoding="utf-8")
        return await run_data_sheet(sheet, endpoints, node_id, bitrate, path)


def print_remarks(name: str, found: Iterable[Remark]) -> None:
    """Print the differences from a node's data sheet, and the option of `emulate` that overrides each."""
    for remark in found:
        advice = ""
        if remark.by_parameter_value:
            advice = " (--defaults starts with the DefaultValues)"
        elif remark.model:
            advice = " (--model 402 chooses a model, --model none means it)"
        stderr.print(f"{name}: {remark.text}{advice}", soft_wrap=True, markup=False)


def report_second_node(node: CanopenNode) -> None:
    """Print a message when another node on the bus has the node ID of `node`."""

    def report(can_id: int) -> None:
        stderr.print(
            f"{_named(node)}: another node on the bus has this node ID: it sent {can_id:03X}h (--node gives another one)",
            soft_wrap=True,
        )

    node.on_second_node(report)


def _node(dictionary: Dictionary, node_id: int, log: Path | None, options: NodeOptions) -> CanopenNode:
    """Return the node with its recorded values, and with the model that `options` or 1000h name, if any."""
    model = model_for(dictionary, options.model)
    if log is not None:
        played = recorded_objects(CanLog(log), dictionary, node_id)
        context = NodeContext(source=played, factory=played.initial, refusals=played.refusals, model=model)
        return CanopenNode(dictionary, node_id, context)
    return CanopenNode(dictionary, node_id, NodeContext(model=model))


def _named(node: CanopenNode) -> str:
    return "node without a node ID" if node.node_id == UNCONFIGURED else f"node {node.node_id}"
