"""The pydantic models of the YAML form of system files and prototype files.

The plant reads `SystemForm` only. `PrototypeForm` describes a separate file, which the plant never opens.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from fieldtwin.twin.site.alarm_forms import AlarmForm
from fieldtwin.twin.site.base_forms import (
    Milliseconds,
    Name,
    Pause,
    SiteModel,
    SourceName,
    TagName,
    VariableName,
)
from fieldtwin.twin.site.serve_forms import ServeForm


class SyncForm(SiteModel):
    """The SYNC producer of a CANopen bus (CiA 301: objects 1006h and 1019h of the master)."""

    period_ms: Milliseconds = Field(examples=[100])
    counter: int = Field(default=0, ge=0, le=240, description="highest value of the counter, 2 to 240; 0: no counter")


class BusForm(SiteModel):
    """A bus or serial line, and the endpoint at which the plant opens it."""

    url: str = Field(examples=["tcp://192.0.2.7:502"])
    timeout_ms: Milliseconds = 1000
    retries: int = Field(default=1, ge=0, le=10)
    bitrate: int = Field(
        default=125_000, ge=10_000, le=1_000_000, description="only for CAN; the bit rate is checked, not set"
    )
    spacing_ms: Pause = Field(default=0, description="Modbus: pause after every exchange on the bus, ms")
    turnaround_ms: Milliseconds = Field(default=100, description="Modbus: pause after a broadcast, ms")
    connect_pause_ms: Pause | None = Field(
        default=None, description="Modbus: pause after connecting, ms; default: the longest of its devices' profiles"
    )
    echo: bool = Field(default=False, description="serial: the adapter echoes the sent bytes")
    strict: bool = Field(default=False, description="RTU: reject frames with pauses that the standard forbids")
    probe_percent: int = Field(
        default=10,
        ge=1,
        le=100,
        description="Modbus: maximum share of the bus time for silent devices while others answer",
    )
    sync: SyncForm | None = None
    time_ms: Milliseconds | None = Field(default=None, description="CANopen: period of the TIME message, ms")
    short_sdo: bool = Field(default=False, description="CANopen: accept SDO replies of fewer than 8 bytes")
    sdo_transfer_ms: Milliseconds = Field(default=600_000, description="CANopen: limit of a whole SDO transfer")


class PollForm(SiteModel):
    """How often a poll group is read, and its phase within the period.

    By default groups with the same period are spread over it.
    """

    every_ms: Milliseconds = Field(examples=[500])
    phase_ms: int | None = Field(default=None, ge=0, lt=3_600_000)


class HeartbeatForm(SiteModel):
    """CANopen heartbeat times (CiA 301: 1017h in the node, 1016h in the master).

    Without `producer_ms` the node keeps its own time.
    """

    producer_ms: Milliseconds | None = None
    consumer_ms: Milliseconds = Field(examples=[1500])


class TpdoForm(SiteModel):
    """The tags that a TPDO of the node carries, and how often it is sent."""

    map: list[Name] = Field(min_length=1, max_length=8)
    event_ms: Milliseconds = Field(examples=[200])


class RpdoForm(SiteModel):
    """The tags that an RPDO of the node carries, and when the node applies them: at once, or at the next SYNC."""

    map: list[Name] = Field(min_length=1, max_length=8)
    transmission: Literal["event", "sync"] = "event"
    event_ms: Milliseconds | None = Field(default=None, description="period in which it is sent without a change, ms")


class IdentityForm(SiteModel):
    """The values that a CANopen node must hold in 1000h and 1018h (CiA 302: objects 1F84h to 1F88h of the master)."""

    device_type: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)
    vendor: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)
    product: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)
    revision: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)
    serial: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)


class DeviceForm(SiteModel):
    """An entry of `devices` in a system file: one device of the system."""

    profile: str = Field(examples=["eastron-sdm630"])
    bus: Name = Field(examples=["line1"])
    unit: int | None = Field(default=None, ge=1, le=255)
    node: int | None = Field(default=None, ge=1, le=127)
    expect: dict[Name, str] = Field(default={})
    poll: dict[Name, PollForm] = Field(default={})
    timeout_ms: Milliseconds | None = Field(default=None, description="default: the profile's, else the bus's")
    retries: int | None = Field(default=None, ge=0, le=10, description="default: the bus's")
    spacing_ms: Pause | None = Field(
        default=None, description="Modbus: pause between a reply and the next request for it"
    )
    backoff_first_ms: Milliseconds = Field(
        default=250, description="first pause before a lost device is tried again, ms"
    )
    backoff_limit_ms: Milliseconds = Field(default=10_000, description="the pause doubles up to this limit, ms")
    stale_after_ms: Milliseconds = 5000
    writable: list[Name] = Field(default=[])
    safe: dict[Name, bool | int | float | str] = Field(
        default={}, description="tag -> its safe value: a number, true or false, or the value's name"
    )
    write_groups: dict[Name, Annotated[list[Name], Field(min_length=2, max_length=32)]] = Field(
        default={},
        description="name -> outputs of programs that are written all together, in this order, or not at all",
    )
    heartbeat: HeartbeatForm | None = None
    tpdo1: TpdoForm | None = None
    sdo_transfer_ms: Milliseconds | None = Field(default=None, description="CANopen: default: the bus's")
    identity: IdentityForm | None = None
    dcf: str | None = Field(
        default=None, description="CANopen: the node's configuration, written if the node holds different values"
    )
    store: bool = Field(default=False, description="CANopen: the node stores its configuration permanently")
    lss: bool = Field(default=False, description="CANopen: assign the node ID over LSS to the node with this identity")
    tpdos: Literal["node", "dcf"] | None = Field(default=None, description="CANopen: source of the TPDO mappings")
    rpdo1: RpdoForm | None = None
    rpdos: Literal["node", "dcf"] | None = Field(default=None, description="CANopen: source of the RPDO mappings")
    start: bool = False


class WatchdogForm(SiteModel):
    """The limits of the PLC's watchdog: the delay of a late scan, the consecutive overruns before a stop, the time after which a
    scan that does not end is aborted, and the number of restarts of the programs after that.
    """

    late_ms: Milliseconds = 5
    stop_after: int = Field(default=3, ge=1, le=1000)
    stuck_ms: Milliseconds | None = Field(default=None, description="default: 20 cycles, at least 200 ms")
    restart_after_ms: Milliseconds = 1000
    restarts: int = Field(default=3, ge=0, le=100, description="restarts in a row; 0: stay stopped")


class InputForm(SiteModel):
    """The source of a program's input, and the value that the program sees while that source is bad."""

    tag: SourceName = Field(examples=["meter.frequency"])
    if_bad: Literal["hold", "pass", "trip"] | float = "pass"


