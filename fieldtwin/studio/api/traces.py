"""Traces of virtual runs: which ones there are, and the state of each as of any instant. All operations only read."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from fieldtwin.studio.api.common import of_server
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.frames import EXPORT, PAGE, file_of, frame_of, page_of
from fieldtwin.studio.api.operation import Operation, Parameter, whole
from fieldtwin.studio.api.reports import report_response
from fieldtwin.studio.live.tag_history import MOST_POINTS, recent
from fieldtwin.studio.replay.instant import state_at, transitions_at
from fieldtwin.studio.replay.marks import failed_checks, marks_of
from fieldtwin.studio.replay.replay import Replay
from fieldtwin.studio.replay.traces import KnownTrace, Traces

TRACE = "/traces/{trace}"
AT = Parameter("at_ns", "integer", "the instant, in ns since the start of the run; by default the end")


async def list_traces(request: Request) -> list[dict[str, Any]]:
    """Return the traces that the user has named, and those in the working directory."""
    return [_described(trace) for trace in of_server(request, "traces", Traces).known()]


async def get_trace(request: Request) -> dict[str, Any]:
    """Return the description of a trace: its system, its first and last time, and its marks. The last time increases while the
    run continues."""
    replay = await _opened(request)
    marks, left_out = marks_of(replay.log, replay.about, list(replay.system.plc.programs))
    about = replay.about
    return {
        "name": replay.name,
        "path": str(replay.path),
        "mode": "trace",
        "allow_writes": False,
        "role": request.scope["role"],
        "started_ns": 0,
        "history_from_ns": 0,
        "now_ns": replay.end_ns,
        "end_ns": replay.end_ns,
        "growing": replay.is_growing,
        "behind_bytes": replay.behind_bytes,
        "events": replay.log.events,
        "title": about.title if about is not None else "",
        "seed": about.seed if about is not None else None,
        "verdict": about.verdict if about is not None else "",
        "reason": about.reason if about is not None else "",
        "report": KnownTrace(replay.name, replay.path, about).report is not None,
        "failed": [msgspec.to_builtins(check) for check in failed_checks(replay.log, about)],
        "marks": marks,
        "marks_left_out": left_out,
        "programs_described": about is not None and bool(about.programs),
        "frames": True,
        "system": replay.description,
    }


async def get_trace_report(request: Request) -> Response:
    """Return the HTML report of the run, with links to the traces of its failures."""
    traces = of_server(request, "traces", Traces)
    report = traces.named(request.path_params["trace"]).report
    if report is None:
        raise NotFound("the run of this trace has no report", hint="fieldtwin test FILE --trace TRACE --html REPORT")
    return report_response(report, traces.in_report(report))


async def get_trace_state(request: Request) -> dict[str, Any]:
    """Return the state at an instant in the form of an instance's status: tags, devices, buses, PLC, faults, and the step."""
    replay = await _opened(request)
    return state_at(replay, _instant(request, replay))


async def get_trace_recent(request: Request) -> dict[str, Any]:
    """Return, for each tag, its numbers in the minute before an instant: [time in ns, number, or null for a bad value]."""
    replay = await _opened(request)
    return recent(replay.history, replay.tag_names, _instant(request, replay))


async def get_trace_history(request: Request) -> dict[str, Any]:
    """Return the changes of a tag or variable: [time in ns, value, quality, reason]."""
    replay = await _opened(request)
    name = request.path_params["tag"]
    if name not in replay.tag_names and name not in replay.log.states:
        raise NotFound(f"the trace has no tag {name[:80]!r}", expected="DEVICE.TAG or PROGRAM.VARIABLE")
    to_ns = whole(request, "to_ns", replay.end_ns)
    points = whole(request, "points", MOST_POINTS, 4, MOST_POINTS)
    found, thinned = replay.history.between(name, whole(request, "from_ns", 0), to_ns, points)
    return {"points": [list(point) for point in found], "thinned": thinned, "now_ns": min(to_ns, replay.end_ns)}


