"""The steps of the commissioning guide as typed forms, each of which becomes one command line.

A browser never supplies an argument: it fills in a form, whose fields have types, limits and patterns, and this module makes the
arguments from it. Text of a user follows its option after ``=``, so that it cannot become a separate option.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta, Struct

from fieldtwin.gateway.core.endpoint import SOCKET_SCHEMES, TLS_PARAMS, Endpoint
from fieldtwin.gateway.core.errors import NotAllowed, UsageError
from fieldtwin.studio.commissioning.practice import profile_names
from fieldtwin.studio.commissioning.work_folder import WorkFolder

LONGEST_TEXT = 120
LOOPBACK = ("127.0.0.1", "::1", "localhost")

Url = Annotated[str, Meta(min_length=1, max_length=200)]
File = Annotated[str, Meta(min_length=1, max_length=80)]
Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]
Address = Annotated[int, Meta(ge=0, le=255)]
Numbers = Annotated[str, Meta(max_length=200, pattern=r"^[0-9]*([,-][0-9]+)*$")]
Range = Annotated[str, Meta(max_length=40, pattern=r"^[A-Za-z0-9][A-Za-z0-9:.]*$")]
Cell = Annotated[str, Meta(max_length=40, pattern=r"^[A-Za-z0-9][A-Za-z0-9:+]*$")]
Seconds = Annotated[float, Meta(ge=0.1, le=86_400)]
Tolerance = Annotated[str, Meta(max_length=60, pattern=r"^([A-Za-z_][A-Za-z0-9_]*=)?[0-9.]+%?$")]


@dataclass(frozen=True)
class Command:
    """A command line. `port` is the port, host or bus that it uses, "" for none; `writes` are the files that it makes.

    `out` is the file that receives its stdout. A command that is not `as_json` prints text, which is shown to the user.
    """

    arguments: tuple[str, ...]
    port: str = ""
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    adds_to: str = ""
    out: str = ""
    as_json: bool = True
    lasts: bool = field(default=False)
    """Whether the command runs until it is stopped."""

    @property
    def line(self) -> str:
        """Return the command line for a shell. It has no ``--json``, which only the guide needs to read the result."""
        shown = shlex.join(["fieldtwin", *self.arguments])
        return f"{shown} --json > {shlex.quote(self.out)}" if self.out else shown


class Step(Struct, tag_field="step", forbid_unknown_fields=True, kw_only=True):
    """The form of one step of the guide."""

    def command(self, folder: WorkFolder) -> Command:
        """Return the command line for the values of the form. Raises `UsageError` for a value that is not allowed."""
        raise NotImplementedError


class Listen(Step, tag="line"):
    """Listen to a line or bus without sending; `probe` is a unit ID to which one read request is sent."""

    endpoint: Url
    listen_s: Seconds = 5.0
    probe: Annotated[int, Meta(ge=1, le=247)] | None = None

    def command(self, folder: WorkFolder) -> Command:
        arguments = ["line", *_endpoint(self.endpoint, folder)]
        arguments += _duration("--listen", self.listen_s, 5.0) + _option("--probe", self.probe)
        return Command(tuple(arguments), _port(self.endpoint, folder))


class Scan(Step, tag="scan"):
    """Find devices. `units` are Modbus unit IDs or CANopen node IDs such as ``1-20,30``; empty means all."""

    endpoint: Url
    quick: bool = True
    every_setting: bool = False
    units: Numbers = ""
    listen_s: Seconds = 3.0
    share_bus: bool = False

    def command(self, folder: WorkFolder) -> Command:
        is_can = Endpoint.parse(self.endpoint).is_can
        arguments = ["scan", *_endpoint(self.endpoint, folder)]
        if not is_can:
            arguments += _flag("--quick", self.quick) + _flag("--all", self.every_setting and not self.quick)
        arguments += _option("--nodes" if is_can else "--units", self.units or None)
        arguments += _duration("--listen-for", self.listen_s, 5.0 if is_can else 3.0)
        arguments += _flag("--share-bus", self.share_bus)
        return Command(tuple(arguments), _port(self.endpoint, folder))


class Identify(Step, tag="identify"):
    """Ask one device for its identification. `address` is its unit ID, on a CAN bus its node ID."""

    endpoint: Url
    address: Address = 1

    def command(self, folder: WorkFolder) -> Command:
        arguments = ["identify", *_endpoint(self.endpoint, folder), *_address(self.endpoint, self.address)]
        return Command(tuple(arguments), _port(self.endpoint, folder))


class Dump(Step, tag="dump"):
    """Read all values of a device several times.

    Without `ranges` the dump reads the tags of the profile or the objects of the EDS, else everything, which can take long.
    """

    endpoint: Url
    out: File
    address: Address = 1
    ranges: Annotated[list[Range], Meta(max_length=20)] = []
    profile: File | None = None
    eds: File | None = None
    passes: Annotated[int, Meta(ge=1, le=10_000)] = 1
    every_s: Seconds = 10.0
    resume: bool = False

    def command(self, folder: WorkFolder) -> Command:
        out = folder.checked(self.out, ".jsonl")
        arguments = ["dump", *_endpoint(self.endpoint, folder), *_address(self.endpoint, self.address), *self.ranges]
        arguments += _profile(self.profile, folder) + _eds(self.eds, folder)
        if self.passes > 1:
            arguments += ["--passes", str(self.passes), *_duration("--every", self.every_s, 10.0)]
        arguments += ["-o", out, *_flag("--resume", self.resume)]
        log = f"{out.removesuffix('.jsonl')}.sent.jsonl"
        port = _port(self.endpoint, folder)
        reads = _files(folder, self.profile, self.eds)
        if self.resume:
            return Command(tuple(arguments), port, reads=(*reads, out), adds_to=out)
        return Command(tuple(arguments), port, reads, writes=(out, log))


class Infer(Step, tag="infer"):
    """Infer data types, word orders and counters from a dump or a recording, and write a draft of a profile."""

    dump: File
    out: File
    name: Text = ""

    def command(self, folder: WorkFolder) -> Command:
        dump, out = folder.checked(self.dump, ".jsonl"), folder.checked(self.out, ".yaml")
        arguments = ("infer", dump, *_text("--name", self.name), "-o", out)
        return Command(arguments, reads=(dump,), writes=(out,))


class Record(Step, tag="record"):
    """Record the device's answers to the reads of a profile or an EDS, for a number of rounds; without both, a recording of a CAN
    bus only listens.
    """

    endpoint: Url
    out: File
    profile: File | None = None
    eds: File | None = None
    address: Address | None = None
    rounds: Annotated[int, Meta(ge=1, le=1_000_000)] = 10
    every_s: Seconds = 1.0
    for_s: Seconds | None = None

    def command(self, folder: WorkFolder) -> Command:
        is_can = Endpoint.parse(self.endpoint).is_can
        out = folder.checked(self.out, ".log" if is_can else ".jsonl")
        arguments = ["record", *_endpoint(self.endpoint, folder), *_profile(self.profile, folder)]
        arguments += _eds(self.eds, folder)
        if self.profile is None and not is_can:
            raise UsageError("a recording needs a profile", hint="infer writes one")
        if self.profile is not None or self.eds is not None:
            arguments += _address(self.endpoint, self.address) if self.address is not None else []
            arguments += ["--rounds", str(self.rounds)] if self.for_s is None else []
            arguments += _duration("--every", self.every_s, 1.0)
        elif self.for_s is None:
            raise UsageError("a recording of a CAN bus needs a duration", expected="for_s")
        arguments += [*_duration("--for", self.for_s, None), "-o", out]
        return Command(
            tuple(arguments), _port(self.endpoint, folder), _files(folder, self.profile, self.eds), writes=(out,)
        )


class Emulate(Step, tag="emulate"):
    """Answer in the device's place: replay a recording, or emulate a profile. It listens on this computer only."""

    what: File
    on: Url
    address: Annotated[int, Meta(ge=1, le=247)] | None = None

    def command(self, folder: WorkFolder) -> Command:
        what = _shipped_or_file(self.what, folder, ".jsonl", ".yaml", ".log")
        endpoint = Endpoint.parse(self.on)
        if endpoint.scheme == "pty":
            folder.checked(endpoint.path)
        elif endpoint.is_can:
            if endpoint.interface != "fieldtwin" or endpoint.address[0] not in LOOPBACK:
                raise NotAllowed(
                    "the guide emulates on this computer only", expected="can:fieldtwin/127.0.0.1:PORT", got=self.on
                )
        elif endpoint.scheme not in ("tcp", "rtu+tcp", "udp") or endpoint.host not in LOOPBACK:
            raise NotAllowed(
                "the guide emulates on this computer only", expected="pty:NAME or tcp://127.0.0.1:PORT", got=self.on
            )
        option = "--node" if endpoint.is_can else "--unit"
        arguments = ("emulate", what, "--on", str(endpoint), *_option(option, self.address))
        port = f"emulator on {endpoint}"
        return Command(arguments, port, _files(folder, self.what), as_json=False, lasts=True)


