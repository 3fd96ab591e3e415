"""The command-line options of a run, checked for consistency before anything starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.url_secrets import has_password, without_password
from fieldtwin.gateway.store.knowledge import check_place


@dataclass(frozen=True)
class RunOptions:
    """The options of a run.

    `duration_s` 0 means until stopped; `field_host` is ``HOST[:PORT]`` of a field simulator that was started elsewhere.
    """

    system: str
    prototype: bool
    allow_writes: bool = False
    duration_s: float = 0.0
    instance: str = ""
    profiles: tuple[Path, ...] = ()
    prototype_file: Path | None = None
    field_host: str = ""
    token: str = field(default="", repr=False)
    recordings: dict[str, str] = field(default_factory=dict)
    speed: float = 0.0
    listen: dict[str, str] = field(default_factory=dict)
    can: str = ""
    commands: tuple[int, ...] = ()
    capture: Path | None = None
    record_frames: bool = False
    """Whether to capture into the instance's own file (`capture_path`) if `capture` names none, as Studio needs it."""
    fixed_ports: bool = False
    """Whether the servers and bridges of a prototype listen at the addresses of the system file instead of on free ports."""
    cold: bool = False
    thread: str = ""
    """The destination of the plant's side of a digital thread (`fieldtwin.twin.thread.place`), empty for none."""
    thread_store: str = ""
    """The store of the digital thread's log; the default is a file in the run directory."""
    thread_every_s: float | None = None
    """Minimum time in seconds between two values of a tag in the thread's log. None: every value; over a modem, one a second."""
    seed: int | None = None
    """The seed of the emulators; None: the prototype file's."""
    faults: tuple[dict[str, Any], ...] = ()
    """Faults as `fieldtwin.emulators.faults.schema.load_faults` returns them."""
    fault_file: Path | None = None
    """A file of further faults; the run checks it against its system."""
    water: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Transmitters that are in a network's acoustic channel (`fieldtwin.twin.prototype.field_process.FieldConfig`)."""

    def __post_init__(self) -> None:
        """Raise `UsageError` for a password in a URL, before the URL is passed to a process or a file."""
        check_place(self.thread_store)
        if has_password(self.thread):
            raise UsageError(
                "every user of this computer can read a password in a URL", got=without_password(self.thread),
                hint="FIELDTWIN_MQTT_PASSWORD in the environment, or FIELDTWIN_MQTT_PASSWORD_FILE",
            )  # fmt: skip
