"""The pydantic models of a device profile's YAML file (see docs and `fieldtwin schema profile`).

fieldtwin.gateway.core.files.profile_file converts these models to frozen objects with resolved addresses.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

ValueType = Literal[
    "bool",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float32",
    "float64",
    "bcd16",
    "bcd32",
    "string",
    "bytes",
]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
Access = Literal["ro", "rw", "wo"]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*(\.\.[0-9]+)?$")]
Address = int | str
ByteNumber = Annotated[int, Field(ge=0, le=255)]
Word = Annotated[int, Field(ge=0, le=0xFFFF)]
FileNumber = Annotated[int, Field(ge=1, le=0xFFFF)]


class Strict(BaseModel):
    """The base of all models: it refuses unknown keys and does not convert values."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Factory(Strict):
    """The device's settings when it leaves the factory."""

    baudrate: int = Field(default=19200, gt=0)
    frame: str = Field(default="8E1", pattern=r"^[78][NEO][12]$")
    unit: int = Field(default=1, ge=0, le=255)
    node: int = Field(default=1, ge=1, le=127)


class Limits(Strict):
    """The limits of the device, which both the driver and the emulator observe."""

    functions: list[int] | None = None
    read_registers: int = Field(default=125, ge=1, le=125)
    even_only: bool = False
    max_gap: int = Field(
        default=8, ge=0, le=125, description="unused registers to read, at most, so that two reads become one"
    )


class TimingForm(Strict):
    """The timing that the device needs from its clients, in milliseconds. A system file may override it."""

    timeout_ms: int | None = Field(default=None, ge=1, le=3_600_000, description="maximum time until a reply, ms")
    spacing_ms: int = Field(default=0, ge=0, le=60_000, description="pause between a reply and the next request")
    connect_pause_ms: int = Field(default=0, ge=0, le=60_000, description="pause after connecting, ms")


class Defaults(Strict):
    """The default properties of the tags, for each tag that does not set them itself."""

    type: ValueType = "uint16"
    order: Order = "ABCD"
    poll: str = "values"


class TagForm(Strict):
    """One value of the device. Modbus uses `at`, CANopen uses `object` ("6010:00")."""

    at: Address | None = None
    object: str | None = Field(default=None, pattern=r"^[0-9A-Fa-f]{4}:[0-9A-Fa-f]{2}$")
    type: ValueType | None = None
    order: Order | None = None
    registers: int | None = Field(default=None, ge=1, le=125, description="number of registers of a string or of bytes")
    poll: str | None = None
    access: Access = "ro"
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    scale_by: str | None = Field(default=None, description="tag that holds the power of ten to multiply by (SunSpec)")
    bits: tuple[int, int] | None = Field(
        default=None, description="Modbus: lowest and highest bit of one register, 0 to 15; one bit with type bool"
    )
    sentinels: list[int] = Field(
        default=[], description="raw values that mean that the value is not implemented (SunSpec 0x8000, 0xFFFF)"
    )
    values: dict[int, str] | None = None
    range: tuple[float, float] | None = None
    counter: bool = False
    nonvolatile: bool = False
    secret: bool = False
    danger: str = ""
    description: str = ""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class MessageForm(Strict):
    """A block of registers that the driver emits unaltered as one message each time the tag `when` changes."""

    at: Address
    registers: int = Field(ge=1, le=125)
    when: str


class SampledForm(Strict):
    """A group of samples: the values of group `poll` are new when tag `count` changes; tag `period` holds the seconds between two
    samples.
    """

    count: str
    period: str
    slack_ms: int = Field(default=1500, ge=0)
    poll: str = "values"


class BoxForm(Strict):
    """One direction of a mailbox. Sequence, length and payload begin at `at`; the acknowledged sequence is at `ack`."""

    at: Address
    bytes: int = Field(ge=2, le=240)
    ack: Address


class MailboxForm(Strict):
    """A transmitter's two mailboxes."""

    inbox: BoxForm
    outbox: BoxForm


