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
    """A run. `duration_s` 0 means until stopped; `field_host` is ``HOST[:PORT]`` of a field side started elsewhere."""

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
    cold: bool = False
    thread: str = ""
    """Where the plant's side of a digital thread goes (`fieldtwin.twin.thread.place`), empty for none."""
    thread_store: str = ""
    """The store of its log; by default a file of the instance."""
    thread_every_s: float | None = None
    """A tag's new value goes into it at most so often. None: each one; over a modem, one a second."""
    seed: int | None = None
    """Of the emulators; None: the prototype file's."""
    faults: tuple[dict[str, Any], ...] = ()
    """As `fieldtwin.emulators.faults.schema.load_faults` gives them."""
    water: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Transmitters that are in a network's water (`fieldtwin.twin.prototype.field_process.FieldConfig`)."""

    def __post_init__(self) -> None:
        """Raises `UsageError` for a password in a URL, before it is handed on to a process or a file."""
        check_place(self.thread_store)
        if has_password(self.thread):
            raise UsageError(
                "a password in a URL can be read by everybody", got=without_password(self.thread),
                hint="FIELDTWIN_MQTT_PASSWORD in the environment, or FIELDTWIN_MQTT_PASSWORD_FILE",
            )  # fmt: skip
