"""All tools of an agent, in the order in which they are listed."""

from __future__ import annotations

from fieldtwin.agents.tools import devices, instances, knowledge, plants, prototypes, records, scenarios

TOOLS = (
    *knowledge.TOOLS,
    *records.TOOLS,
    *instances.TOOLS,
    *prototypes.TOOLS,
    *scenarios.TOOLS,
    *plants.TOOLS,
    *devices.TOOLS,
)