class IdentifyForm(Strict):
    """A read whose reply distinguishes this device from others; `tag` names the value to compare with `expect`."""

    tag: str
    expect: str | int | None = Field(default=None, description="the expected value; surrounding spaces are ignored")
    between: tuple[float, float] | None = Field(
        default=None, description="plausible range, for a device without an identity to read"
    )

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class TriggerForm(Strict):
    """The device measures when `value` is written to `tag`; the poll group `poll` can be read `wait_ms` milliseconds later."""

    tag: str
    value: int
    wait_ms: int = Field(ge=1, le=60_000)
    poll: str = "values"


class FunctionForm(Strict):
    """A device-specific function (AP 5). Request and reply are data bytes in hex, without the function code."""

    code: int = Field(ge=1, le=127)
    request: str = Field(
        default="",
        pattern=r"^([0-9A-Fa-f]{2} ?)*$",
        description="the accepted request data; other data gets exception 03",
    )
    reply: str | None = Field(default=None, pattern=r"^([0-9A-Fa-f]{2} ?)*$", description="default: the request data")
    sets: dict[Name, int | float] = Field(default={}, description="tag -> its value afterwards")
    danger: str = ""


class EffectForm(Strict):
    """A side effect of reading or writing a tag: the values that other tags, or the tag itself, hold afterwards."""

    read: Name | None = None
    written: Name | None = None
    value: int | float | None = Field(default=None, description="only when this value is written; default: any value")
    sets: dict[Name, int | float] = Field(min_length=1, description="tag -> its value afterwards")

    @model_validator(mode="after")
    def _one_of_both(self) -> EffectForm:
        if (self.read is None) == (self.written is None) or (self.read is not None and self.value is not None):
            raise ValueError("an effect has either `read`, or `written` with or without a `value`")
        return self


class ProfileForm(Strict):
    """A device profile."""

    device: str = Field(pattern=r"^[a-z0-9-]+/[a-z0-9.-]+$", examples=["acme/t-1000"])
    source: str = Field(examples=["manual, revision 3"])
    protocol: Literal["modbus", "canopen"]
    factory: Factory = Factory()
    numbering: Literal["printed", "sent"] = "printed"
    limits: Limits = Limits()
    timing: TimingForm = TimingForm()
    gaps: list[str] = Field(default=[], description='registers that a read must not include, such as "holding:10..19"')
    undeclared: Literal["exception", "zero", "hold"] = Field(
        default="exception",
        description="the answer for registers that no tag names, in tables that have tags: exception 02, 0, or 0 until written",
    )
    defaults: Defaults = Defaults()
    eds: str | None = None
    identify: list[IdentifyForm] = []
    sampled: SampledForm | None = None
    trigger: TriggerForm | None = None
    mailbox: MailboxForm | None = None
    messages: dict[Name, MessageForm] = Field(default={}, max_length=1)
    tags: dict[Name, TagForm] = {}
    functions: dict[Name, FunctionForm] = Field(default={}, description="function codes that are not in the standard")
    effects: list[EffectForm] = Field(default=[], description="the effects of reading or writing a tag on other tags")
    server_id: str | None = Field(
        default=None,
        pattern=r"^([0-9A-Fa-f]{2} ?){1,249}$",
        description="server id in the reply to function 11h, in hex",
    )
    server_data: str = Field(
        default="",
        pattern=r"^([0-9A-Fa-f]{2} ?){0,249}$",
        description="data after the run indicator in the reply to function 11h, in hex",
    )
    identification: dict[ByteNumber, Annotated[str, Field(max_length=244)]] = Field(
        default={}, description="objects of function 2Bh/0Eh: 0 vendor, 1 product code, 2 revision, 3 to 6, 128 to 255"
    )
    files: dict[FileNumber, Annotated[int, Field(ge=1, le=10_000)]] = Field(
        default={}, description="file of functions 14h and 15h -> its number of records"
    )
    fifos: dict[Word, Annotated[list[Word], Field(max_length=1000)]] = Field(
        default={}, description="FIFO queue of function 18h: its pointer address -> its values"
    )
    commands: dict[Name, str] = Field(default={}, description="command name -> the tag it writes")
    behaviours: dict[Name, dict[str, int | float]] = Field(default={}, description="behaviour -> command -> value")