class StartForm(SiteModel):
    """The start of a program: how long it waits until each input has been good once, and the action after that time."""

    timeout_ms: int = Field(default=10_000, ge=0, le=3_600_000, description="0: do not wait")
    at_timeout: Literal["wait", "stop", "start_anyway"] = Field(
        default="wait",
        description="wait: continue to wait and report it; stop: stop the PLC, outputs safe; "
        "start_anyway: start with the inputs that it has",
    )


_SOURCE_OR_FILES = {
    "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": 32}]
}


class ProgramForm(SiteModel):
    """A program of the PLC: its source, and the tags to which its variables are bound."""

    source: Annotated[str, WithJsonSchema(_SOURCE_OR_FILES)] = Field(examples=["control.st", ["main.st", "blocks.st"]])
    dialect: Literal["standard", "codesys", "twincat", "matiec"] = Field(
        default="standard", description="of a source in Structured Text"
    )
    libraries: list[str] = Field(
        default=[],
        max_length=32,
        description="files or folders of Structured Text, from which used declarations are taken",
    )
    machine_code: bool = Field(
        default=False,
        description="of a source in Structured Text: compile it with the computer's C compiler, so that a scan takes less time; "
        "the results are the same",
    )
    task: Name | None = Field(default=None, description="default: the first task")
    start: StartForm | None = Field(default=None, description="default: the PLC's")
    inputs: dict[VariableName, InputForm] = Field(default={})
    outputs: dict[VariableName, TagName] = Field(default={})
    invariants: dict[str, str] = Field(
        default={},
        max_length=64,
        description="of a source in Structured Text, for `plc prove`: by name an expression over its variables that is TRUE "
        "after every scan",
    )
    assumptions: dict[str, str] = Field(
        default={},
        max_length=64,
        description="for `plc prove`: by name an expression over its variables that is TRUE before every scan, such as a limit "
        "of an input",
    )

    @model_validator(mode="before")
    @classmethod
    def _from_files(cls, data: Any) -> Any:
        """Take the first of several files for the source, and the others like libraries: it uses their declarations."""
        files = data.get("source") if isinstance(data, dict) else None
        if not isinstance(files, list) or not files or not all(isinstance(one, str) for one in files):
            return data
        libraries = data.get("libraries", [])
        if not isinstance(libraries, list):
            return data
        return {**data, "source": files[0], "libraries": [*files[1:], *libraries]}


class TaskForm(SiteModel):
    """A task (IEC 61131-3): runs every `interval_ms`, or once at each rising edge of the tag `single`.

    Priority 0 is the highest.
    """

    interval_ms: Milliseconds | None = None
    priority: int = Field(default=10, ge=0, le=0xFFFF)
    late_ms: Milliseconds | None = Field(default=None, description="default: the watchdog's")
    single: TagName | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> TaskForm:
        if (self.interval_ms is None) == (self.single is None):
            raise ValueError("a task has either interval_ms or single")
        return self


