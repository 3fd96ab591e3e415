"""Frames of the buses: pages from any position, filters, and exports."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import Any

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from fieldtwin.capture.decoding.decoder import frame_events
from fieldtwin.capture.formats.pcap import write_pcap
from fieldtwin.capture.recordings.importing import import_capture
from fieldtwin.gateway.connections.tap import Captured, TapFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.recording import RecordingHeader
from fieldtwin.reports.run.packets import write_packets
from fieldtwin.studio.api.common import INSTANCE, attached
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.operation import Operation, Parameter, whole, yes
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.effects import Changes, effects_of
from fieldtwin.studio.live.frame_log import FrameFilter, FrameLog, FrameRow
from fieldtwin.twin.site.system import System

MOST_ROWS = 500
MOST_EXPORTED = 200_000
AT_ONCE = 2_000
"""Number of frames that an export reads before the server answers other requests in between."""
FORMATS = ("pcapng", "pcap", "candump", "recording")
FILTERS = (
    Parameter("bus", "string", "only frames of this bus"),
    Parameter("device", "string", "only frames of this device"),
    Parameter("service", "string", "only frames of this function or service"),
    Parameter("problems", "boolean", "only frames of failed exchanges"),
)
PAGE = (
    Parameter("start", "integer", "position of the first frame; by default the latest frames are returned"),
    Parameter("count", "integer", f"how many, at most {MOST_ROWS}"),
    Parameter("at_ns", "integer", "frames around this instant, in place of start"),
    *FILTERS,
)
EXPORT = (
    Parameter("format", "string", "pcapng, pcap, candump or recording"),
    Parameter("first", "integer", "number of the first frame"),
    Parameter("last", "integer", "number of the last frame"),
    *FILTERS,
)


def _frames(attachment: Attachment) -> FrameLog:
    if attachment.frames is None:
        raise NotFound(
            attachment.troubles.get("frames", "this run does not record the frames of its buses"),
            hint="start it from Studio, with `fieldtwin run --studio`, or with --capture FILE",
        )
    return attachment.frames


def _wanted(request: Request) -> FrameFilter:
    given = request.query_params
    return FrameFilter(
        given.get("bus", ""), given.get("device", ""), given.get("service", ""), yes(request, "problems")
    )


async def list_frames(request: Request) -> dict[str, Any]:
    """Return frames from a position on, among those that the filter accepts, and how many there are."""
    return page_of(request, _frames(await attached(request)))


def page_of(request: Request, frames: FrameLog) -> dict[str, Any]:
    """Return the page of frames that the query of a request selects."""
    wanted = _wanted(request)
    total, count = frames.count(wanted), whole(request, "count", 100, 1, MOST_ROWS)
    if (at := request.query_params.get("at_ns")) is not None:
        start = max(0, frames.position_at(int(at) if at.isdigit() else 0, wanted) - count // 2)
    else:
        start = whole(request, "start", max(0, total - count))
    rows = [shown(frames, number, row) for number, row in frames.page(start, count, wanted)]
    return {"total": total, "start": start, "rows": rows, "behind_bytes": frames.behind_bytes, "full": frames.is_full}


async def get_frame(request: Request) -> dict[str, Any]:
    """Return one frame with its fields, its request or reply, and the changes of tags after it."""
    attachment = await attached(request)
    return frame_of(request, _frames(attachment), attachment.system, attachment.history)


def frame_of(request: Request, frames: FrameLog, system: System, history: Changes) -> dict[str, Any]:
    """Return the frame whose number is in the path of a request, as `get_frame` does. Raises `NotFound`."""
    text = request.path_params["number"]
    number = int(text) if text.isdigit() else -1
    try:
        row = frames.row(number)
    except IndexError as e:
        raise NotFound(f"no frame {text[:20]!r}", expected=f"0 to {len(frames) - 1}") from e
    linked = [n for n in (row.request, frames.reply_to(number)) if n is not None]
    return shown(frames, number, row) | {
        "linked": [shown(frames, n, frames.row(n)) for n in linked],
        "fields": frames.fields(number),
        "effects": [effect._asdict() for effect in effects_of(system, history, frames, number)],
    }


async def list_services(request: Request) -> list[str]:
    """Return the Modbus functions and CANopen services that have occurred, as choices for a filter."""
    return _frames(await attached(request)).services()


async def export_frames(request: Request) -> Response:
    """Return a selection of frames as a file: pcapng (all buses), pcap or recording (one bus), or candump (CAN buses)."""
    attachment = await attached(request)
    record = attachment.record
    offset_ns = record.started_utc_ns - record.started_ns
    return await file_of(request, _frames(attachment), attachment.system, offset_ns, prototype=record.prototype)


async def file_of(request: Request, frames: FrameLog, system: System, offset_ns: int, *, prototype: bool) -> Response:
    """Return the frames that a request selects as a file. A frame's time plus `offset_ns` is its UTC time."""
    wanted = _wanted(request)
    kind = request.query_params.get("format", "pcap")
    if kind not in FORMATS:
        raise UsageError("the format", expected=", ".join(FORMATS), got=repr(kind[:20]))
    numbers = frames.numbers(whole(request, "first", 0), whole(request, "last", len(frames) - 1), wanted)
    if len(numbers) > MOST_EXPORTED:
        raise UsageError(
            "too many frames for one file",
            expected=f"at most {MOST_EXPORTED}",
            got=str(len(numbers)),
            hint="choose a bus, a device or a function, or a part of the run with first and last",
        )
    captured: list[Captured] = []
    for start in range(0, len(numbers), AT_ONCE):
        captured += frames.captured(numbers[start : start + AT_ONCE])
        await asyncio.sleep(0)  # other requests are answered in between
    if kind == "candump":
        content = await asyncio.to_thread(_candump, captured, offset_ns)
        return _file(content, "frames.log", "text/plain")
    if kind == "pcapng":
        content = await asyncio.to_thread(_pcapng, captured, system, offset_ns)
        return _file(content, "frames.pcapng", "application/x-pcapng")
    endpoint = _only_endpoint(captured, system)
    if kind == "recording":
        content = await asyncio.to_thread(_recording, captured, endpoint, prototype)
        return _file(content, "frames.jsonl", "application/jsonl")
    content = await asyncio.to_thread(_pcap, captured, endpoint, offset_ns)
    return _file(content, "frames.pcap", "application/vnd.tcpdump.pcap")


