"""Create a new scenario file, and never replace one."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError, os_reason


def create_scenario_file(path: Path, text: str, name: str = "") -> None:
    """Write a scenario to a new file. `name` is shown in errors; the default is the name of the file.

    Raises `UsageError` if the file exists or cannot be written.
    """
    name = name or path.name
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as e:
        raise UsageError(f"{name} exists already", hint="choose another name") from e
    except OSError as e:
        raise UsageError(f"{name} cannot be written: {os_reason(e)}") from e