class PlcForm(SiteModel):
    """The soft PLC: its cycle, tasks and programs."""

    cycle_ms: Milliseconds = 10
    watchdog: WatchdogForm = WatchdogForm()
    start: StartForm = Field(default=StartForm(), description="how long programs wait for their inputs")
    outputs_at: Literal["start", "end"] = Field(
        default="end", description="start: a scan's outputs change at the next cycle"
    )
    tasks: dict[Name, TaskForm] = Field(default={}, description="default: those of the sources, or one, every cycle_ms")
    programs: dict[Name, ProgramForm] = Field(
        default={}, description="none: a different controller commands, or no controller"
    )


class AllowForm(SiteModel):
    """The requests that clients of some networks may send. Units and addresses are numbers, or ranges such as 0..99."""

    networks: list[str] = Field(default=["127.0.0.0/8", "::1/128"], alias="from", min_length=1)
    units: list[int | str] | None = None
    functions: list[int | Literal["read", "write"]] = Field(default=["read"])
    addresses: dict[Literal["coil", "discrete", "input", "holding"], list[int | str]] | None = None
    roles: list[str] | None = Field(default=None, description="TLS: the roles that it is for; default: every client")


class BridgeForm(SiteModel):
    """A bridge: lets Modbus TCP clients, or the client on a serial line (`url`), reach units of the system's buses."""

    url: str = Field(examples=["tcp://127.0.0.1:1502"])
    to: Name | None = Field(default=None, description="the bus whose units keep their unit IDs")
    units: dict[int, str] = Field(default={}, description="the client's unit ID -> BUS/UNIT")
    allow: list[AllowForm] = Field(default=[], description="default: reading functions, from this host")
    broadcast: bool | Literal["answer"] = Field(
        default=False, description="forward unit 0 to serial lines; answer: reply to the client as well"
    )
    cache_ms: int = Field(default=0, ge=0, le=60_000)
    clients: int = Field(default=16, ge=1, le=1000)
    queue: int = Field(default=32, ge=1, le=64)
    in_flight: int = Field(default=16, ge=1, le=64)
    idle_s: int = Field(
        default=0, ge=0, le=86_400, description="silent clients are disconnected after this time; 0: never"
    )


class CommandsForm(SiteModel):
    """The commands that a digital twin may send over a thread while `remote` is set to remote."""

    period_s: list[int] = Field(
        default=[-32768, 32767], min_length=2, max_length=2, description="smallest and largest period in seconds"
    )
    per_minute: int = Field(default=60, ge=1, le=6000, description="maximum number of commands in any minute")

    @model_validator(mode="after")
    def _in_order(self) -> CommandsForm:
        if not -32768 <= self.period_s[0] <= self.period_s[1] <= 32767:
            raise ValueError("period_s is the smallest and the largest, of 16 bits")
        return self


class FollowsForm(SiteModel):
    """Each time that `after` becomes true, `then` must become true `within` a time, such as 2s."""

    after: str
    then: str
    within: str


class InvariantsForm(SiteModel):
    """Conditions that must hold in every run, scenario and campaign of this system: expressions as in scenarios."""

    always: list[str] = Field(default=[], max_length=200)
    never: list[str] = Field(default=[], max_length=200)
    within: list[FollowsForm] = Field(default=[], max_length=200)


NONE_STATED = InvariantsForm()
"""The invariants of a system whose file states none."""


TagPattern = Annotated[str, Field(pattern=r"^[a-zA-Z*?][a-zA-Z0-9_*?]*\.[a-zA-Z*?][a-zA-Z0-9_*?]*$")]


class MetricsForm(SiteModel):
    """The tags whose values are exported to Prometheus by `run --metrics`: names or patterns with * and ?."""

    tags: list[TagPattern] = Field(min_length=1, max_length=1000, examples=[["meter.*"]])


class SystemForm(SiteModel):
    """The form of a system file, which describes a plant. The physical twin and its prototype read the same file, byte for
    byte.
    """

    fieldtwin: Literal[1]
    system: Name = Field(examples=["mysite"])
    buses: dict[Name, BusForm] = Field(default={}, description="none only with programs of the PLC")
    devices: dict[Name, DeviceForm] = Field(default={}, description="none only with programs of the PLC")
    plc: PlcForm = Field(default=PlcForm(), description="default: no programs, only the gateway")
    remote: Literal["local", "remote"] = "local"
    commands: CommandsForm = CommandsForm()
    serve: dict[Name, ServeForm] = Field(default={})
    bridge: dict[Name, BridgeForm] = Field(default={})
    invariants: InvariantsForm = Field(
        default=InvariantsForm(), description="conditions that hold in every run, scenario and campaign"
    )
    alarms: dict[Name, AlarmForm] = Field(default={}, description="the alarm list of the gateway")
    metrics: MetricsForm | None = Field(default=None, description="default: metrics contain no values of tags")