def _only_endpoint(captured: list[Captured], system: System) -> Endpoint:
    """Return the endpoint of all frames. Raises `UsageError` if there are several or none."""
    if not captured:
        raise UsageError("the selection has no frames to export", hint="choose other filters")
    endpoints = {str(c.endpoint): c.endpoint for c in captured}
    if len(endpoints) != 1:
        buses = [name for name, bus in system.buses.items() if str(bus.endpoint) in endpoints]
        raise UsageError(
            "a pcap file or a recording has the frames of one bus",
            expected="the choice of one bus",
            got=f"frames of {', '.join(buses)}",
            hint="a pcapng file has the frames of all buses",
        )
    return next(iter(endpoints.values()))


def _candump(captured: list[Captured], offset_ns: int) -> bytes:
    lines = [
        f"({(c.t_ns + offset_ns) / 1e9:.6f}) {_interface(str(c.endpoint))} {c.item}\n"
        for c in captured
        if isinstance(c.item, CanFrame)
    ]
    if not lines:
        raise UsageError("there are no CAN frames in the selection", hint="export other buses as pcap or recording")
    return "".join(lines).encode("ascii")


def _pcapng(captured: list[Captured], system: System, offset_ns: int) -> bytes:
    events = frame_events(captured, system)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.pcapng"
        write_packets(path, lambda: events, system, start_utc_ns=offset_ns, comment=system.name)
        return path.read_bytes()


def _pcap(captured: list[Captured], endpoint: Endpoint, offset_ns: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.pcap"
        write_pcap(path, captured, endpoint, offset_ns)
        return path.read_bytes()


def _recording(captured: list[Captured], endpoint: Endpoint, prototype: bool) -> bytes:
    """Return the exchanges as a recording, converted as `fieldtwin import` converts a capture."""
    if endpoint.is_can:
        raise UsageError(
            "a recording of exchanges has no CAN frames", hint="export a CAN bus as candump: this is its recording"
        )
    with tempfile.TemporaryDirectory() as folder:
        capture, out = Path(folder) / "capture.jsonl", Path(folder) / "frames.jsonl"
        tap = TapFile(capture)
        for c in captured:
            if isinstance(c.item, bytes):
                tap.on_bytes(c.endpoint, c.direction, c.t_ns, c.item)
        tap.close()
        header = RecordingHeader(
            version=1, device="imported/frames", kind="exchanges", source="imported", endpoint=str(endpoint),
            made_by="fieldtwin studio", prototype=prototype,
        )  # fmt: skip
        import_capture(capture, out, url=str(endpoint), header=header)
        return out.read_bytes()


def shown(frames: FrameLog, number: int, row: FrameRow) -> dict[str, Any]:
    """Return a frame as data for JSON."""
    told = msgspec.structs.asdict(row)
    return {"number": number, **told, "verdict": frames.verdict(number), "reply": frames.reply_to(number)}


def _interface(endpoint: str) -> str:
    return endpoint.rpartition("/")[2] or "can0"


def _file(content: bytes, name: str, kind: str) -> Response:
    return Response(content, media_type=kind, headers={"Content-Disposition": f'attachment; filename="{name}"'})


OPERATIONS = (
    Operation(
        "GET",
        f"{INSTANCE}/frames",
        list_frames,
        "Read a page of frames",
        PAGE,
    ),
    Operation("GET", f"{INSTANCE}/frames/services", list_services, "List the functions and services seen so far"),
    Operation(
        "GET",
        f"{INSTANCE}/frames/export",
        export_frames,
        "Export frames",
        EXPORT,
    ),
    Operation("GET", INSTANCE + "/frames/{number}", get_frame, "Read one frame and the frames linked with it"),
)
