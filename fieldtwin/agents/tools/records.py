"""Tools for recordings, and for the rest of long results."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec

from fieldtwin.agents.tool import Tool
from fieldtwin.agents.tools.knowledge import OfFile
from fieldtwin.agents.workplace import Workplace
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.recording import RecordingHeader

MOST_LINE_BYTES = 1 << 20


class ReadRest(msgspec.Struct, forbid_unknown_fields=True):
    """The number of a long result, and the character at which the part begins, as the note in the result states them."""

    result: int
    offset: int


async def describe_recording(work: Workplace, given: OfFile) -> dict[str, Any]:
    """Return the header of a recording and its number of entries."""
    path = work.project.inside(given.path)

    def look() -> dict[str, Any]:
        try:
            with path.open("rb") as file:
                header = msgspec.json.decode(file.readline(MOST_LINE_BYTES), type=RecordingHeader)
                entries = sum(1 for _ in file)
        except OSError as e:
            raise FileInvalid(f"cannot read the file: {e.strerror}", path=str(path)) from e
        except (msgspec.MsgspecError, UnicodeDecodeError) as e:
            raise FileInvalid(f"not a recording: {e}", path=str(path)) from e
        return {"header": header, "entries": entries}

    return await asyncio.to_thread(look)


async def read_rest(work: Workplace, given: ReadRest) -> str:
    """Return a part of a long result, from character `offset` on."""
    return work.results.part(given.result, given.offset)


TOOLS = (
    Tool("describe_recording", "Describe a recording of the project.", describe_recording, OfFile),
    Tool("read_rest", "Read the rest of a long result.", read_rest, ReadRest),
)
