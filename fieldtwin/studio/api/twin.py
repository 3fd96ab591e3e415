"""Digital shadows and twins of an instance, with their models, digital threads and decisions, and what-if forecasts."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request

from fieldtwin.studio.api.common import INSTANCE, attached, of_server
from fieldtwin.studio.api.operation import Operation, body_of
from fieldtwin.studio.twin.comparison import compare
from fieldtwin.studio.twin.followers import Follower, look, starting_commands
from fieldtwin.studio.twin.forecast import AskWhatIf, Forecaster


async def get_twins(request: Request) -> dict[str, Any]:
    """Return the instance's end of the digital thread, its shadows and twins, and the command lines that start one.

    For each shadow or twin: state and period of its model, its variables next to the plant's values, its end of the thread, and
    its newest decisions, oldest first.
    """
    attachment = await attached(request)
    thread, found = await look(attachment)

    def described(follower: Follower) -> dict[str, Any]:
        status = follower.status
        return {
            "instance": follower.instance,
            "kind": follower.kind,
            "trouble": follower.trouble,
            "is_of_instance": follower.is_of_instance,
            "status": msgspec.to_builtins(status) | {"variables": None} if status is not None else None,
            "variables": [msgspec.to_builtins(v) for v in compare(attachment, status)] if status is not None else [],
        }

    return {
        "plant_thread": msgspec.to_builtins(thread) if thread is not None else None,
        "followers": [described(follower) for follower in found],
        "start": starting_commands(attachment, thread),
    }


async def get_forecast(request: Request) -> dict[str, Any]:
    """Return the present or latest forecast for the instance."""
    attachment = await attached(request)
    return {"run": _forecaster(request).state(attachment.name)}


async def ask_what_if(request: Request) -> dict[str, Any]:
    """Simulate ahead in virtual time, from the present state of the instance. The plant is not affected; one run at a time."""
    attachment = await attached(request)
    await _forecaster(request).start(attachment, await body_of(request, AskWhatIf))
    return {"run": _forecaster(request).state(attachment.name)}


async def stop_forecast(request: Request) -> dict[str, Any]:
    """Stop the forecast that is running."""
    attachment = await attached(request)
    await _forecaster(request).stop()
    return {"run": _forecaster(request).state(attachment.name)}


def _forecaster(request: Request) -> Forecaster:
    return of_server(request, "forecaster", Forecaster)


WHAT_IF = f"{INSTANCE}/what-if"
OPERATIONS = (
    Operation("GET", f"{INSTANCE}/twins", get_twins, "Read the shadows and twins of an instance"),
    Operation("GET", WHAT_IF, get_forecast, "Read the forecast of a what-if question"),
    Operation("POST", WHAT_IF, ask_what_if, "Ask what would happen", body=AskWhatIf, changes=True),
    Operation("DELETE", WHAT_IF, stop_forecast, "Stop the running forecast", changes=True),
)
