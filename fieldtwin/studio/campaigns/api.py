"""Campaigns of many seeds: the state of each ledger in the working directory, and its report. All operations only read."""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from fieldtwin.reports.campaign.html import render_campaign
from fieldtwin.studio.api.common import of_server
from fieldtwin.studio.api.operation import Operation
from fieldtwin.studio.api.reports import page_response
from fieldtwin.studio.campaigns.ledgers import Ledgers


async def list_campaigns(request: Request) -> list[dict[str, Any]]:
    """Return the ledgers with the state of their campaigns: runs, failures by cause, virtual hours, and runs over time."""
    return await asyncio.to_thread(of_server(request, "ledgers", Ledgers).states)


async def get_campaign_report(request: Request) -> Response:
    """Return the HTML report of a ledger as it is now."""
    ledgers = of_server(request, "ledgers", Ledgers)
    campaigns = await asyncio.to_thread(ledgers.named, request.path_params["ledger"])
    return page_response(await asyncio.to_thread(render_campaign, campaigns))


OPERATIONS = (
    Operation("GET", "/campaigns", list_campaigns, "List the campaigns in the working directory"),
    Operation("GET", "/campaigns/{ledger}/report", get_campaign_report, "Read the HTML report of a campaign"),
)