async def list_trace_frames(request: Request) -> dict[str, Any]:
    """Return frames from a position on, or around an instant, among those that the filter accepts."""
    return page_of(request, (await _opened(request)).frames)


async def list_trace_services(request: Request) -> list[str]:
    """Return the Modbus functions and CANopen services that have occurred, as choices for a filter."""
    return (await _opened(request)).frames.services()


async def export_trace_frames(request: Request) -> Response:
    """Return a selection of frames as a file. Their times count from 1970-01-01, because virtual time has no date."""
    replay = await _opened(request)
    return await file_of(request, replay.frames, replay.system, 0, prototype=True)


async def get_trace_frame(request: Request) -> dict[str, Any]:
    """Return one frame with its fields, its request or reply, and the changes of tags after it."""
    replay = await _opened(request)
    return frame_of(request, replay.frames, replay.system, replay.history)


async def get_trace_programs(request: Request) -> dict[str, Any]:
    """Return, for each program, its variables, its states and transitions, and the text of its source as the run read it."""
    replay = await _opened(request)
    return msgspec.to_builtins(replay.about.programs) if replay.about is not None else {}


async def list_trace_variables(request: Request) -> list[str]:
    """Return the names of the programs' variables that the run has recorded, as `PROGRAM.VARIABLE`."""
    replay = await _opened(request)
    return [name for name in replay.log.states if name.partition(".")[0] in replay.system.plc.programs]


async def get_trace_transitions(request: Request) -> dict[str, Any]:
    """Return the last transitions of each program up to an instant, the oldest first."""
    replay = await _opened(request)
    return transitions_at(replay, _instant(request, replay))


async def _opened(request: Request) -> Replay:
    return await of_server(request, "traces", Traces).opened(request.path_params["trace"])


def _instant(request: Request, replay: Replay) -> int:
    return whole(request, "at_ns", replay.end_ns)


def _described(trace: KnownTrace) -> dict[str, Any]:
    about = trace.about
    return {
        "name": trace.name,
        "path": str(trace.path),
        "trouble": trace.trouble,
        "system": about.system if about is not None else "",
        "title": about.title if about is not None else "",
        "seed": about.seed if about is not None else None,
        "verdict": about.verdict if about is not None else "",
        "growing": about is not None and not about.finished,
    }


OPERATIONS = (
    Operation("GET", "/traces", list_traces, "List the traces of virtual runs"),
    Operation("GET", TRACE, get_trace, "Describe a trace"),
    Operation("GET", f"{TRACE}/report", get_trace_report, "Read the HTML report of the run"),
    Operation("GET", f"{TRACE}/state", get_trace_state, "Read the state at an instant", (AT,)),
    Operation("GET", f"{TRACE}/recent", get_trace_recent, "Read the minute before an instant", (AT,)),
    Operation(
        "GET",
        TRACE + "/tags/{tag}/history",
        get_trace_history,
        "Read the history of a tag of a trace",
        (
            Parameter("from_ns", "integer", "begin, in ns since the start of the run"),
            Parameter("to_ns", "integer", "end"),
            Parameter("points", "integer", "at most this many points"),
        ),
    ),
    Operation(
        "GET",
        f"{TRACE}/frames",
        list_trace_frames,
        "Read a page of frames of a trace",
        PAGE,
    ),
    Operation("GET", f"{TRACE}/frames/services", list_trace_services, "List the functions and services of a trace"),
    Operation(
        "GET",
        f"{TRACE}/frames/export",
        export_trace_frames,
        "Export frames of a trace",
        EXPORT,
    ),
    Operation("GET", TRACE + "/frames/{number}", get_trace_frame, "Read one frame of a trace"),
    Operation("GET", f"{TRACE}/plc/programs", get_trace_programs, "Describe the programs of a trace"),
    Operation("GET", f"{TRACE}/plc/variables", list_trace_variables, "List the variables of programs of a trace"),
    Operation(
        "GET", f"{TRACE}/plc/transitions", get_trace_transitions, "Read the transitions before an instant", (AT,)
    ),
)