class Compare(Step, tag="compare"):
    """Repeat the requests of a recording on another device or emulator, and compare the answers. `out` is the result file."""

    recording: File
    endpoint: Url
    out: File
    address: Address | None = None
    profile: File | None = None
    tolerances: Annotated[list[Tolerance], Meta(max_length=50)] = []
    judge_latency: bool = False
    listen_s: Seconds | None = None

    def command(self, folder: WorkFolder) -> Command:
        recording, out = folder.checked(self.recording, ".jsonl", ".log"), folder.checked(self.out, ".json")
        arguments = ["compare", recording, *_endpoint(self.endpoint, folder)]
        arguments += _address(self.endpoint, self.address) if self.address is not None else []
        arguments += _profile(self.profile, folder)
        arguments += [argument for amount in self.tolerances for argument in ("--tolerance", amount)]
        arguments += [] if self.judge_latency else ["--latency", "any"]
        arguments += _duration("--listen", self.listen_s, None)
        reads = (recording, *_files(folder, self.profile))
        return Command(tuple(arguments), _port(self.endpoint, folder), reads, writes=(out,), out=out)


class Check(Step, tag="check"):
    """Test the device against the standard by reading. With `confirmed` it also writes the registers or objects in `writes`."""

    endpoint: Url
    out: File
    html: File
    eds: File | None = None
    address: Address = 1
    writes: Annotated[list[Cell], Meta(max_length=10)] = []
    confirmed: bool = False

    def command(self, folder: WorkFolder) -> Command:
        is_can = Endpoint.parse(self.endpoint).is_can
        out, html = folder.checked(self.out, ".json"), folder.checked(self.html, ".html")
        arguments = ["check", "canopen" if is_can else "modbus", *_endpoint(self.endpoint, folder)]
        arguments += _address(self.endpoint, self.address) + _eds(self.eds, folder)
        arguments += [argument for cell in self.writes for argument in ("--write", cell)]
        arguments += ["--yes"] if self.writes and self.confirmed else []
        arguments += ["-o", out, "--html", html]
        return Command(tuple(arguments), _port(self.endpoint, folder), _files(folder, self.eds), writes=(out, html))


