"""Scenarios: record the actions on a prototype as a scenario, and run the scenarios of the instance's system."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from fieldtwin.results.trace_about import about_path
from fieldtwin.studio.api.common import INSTANCE, attached, folder_of, of_server, prototype, recordings_of
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.operation import Operation, Parameter, body_of, whole
from fieldtwin.studio.api.reports import report_response
from fieldtwin.studio.replay.traces import Traces
from fieldtwin.studio.scenarios.progress import MOST_VALUES
from fieldtwin.studio.scenarios.runner import ScenarioRunner, known_scenarios


class RunScenario(msgspec.Struct, forbid_unknown_fields=True):
    """The file to run, as `GET .../scenarios` lists it, and the target: virtual time, or processes of this computer."""

    path: str
    target: str = "virtual"


class SaveScenario(msgspec.Struct, forbid_unknown_fields=True):
    """The name of the new file in Studio's working directory, without ``.scenario.yaml``."""

    name: str


async def list_scenarios(request: Request) -> dict[str, Any]:
    """Return the scenario files of the system, and the present or latest run with its result."""
    attachment = await attached(request)
    files = known_scenarios(Path(attachment.record.path), folder_of(request))
    return {"files": [msgspec.to_builtins(file) for file in files], "run": _run_of(request, MOST_VALUES)}


async def run_scenario(request: Request) -> dict[str, Any]:
    """Start a scenario. One runs at a time; it has its own gateway, PLC and devices."""
    attachment = await attached(request)
    form = await body_of(request, RunScenario)
    known = [file.path for file in known_scenarios(Path(attachment.record.path), folder_of(request))]
    if form.path not in known:  # a page must not run arbitrary files
        raise NotFound(
            f"no scenario {form.path[:80]!r}",
            expected=", ".join(known) or "a scenario; the system has none",
        )
    await _runner(request).start(form.path, form.target)
    of_server(request, "traces", Traces).latest_run = _runner(request).trace
    return {"run": _runner(request).state()}


async def get_run(request: Request) -> dict[str, Any]:
    """Return the present or latest run: its progress while it runs, and at its end the result."""
    await attached(request)
    return {"run": _run_of(request, whole(request, "values_from", 0))}


async def get_run_report(request: Request) -> Response:
    """Return the HTML report of the latest run, with a link to the trace of each failure."""
    await attached(request)
    report = _runner(request).report
    if report is None:
        raise NotFound("no run of a scenario has a report", expected="a run that has ended")
    return report_response(report, of_server(request, "traces", Traces).in_report(report))


async def stop_scenario(request: Request) -> dict[str, Any]:
    """Stop the scenario that is running."""
    await attached(request)
    await _runner(request).stop()
    return {"run": _runner(request).state()}


async def get_recording(request: Request) -> dict[str, Any]:
    """Return whether the instance is recorded, the actions so far, and the latest proposed scenario."""
    return recordings_of(request).state(await attached(request))


async def begin_recording(request: Request) -> dict[str, Any]:
    """Begin to record."""
    attachment = await prototype(request)
    await recordings_of(request).begin(attachment)
    return recordings_of(request).state(attachment)


async def finish_recording(request: Request) -> dict[str, Any]:
    """End the recording and return the proposed scenario as YAML."""
    attachment = await prototype(request)
    return {"draft": await recordings_of(request).finish(attachment, folder_of(request))}


async def save_scenario(request: Request) -> dict[str, Any]:
    """Write the latest proposed scenario to a new file."""
    attachment = await prototype(request)
    form = await body_of(request, SaveScenario)
    return {"path": str(recordings_of(request).save(attachment, folder_of(request).resolve(), form.name))}


def _run_of(request: Request, values_from: int) -> dict[str, Any] | None:
    """Return the present or latest run, with its values from number `values_from` on and the name of its trace or ""."""
    run = _runner(request).state(values_from)
    if run is not None:
        traces = of_server(request, "traces", Traces)
        path = _runner(request).trace
        described = path is not None and about_path(path).is_file()
        run["trace"] = traces.name_of(path) if path is not None and described else ""
    return run


def _runner(request: Request) -> ScenarioRunner:
    return of_server(request, "runner", ScenarioRunner)


SCENARIOS = f"{INSTANCE}/scenarios"
OPERATIONS = (
    Operation("GET", SCENARIOS, list_scenarios, "List the scenario files of the system"),
    Operation("POST", SCENARIOS, save_scenario, "Save the recorded scenario", body=SaveScenario, changes=True),
    Operation(
        "GET",
        f"{SCENARIOS}/run",
        get_run,
        "Read the run of a scenario, its progress and its result",
        (Parameter("values_from", "integer", "the number of values that the client has already"),),
    ),
    Operation("GET", f"{SCENARIOS}/run/report", get_run_report, "Read the HTML report of the latest run"),
    Operation("POST", f"{SCENARIOS}/run", run_scenario, "Run a scenario", body=RunScenario, changes=True),
    Operation("DELETE", f"{SCENARIOS}/run", stop_scenario, "Stop the running scenario", changes=True),
    Operation("GET", f"{SCENARIOS}/recording", get_recording, "Read the recording of a scenario"),
    Operation("POST", f"{SCENARIOS}/recording", begin_recording, "Begin to record a scenario", changes=True),
    Operation("DELETE", f"{SCENARIOS}/recording", finish_recording, "Finish the recording", changes=True),
)