class BusMappingForm(SiteModel):
    """The endpoint at which the emulators of a bus of the plant listen."""

    listen: str
    pace: bool = True


class FarLinkForm(SiteModel):
    """The acoustic link between the two modems.

    The modems send messages again that are lost by `loss`. They do not correct the faults `lost`, `repeated` and `overtakes`,
    which are probabilities per message.
    """

    bytes_per_s: float = Field(default=80.0, gt=0)
    latency_ms: int = Field(default=900, ge=0, le=600_000)
    loss: float = Field(default=0.0, ge=0.0, lt=1.0)
    lost: float = Field(default=0.0, ge=0.0, le=1.0)
    repeated: float = Field(default=0.0, ge=0.0, le=1.0)
    overtakes: float = Field(default=0.0, ge=0.0, le=1.0)

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class BusyForm(SiteModel):
    """After every `every` accepted requests, a Modbus device answers with exception 06 (busy) for `for_ms` milliseconds."""

    every: int = Field(ge=1)
    for_ms: Milliseconds


def _as_text(formula: object) -> object:
    """Convert a numeric constant to the text of a formula; return any other value unchanged."""
    return repr(formula) if isinstance(formula, int | float) and not isinstance(formula, bool) else formula


Formula = Annotated[str, BeforeValidator(_as_text, json_schema_input_type=str | int | float)]


class SimulationForm(SiteModel):
    """A simulation: values that formulas, a Python class or an FMU compute step by step."""

    step_ms: float = Field(default=100.0, ge=0.1, le=60_000)
    formulas: dict[Name, Formula] = Field(default={}, description="name -> formula of t, dt, inputs and each other")
    python: str | None = Field(
        default=None, description="FILE.py:CLASS, in the folder of this file; it has step(t_s, dt_s, inputs)"
    )
    fmu: str | None = Field(
        default=None,
        description="FILE.fmu, in the folder of this file: FMI 2.0 or 3.0, co-simulation",
        examples=["tank.fmu"],
    )
    variables: dict[Name, str] = Field(
        default={}, description="FMU: name -> the FMU's variable; default: equal names", examples=[{"level": "tank.h"}]
    )
    limit_ms: Milliseconds = Field(default=5000, description="FMU: the longest real time of one step")
    start: dict[Name, float] = Field(
        default={}, description="name -> its value before the first step; FMU: also the values of parameters"
    )
    inputs: dict[Name, TagName] = Field(default={}, description="name -> DEVICE.TAG, as the device holds it")

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class EmulatedForm(SiteModel):
    """The data source of an emulated device: a recording (time-keyed signals), a simulation, or a model."""

    recording: str | None = None
    simulation: str | None = Field(default=None, description="one of `simulations:`, whose values the device plays")
    plays: dict[Name, Name] = Field(default={}, description="tag -> name in the simulation; default: equal names")
    model: Literal["mailbox", "profile"] | None = None
    profile: str | None = Field(default=None, description="the emulated device's own profile, where it differs")
    cia: Literal["401", "402", "404", "406", "410", "none"] | None = Field(
        default=None,
        description="CANopen: the device profile whose model computes the objects; default: from object 1000h",
    )
    parameter_values: bool = Field(
        default=True, description="CANopen: false starts with the data sheet's DefaultValues"
    )
    speed: float = Field(default=1.0, gt=0, le=10_000)
    at_end: Literal["hold", "loop", "error"] = "hold"
    latency_ms: float = Field(default=0.0, ge=0, le=60_000)
    identity: dict[Name, str] = Field(default={})
    values: dict[Name, int | float | str] = Field(
        default={}, description="model profile, Modbus: tag -> its initial value"
    )
    busy: BusyForm | None = None
    far: str | None = Field(default=None, description="the endpoint of the topside modem")
    far_link: FarLinkForm = FarLinkForm()

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class PrototypeForm(SiteModel):
    """The form of a prototype file: the emulated devices, their data sources and their endpoints. The plant never opens this
    file."""

    prototype_of: str = Field(examples=["mysite.yaml"])
    unmapped: Literal["refuse"] = "refuse"
    seed: int = 1
    buses: dict[Name, BusMappingForm | Literal["plant"]] = Field(default={})
    simulations: dict[Name, SimulationForm] = Field(default={})
    devices: dict[Name, EmulatedForm] = Field(default={})