class Report(Step, tag="report"):
    """Make the acceptance document from the results of earlier steps."""

    files: Annotated[list[File], Meta(min_length=1, max_length=50)]
    out: File
    site: Text = ""
    by: Text = ""
    customer: Text = ""
    remarks: Text = ""
    device: Text = ""
    """The name of the device in the document, such as ``unit 3``, to which label and serial number belong."""
    label: Text = ""
    serial: Text = ""

    def command(self, folder: WorkFolder) -> Command:
        files = tuple(folder.checked(name, ".jsonl", ".json") for name in self.files)
        out = folder.checked(self.out, ".html")
        if (self.label or self.serial) and (not self.device or "=" in self.device):
            raise UsageError("label and serial number need the device", expected="a device such as `unit 3`")
        arguments = ["report", *files, "-o", out, *_text("--site", self.site), *_text("--by", self.by)]
        arguments += [*_text("--for", self.customer), *_text("--remarks", self.remarks)]
        arguments += _text("--label", f"{self.device}={self.label}" if self.label else "")
        arguments += _text("--serial", f"{self.device}={self.serial}" if self.serial else "")
        return Command(tuple(arguments), reads=files, writes=(out,))


AnyStep = Listen | Scan | Identify | Dump | Infer | Record | Emulate | Compare | Check | Report


