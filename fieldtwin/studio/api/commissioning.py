"""The commissioning guide: run its steps as jobs in the working folder, read their files, and edit the draft of a profile."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import msgspec
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from fieldtwin.gateway.connections.serial.port import local_ports
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.studio.api.common import of_server
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.operation import Operation, body_of
from fieldtwin.studio.api.stream import FULL, SENT_WITHIN_S, until_left
from fieldtwin.studio.commissioning.drafts import check_draft
from fieldtwin.studio.commissioning.jobs import Job, Jobs
from fieldtwin.studio.commissioning.practice import known_profiles
from fieldtwin.studio.commissioning.steps import AnyStep

AT_MOST_EVERY_S = 0.2
LOOK_AGAIN_S = 1.0


class StepForm(msgspec.Struct, forbid_unknown_fields=True):
    """A request body: one step of the commissioning guide, with the values of its form."""

    step: AnyStep


class DraftForm(msgspec.Struct, forbid_unknown_fields=True):
    """The text of a profile, and the version with which the editor began; "" for a new file."""

    text: str
    version: str = ""


async def get_guide(request: Request) -> dict[str, Any]:
    """Return the working folder, the serial ports of this computer, the profiles, the jobs and the files."""
    jobs = _jobs(request)
    files, left_out = jobs.folder.files()
    return {
        "folder": str(jobs.folder.path),
        "role": request.scope["role"],
        "ports": await asyncio.to_thread(local_ports),
        "profiles": await asyncio.to_thread(known_profiles),
        "jobs": jobs.overview(),
        "forgotten_jobs": jobs.forgotten,
        "files": files,
        "files_left_out": left_out,
    }


async def show_command(request: Request) -> dict[str, Any]:
    """Return the command line of a step, without running it.

    A form that is being filled in is often invalid, so that is a normal answer: `problem` describes the error.
    """
    try:
        form = await body_of(request, StepForm)
        command = form.step.command(_jobs(request).folder)
    except UsageError as e:
        return {"command": "", "writes": (), "problem": str(e)}
    return {"command": command.line, "writes": command.writes, "problem": ""}


async def start_step(request: Request) -> dict[str, Any]:
    """Run a step as a child process in the working folder."""
    form = await body_of(request, StepForm)
    return (await _jobs(request).start(form.step)).state()


async def get_job(request: Request) -> dict[str, Any]:
    """Return a job with its messages and, at its end, its result."""
    return _job(request).whole()


async def stop_job(request: Request) -> dict[str, Any]:
    """Stop a job as Ctrl-C does. Its results and files so far are kept."""
    job = _job(request)
    await job.stop()
    return job.whole()


async def clear_jobs(request: Request) -> dict[str, Any]:
    """Remove the finished jobs from the list, to begin with another device. The files stay."""
    _jobs(request).clear()
    return {"jobs": []}


async def get_file(request: Request) -> Response:
    """Return a file of the guide as a download."""
    name = request.path_params["name"]
    path = _jobs(request).folder.listed(name)
    return FileResponse(path, filename=name, media_type="application/octet-stream")


async def get_draft(request: Request) -> dict[str, Any]:
    """Return the text of a profile, and its errors."""
    folder = _jobs(request).folder
    name = request.path_params["name"]
    text, version = folder.draft(name)
    checked = await asyncio.to_thread(check_draft, text, folder.path, name)
    return {"name": name, "text": text, "version": version, "checked": checked}


async def check_text(request: Request) -> dict[str, Any]:
    """Check the text of a profile with its schema and the loader that all commands use. Nothing is written."""
    form = await body_of(request, DraftForm)
    folder = _jobs(request).folder
    name = folder.checked(request.path_params["name"], ".yaml")
    return {"checked": await asyncio.to_thread(check_draft, form.text, folder.path, name)}


async def save_draft(request: Request) -> dict[str, Any]:
    """Write a profile to the working folder, even with errors, and return its errors."""
    form = await body_of(request, DraftForm)
    folder = _jobs(request).folder
    name = request.path_params["name"]
    version = folder.save_draft(name, form.text, form.version)
    return {
        "name": name,
        "version": version,
        "checked": await asyncio.to_thread(check_draft, form.text, folder.path, name),
    }


async def stream_jobs(socket: WebSocket) -> None:
    """Send the states of all jobs after each change, at most five times a second, until the client disconnects.

    Each message holds the present state, so a slow client misses intermediate states and nothing is queued for it.
    """
    await socket.accept()
    jobs = _jobs(socket)
    with contextlib.suppress(WebSocketDisconnect, TimeoutError, RuntimeError):  # the client is gone, or does not read
        try:
            with jobs.listening() as changed:
                await _send_states(socket, jobs, changed)
        except FieldtwinError as e:
            await socket.close(FULL, str(e)[:120])


async def _send_states(socket: WebSocket, jobs: Jobs, changed: asyncio.Event) -> None:
    leaving = asyncio.ensure_future(until_left(socket))
    try:
        while not leaving.done():
            changed.clear()
            overview = jobs.overview()
            async with asyncio.timeout(SENT_WITHIN_S):
                await socket.send_json({"type": "jobs", "jobs": overview})
            await asyncio.wait([leaving], timeout=AT_MOST_EVERY_S)
            running = any(job["state"] == "running" for job in overview)
            waiting = asyncio.ensure_future(changed.wait())
            timeout = LOOK_AGAIN_S if running else None
            await asyncio.wait([waiting, leaving], timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
    finally:
        leaving.cancel()


def _jobs(request: HTTPConnection) -> Jobs:
    return of_server(request, "jobs", Jobs)


def _job(request: Request) -> Job:
    number = request.path_params["number"]
    job = _jobs(request).job(number)
    if job is None:
        raise NotFound(f"no job {number}", hint="Studio keeps the latest jobs only")
    return job


GUIDE = "/commissioning"
FILE = f"{GUIDE}/files/{{name}}"
DRAFT = f"{GUIDE}/drafts/{{name}}"
JOB = f"{GUIDE}/jobs/{{number:int}}"
OPERATIONS = (
    Operation("GET", GUIDE, get_guide, "Read the state of the commissioning guide"),
    Operation("POST", f"{GUIDE}/command", show_command, "Show the command line of a step", body=StepForm),
    Operation("POST", f"{GUIDE}/jobs", start_step, "Run a step", body=StepForm, changes=True),
    Operation("DELETE", f"{GUIDE}/jobs", clear_jobs, "Forget the finished jobs", changes=True),
    Operation("GET", JOB, get_job, "Read a job and its result"),
    Operation("DELETE", JOB, stop_job, "Stop a job", changes=True),
    Operation("GET", FILE, get_file, "Download a file of the guide"),
    Operation("GET", DRAFT, get_draft, "Read the draft of a profile"),
    Operation("POST", DRAFT, check_text, "Check the text of a profile", body=DraftForm),
    Operation("PUT", DRAFT, save_draft, "Save the draft of a profile", body=DraftForm, changes=True),
)
