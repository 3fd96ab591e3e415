"""Variables of programs over time: which ones there are, and their values after each scan."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request

from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.studio.api.common import INSTANCE, attached
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.operation import Operation, whole
from fieldtwin.studio.api.tags import HISTORY
from fieldtwin.studio.live.tag_history import MOST_POINTS


async def list_variables(request: Request) -> list[str]:
    """Return the names of the programs' variables as `PROGRAM.VARIABLE`, at most 1,000 that are not tags of each program.

    The elements of arrays are not listed, but have a history as well.
    """
    attachment = await attached(request)
    return await attachment.variable_names()


async def get_variable_history(request: Request) -> dict[str, Any]:
    """Return the values of a variable after each scan: [time in ns, value, quality, reason], without those that a scan repeats.

    The PLC records a variable from the first request on, until it was not requested for 60 s. `scans` is the number of recorded
    scans in the interval, and `shown` how many of them the points show. `missed` scans could not be recorded, and `dropped` ones
    have left the ring.
    """
    attachment = await attached(request)
    name = request.path_params["variable"]
    if name.partition(".")[0] not in attachment.system.plc.programs:
        raise NotFound(f"no program has a variable {name[:80]!r}", expected="PROGRAM.VARIABLE")
    if attachment.is_secret_variable(name):
        raise NotAllowed(f"the value of {name} is secret")
    history = await attachment.variables.history(name)
    now_ns = attachment.now_ns()
    from_ns, to_ns = whole(request, "from_ns", 0), whole(request, "to_ns", now_ns)
    found = history.between(from_ns, to_ns, whole(request, "points", MOST_POINTS, 4, MOST_POINTS))
    about = {"type": history.type, "unit": history.unit, "missed": history.missed, "dropped": history.dropped}
    return {**found, **about, "now_ns": now_ns}


VARIABLES = f"{INSTANCE}/plc/variables"
OPERATIONS = (
    Operation("GET", VARIABLES, list_variables, "List the variables of programs"),
    Operation(
        "GET",
        VARIABLES + "/{variable}/history",
        get_variable_history,
        "Read the values of a variable after each scan",
        HISTORY,
    ),
)