def check_may_start(step: Step, command: Command, folder: WorkFolder) -> None:
    """Raise an error if the files of a command are missing or would be replaced, or if it writes to a device unconfirmed."""
    if isinstance(step, Check) and step.writes and not step.confirmed:
        raise NotAllowed("a check that writes to the device needs a confirmation", expected="confirmed: true")
    for name in command.reads:
        folder.existing(name)
    for name in command.writes:
        if (folder.path / name).exists():
            raise UsageError(f"the file {name} already exists", hint="choose another name; the guide replaces no file")


def _endpoint(url: str, folder: WorkFolder) -> list[str]:
    """Return an endpoint as an argument. The files of a TLS endpoint must be in the working folder."""
    endpoint = Endpoint.parse(url)
    if not url.isprintable():
        raise UsageError("the endpoint contains control characters", got=ascii(url))
    if endpoint.scheme == "pty":
        raise UsageError(f"{url} is a port to listen on", expected=f"rtu:{endpoint.path}")
    for name, value in endpoint.params:
        if endpoint.scheme == "tls" and name in TLS_PARAMS and name != "name":
            folder.checked(value)
    return [url]


def _port(url: str, folder: WorkFolder) -> str:
    """Return the port, host or bus that a command occupies. Two names of the same serial port give the same text."""
    endpoint = Endpoint.parse(url)
    if endpoint.is_serial:
        return str((folder.path / endpoint.path).resolve())
    if endpoint.scheme in SOCKET_SCHEMES:
        return f"{endpoint.host}:{endpoint.port}"
    return f"{endpoint.interface}/{endpoint.path}"


def _address(url: str, address: int | None) -> list[str]:
    return _option("--node" if Endpoint.parse(url).is_can else "--unit", address)


def _profile(name: str | None, folder: WorkFolder) -> list[str]:
    return [] if name is None else ["--profile", _shipped_or_file(name, folder, ".yaml")]


def _eds(name: str | None, folder: WorkFolder) -> list[str]:
    return [] if name is None else ["--eds", folder.checked(name, ".eds", ".dcf")]


def _shipped_or_file(name: str, folder: WorkFolder, *suffixes: str) -> str:
    """Return the name of a known profile, or that of a file of the folder."""
    return name if name in profile_names() else folder.checked(name, *suffixes)


def _files(folder: WorkFolder, *names: str | None) -> tuple[str, ...]:
    """Return those of `names` that are files and not known profiles."""
    return tuple(name for name in names if name is not None and name not in profile_names())


def _option(name: str, value: int | str | None) -> list[str]:
    return [] if value is None else [name, str(value)]


def _text(name: str, value: str) -> list[str]:
    if not value.isprintable():
        raise UsageError(f"{name} contains control characters", got=ascii(value))
    return [f"{name}={value}"] if value else []


def _flag(name: str, on: bool) -> list[str]:
    return [name] if on else []


def _duration(name: str, seconds: float | None, default: float | None) -> list[str]:
    """Return the option `name` with a duration; an empty list for the command's own default."""
    if seconds is None or seconds == default:
        return []
    return [name, f"{round(seconds * 1000)}ms" if seconds < 1 else f"{seconds:g}s"]
