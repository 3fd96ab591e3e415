"""The scenario recordings of a server: one for each instance, and its latest draft, which can be saved as a file."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.scenarios.language.file_name import SUFFIX
from fieldtwin.scenarios.language.new_file import create_scenario_file
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.scenarios.proposal import as_scenario
from fieldtwin.studio.scenarios.recorder import Recorder
from fieldtwin.twin.site.data_files import search_path

MOST_RECORDINGS = 8
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")


class Recordings:
    """The recordings by instance. Use it as ``async with Recordings() as recordings``; leaving the block ends them all."""

    def __init__(self) -> None:
        self._recorders: dict[str, Recorder] = {}
        self._drafts: dict[str, str] = {}

    async def __aenter__(self) -> Recordings:
        return self

    async def __aexit__(self, *error: object) -> None:
        for recorder in self._recorders.values():
            await recorder.end()

    def state(self, attachment: Attachment) -> dict[str, Any]:
        """Return whether the instance is recorded, for how long, the actions so far, and the latest draft."""
        recorder = self._recorder(attachment)
        draft = self._drafts.get(attachment.name, "")
        if recorder is None:
            return {"recording": False, "elapsed_s": 0.0, "actions": [], "draft": draft}
        recording = recorder.recording
        return {
            "recording": True,
            "elapsed_s": ((recording.end_ns or attachment.now_ns()) - recording.begin_ns) / 1e9,
            "actions": [[(a.t_ns - recording.begin_ns) / 1e9, a.said] for a in recording.actions],
            "draft": draft,
        }

    def note(self, attachment: Attachment, t_ns: int, step: dict[str, Any] | None, note: str = "") -> None:
        """Note an action of a client, if the instance is recorded."""
        recorder = self._recorder(attachment)
        if recorder is not None:
            recorder.note(t_ns, step, note)

    async def begin(self, attachment: Attachment) -> None:
        """Begin to record an instance. Raises `UsageError` if it is recorded already, or has faults or forces."""
        if self._recorder(attachment) is not None:
            raise UsageError(f"{attachment.name} is recorded already", hint="finish the recording first")
        if len(self._recorders) >= MOST_RECORDINGS and attachment.name not in self._recorders:
            raise UsageError("too many recordings at once", expected=f"at most {MOST_RECORDINGS}")
        before = self._recorders.pop(attachment.name, None)  # of an earlier run of the same name
        if before is not None:
            await before.end()
        recorder = Recorder(attachment)
        await recorder.begin()
        self._recorders[attachment.name] = recorder

    async def finish(self, attachment: Attachment, folder: Path) -> str:
        """End the recording and return the proposed scenario. Raises `UsageError` if the instance is not recorded."""
        recorder = self._recorder(attachment)
        if recorder is None:
            raise UsageError(f"{attachment.name} is not recorded", hint="begin a recording first")
        del self._recorders[attachment.name]
        recording = await recorder.end()
        system = named_from(folder, Path(attachment.record.path))
        draft = self._drafts[attachment.name] = as_scenario(recording, f"{attachment.system.name}, recorded", system)
        return draft

    def save(self, attachment: Attachment, folder: Path, name: str) -> Path:
        """Write the draft to a new file in `folder`. Raises `UsageError` for a bad name, an existing file, and no draft."""
        draft = self._drafts.get(attachment.name)
        if not draft:
            raise UsageError("there is no recorded scenario to save", hint="record one first")
        name = name.removesuffix(SUFFIX)
        if not NAME.fullmatch(name):
            expected = "at most 60 letters, digits, dots, hyphens and underscores"
            raise UsageError("the name of the file", expected=expected, got=repr(name[:60]))
        path = folder / f"{name}{SUFFIX}"
        create_scenario_file(path, draft)
        return path

    def _recorder(self, attachment: Attachment) -> Recorder | None:
        """Return the recorder of this run, None if it is missing or belongs to an earlier run of the same name."""
        recorder = self._recorders.get(attachment.name)
        return recorder if recorder is not None and recorder.attachment is attachment else None


def named_from(folder: Path, system: Path) -> str:
    """Return the value of the key `system` for a scenario in `folder`. It is the name of a shipped system, or a path from the
    folder."""
    name = system.name.removesuffix(".yaml")
    shipped = next((f for place in search_path() if (f := place / "systems" / system.name).is_file()), None)
    if shipped is not None and shipped.resolve() == system.resolve():
        return name
    return os.path.relpath(system.resolve(), folder.resolve())
