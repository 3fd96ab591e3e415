"""The metrics of a run: name, type, help text and labels of each, declared once.

The metrics page, the Grafana dashboard and their tests use these declarations. Users have dashboards and alerts with these names:
changing a name or a label breaks them.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.service.exposition import Kind


@dataclass(frozen=True, slots=True)
class Metric:
    """A declared metric. `name` is the full name in Prometheus; the samples of a histogram add a suffix and the label `le`."""

    name: str
    kind: Kind
    help: str
    labels: tuple[str, ...]


ALL: list[Metric] = []
"""All metrics."""


def _metric(name: str, kind: Kind, help: str, labels: tuple[str, ...]) -> Metric:
    ALL.append(Metric(f"fieldtwin_{name}", kind, help, labels))
    return ALL[-1]


def _counter(name: str, help: str, *labels: str) -> Metric:
    return _metric(f"{name}_total", "counter", help, labels)


def _gauge(name: str, help: str, *labels: str) -> Metric:
    return _metric(name, "gauge", help, labels)


def _summary(name: str, help: str, *labels: str) -> Metric:
    """Declare quantiles that the run computes itself. Only a summary may have the label `quantile`."""
    return _metric(name, "summary", help, (*labels, "quantile"))


def _histogram(name: str, help: str, *labels: str) -> Metric:
    return _metric(name, "histogram", help, labels)


# -- the run ---------------------------------------------------------------------------------------------------------------

INFO = _gauge("info", "Version, system, and whether it is a plant or its prototype.", "version", "system", "mode")
RUN_SECONDS = _gauge("run_seconds", "Duration of this run.")
STATUS_AGE = _gauge("status_age_seconds", "Age of the statuses from which these metrics come.")
UP = _gauge("up", "Whether a process of the run is alive and, for gateway and PLC, answers.", "process")

# -- buses -----------------------------------------------------------------------------------------------------------------

BUS_CONNECTED = _gauge("bus_connected", "Whether the bus's connection is open.", "bus")
BUS_OPENS = _counter(
    "bus_opens", "How often the connection was opened; more than once means that it was lost and recovered.", "bus"
)
BUS_EVENTS = _counter(
    "bus_events",
    "Counters of the gateway on a bus: requests, replies, timeouts, CRC errors, frames, PDOs... by event.",
    "bus",
    "event",
)
BUS_LATENCY = _histogram(
    "bus_latency_seconds", "Response times: from request to reply (Modbus), and whole SDO transfers (CANopen).", "bus"
)
BUS_NOT_PRODUCED = _counter(
    "bus_not_produced", "SYNC, TIME and repeated RPDOs that could not be sent in their period.", "bus"
)

# -- devices ---------------------------------------------------------------------------------------------------------------

_OF_A_DEVICE = ("device", "bus")
DEVICE_ONLINE = _gauge("device_online", "Whether a device answers and has the expected identity.", *_OF_A_DEVICE)
DEVICE_WRONG = _gauge(
    "device_wrong", "Whether the device that answers differs from the one in the system file.", *_OF_A_DEVICE
)
DEVICE_POLLS = _counter("device_polls", "Polls of a device.", *_OF_A_DEVICE)
DEVICE_ERRORS = _counter("device_errors", "Polls that failed, and PDOs that were malformed.", *_OF_A_DEVICE)
DEVICE_BOOTS = _counter(
    "device_boots",
    "Boot-ups received from a CANopen node; more than expected means that the device restarts.",
    *_OF_A_DEVICE,
)
DEVICE_EMCYS = _counter("device_emcys", "Emergency messages of a CANopen node.", *_OF_A_DEVICE)
DEVICE_PDOS = _counter(
    "device_pdos", "Process data frames, by direction from the gateway's view.", *_OF_A_DEVICE, "direction"
)
DEVICES = _gauge("devices", "Devices of the system.")
DEVICES_ONLINE = _gauge("devices_online", "Devices that answer.")
DEVICES_LEFT_OUT = _gauge("devices_left_out", "Devices above the limit, which have no series.")

# -- tags ------------------------------------------------------------------------------------------------------------------

TAGS = _gauge("tags", "Tags by their present quality.", "quality")
TAGS_OLDEST = _gauge("tags_oldest_seconds", "Age of the oldest value.")
TAG_VALUE = _gauge(
    "tag_value",
    "Value of a tag in its engineering unit, while its quality is good; otherwise there is no sample.",
    "device",
    "tag",
    "unit",
)
TAG_GOOD = _gauge("tag_good", "Whether the quality of an exported tag is good.", "device", "tag")
TAG_PROBLEM = _gauge(
    "tag_problem",
    "1 with the reason while an exported tag is not good; otherwise no sample.",
    "device",
    "tag",
    "reason",
)
PUBLISHED = _counter("published", "Values published.")
LOGGED = _counter("logged", "Entries of the exchange log.")
LOG_DROPPED = _counter("log_dropped", "Entries that the exchange log lost.")
RELOADS = _counter("reloads", "Times that a changed configuration was applied.")
STORE_OK = _gauge("store_ok", "Whether the last write of the log to disk succeeded.")

# -- writes, messages and clients ------------------------------------------------------------------------------------------

WRITES_ALLOWED = _gauge("writes_allowed", "Whether this run may write.")
OUTPUTS_SAFE = _gauge("outputs_safe", "Whether the outputs are at their safe values because the PLC was lost.")
WRITES = _counter("writes", "Writes of outputs, by result; `repeated` ones are periodic repetitions.", "result")
OUTPUTS_PENDING = _gauge("outputs_pending", "Outputs whose device does not hold the commanded value yet.")
PLC_ALIVE = _gauge("plc_alive", "Whether the gateway receives the PLC's heartbeat.")
PLC_LOSSES = _counter("plc_losses", "How often the gateway lost the PLC.")
MAILBOX_QUEUED = _gauge("mailbox_queued", "Queued messages of a transmitter.", "device")
MAILBOX_MESSAGES = _counter("mailbox_messages", "Messages of a transmitter, by result.", "device", "what")
SERVER_EVENTS = _counter("server_events", "Counters of a server or bridge, by event.", "kind", "name", "event")
DEVICES_WRONG = _gauge("devices_wrong", "Devices that differ from those in the system file.")

# -- the PLC ---------------------------------------------------------------------------------------------------------------

PLC_SCANS = _counter("plc_scans", "Scans of a task.", "task")
PLC_MISSED_PERIODS = _counter("plc_missed_periods", "Periods in which a task's scan did not start.", "task")
PLC_OVERRUNS = _counter(
    "plc_overruns", "Scans that began too late (`late_ms`), or ended after the next one was due.", "task"
)
PLC_PERIOD = _gauge("plc_period_seconds", "Configured period of a cyclic task.", "task")
PLC_LATENESS = _summary(
    "plc_lateness_seconds", "Start delay of scans since the start, by quantile; 1 is the maximum.", "task"
)
PLC_SCAN = _summary("plc_scan_seconds", "Duration of scans since the start, by quantile; 1 is the maximum.", "task")
PLC_RUNNING = _gauge("plc_running", "Whether a task runs; 0 is stopped or failed.", "task")
PLC_STATE = _gauge(
    "plc_state", "Whether a task is in a state: 1 for its present state, 0 for the others.", "task", "state"
)
PLC_PROGRAMS_WAITING = _gauge("plc_programs_waiting", "Programs that wait for their inputs and have not started.")
PLC_RESTARTS = _counter("plc_restarts", "Restarts of the PLC's program after a failure.")
PLC_CHANGES = _counter("plc_changes", "Times that programs were replaced while they ran.")
PLC_FORCES = _gauge("plc_forces", "Variables that are forced.")
PLC_EVENTS = _counter("plc_events", "Counters of the PLC's process image and messages, by event.", "event")
THREAD_DROPPED = _counter("thread_dropped", "Events that the digital thread's log lost.")
