"""Ask for the user's consent before a scenario runs that is from a template, or whose system is.

Only the names in the scenario are examined: reading it completely assembles the process image of its system, which
imports programs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.run.template import Ask, agree
from fieldtwin.twin.site.groups import group_file
from fieldtwin.twin.site.system import System, load_system


def agree_to_scenario(
    ask: Ask, path: Path, profiles: Iterable[Path] = (), *, plant: bool = False, virtual: bool = False
) -> None:
    """Ask about the system of the scenario, or its several systems, in `path`, and its probes, if they are inside a template.

    `plant`: the run has no prototype; `virtual`: it opens no endpoint. A file that cannot be read is skipped here, because the
    next reader reports the error. Raises `NotAllowed`.
    """
    profiles = tuple(profiles)
    try:
        said: Mapping[str, Any] = load(path).data
        systems = _systems(path, said, profiles)
    except FieldtwinError:
        return
    agree(ask, path, systems, beside=path, opens=() if virtual else _opens(said), plant=plant, virtual=virtual)


def _systems(path: Path, said: Mapping[str, Any], profiles: tuple[Path, ...]) -> list[tuple[System, Path | None]]:
    """Return the scenario's systems, each with its prototype file; None stands for the one next to the system file.

    They are found as `fieldtwin.scenarios.language.form` does: next to the scenario, or among the shipped systems.
    A file with several systems yields all of them.
    """
    name, prototype = str(said.get("system", "")), said.get("prototype")
    beside = path.parent / name
    named = str(beside) if beside.exists() else name.removesuffix(".yaml")
    if (found := group_file(named, profiles)) is not None:
        from fieldtwin.twin.prototype.group import read_group  # needs emulators, which a plant does not have

        return [(m.system, m.prototype.path) for m in read_group(*found, profiles).members.values()]
    return [(load_system(named, profiles), path.parent / prototype if isinstance(prototype, str) else None)]


def _opens(said: Mapping[str, Any]) -> list[str]:
    probes = said.get("probes")
    entries = probes.items() if isinstance(probes, Mapping) else ()
    asked = [(name, e["endpoint"]) for name, e in entries if isinstance(e, Mapping) and e.get("endpoint")]
    return [f"it asks {endpoint} (probe {name})" for name, endpoint in asked]
