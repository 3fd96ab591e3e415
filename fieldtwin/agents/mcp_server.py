"""The tools and resources as a server of the Model Context Protocol, over standard input and output or HTTP."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import mcp_types as types
from mcp.server.lowlevel import Server
from mcp.shared.exceptions import MCPError

from fieldtwin.__about__ import __version__
from fieldtwin.agents.calls import Calls
from fieldtwin.agents.http_place import HttpPlace
from fieldtwin.agents.library import PROJECT, SCHEME
from fieldtwin.agents.tool import Tool
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.stop_signal import on_stop_signal, stop_signal
from fieldtwin.studio.access import Access, AccessMiddleware, allowed_hosts
from fieldtwin.studio.web_server import WebServer, listening_socket

INSTRUCTIONS = (
    "fieldtwin runs the control software of a plant (Modbus and CANopen devices, a gateway and a PLC) with emulated devices. "
    "Find out why a value is bad with `why`; reproduce a failure in a prototype with `start_prototype` and `inject_fault`; "
    "keep it as a test with `check_scenario`, `save_scenario` and `run_scenario`. A value is valid only while its quality is "
    "good. Plants are read-only: no tool writes to one. `propose_write` asks the user, who confirms or refuses the write with "
    "`fieldtwin approve` in a terminal."
)
MOST_CONNECTIONS = 16
MOST_BODY_BYTES = 1 << 20
PATH = "/mcp"


def agent_server(calls: Calls) -> Server[Any]:
    """Return a server that offers the tools and resources of `calls`."""

    async def list_tools(_: Any, params: types.PaginatedRequestParams | None) -> types.ListToolsResult:
        return types.ListToolsResult(tools=[_described(tool) for tool in calls.tools.values()])

    async def call_tool(_: Any, params: types.CallToolRequestParams) -> types.CallToolResult:
        answer = await calls.call(params.name, params.arguments or {})
        return types.CallToolResult(content=[types.TextContent(type="text", text=answer.text)], is_error=answer.failed)

    async def list_resources(_: Any, params: types.PaginatedRequestParams | None) -> types.ListResourcesResult:
        found = [
            types.Resource(uri=uri, name=uri.removeprefix(SCHEME), title=title) for uri, title in calls.library.listed()
        ]
        return types.ListResourcesResult(resources=found)

    async def list_templates(_: Any, params: types.PaginatedRequestParams | None) -> types.ListResourceTemplatesResult:
        project = types.ResourceTemplate(uri_template=f"{SCHEME}{PROJECT}{{+path}}", name="file of the project")
        return types.ListResourceTemplatesResult(resource_templates=[project])

    async def read_resource(_: Any, params: types.ReadResourceRequestParams) -> types.ReadResourceResult:
        answer = await calls.read(params.uri)
        if answer.failed:
            raise MCPError(types.INVALID_PARAMS, answer.text)
        return types.ReadResourceResult(contents=[types.TextResourceContents(uri=params.uri, text=answer.text)])

    return Server(
        "fieldtwin",
        version=__version__,
        instructions=INSTRUCTIONS,
        on_list_tools=list_tools,
        on_call_tool=call_tool,
        on_list_resources=list_resources,
        on_list_resource_templates=list_templates,
        on_read_resource=read_resource,
    )


def _described(tool: Tool) -> types.Tool:
    return types.Tool(
        name=tool.name,
        description=tool.summary,
        input_schema=tool.schema(),
        annotations=types.ToolAnnotations(
            read_only_hint=not tool.changes, destructive_hint=False, open_world_hint=False
        ),
    )


async def serve_stdio(calls: Calls) -> None:
    """Serve one agent on standard input and output, until it closes the input or a signal arrives."""
    from mcp.server.stdio import stdio_server  # imported late, because on Unix it needs modules that other systems lack

    stop = stop_signal()
    server = agent_server(calls)
    async with stdio_server() as (read, write):
        serving = asyncio.ensure_future(server.run(read, write, server.create_initialization_options()))
        stopping = asyncio.ensure_future(stop.wait())
        await asyncio.wait([serving, stopping], return_when=asyncio.FIRST_COMPLETED)
        stopping.cancel()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def serve_http(calls: Calls, place: HttpPlace, clock: Clock, ready: Callable[[str], None]) -> None:
    """Serve agents that have the token, until a signal arrives. `ready` is called with the URL when the server accepts them.

    Raises `EndpointBusy`, `Unreachable` or `FileInvalid`.
    """
    listener = listening_socket(place.host, place.port)
    port = listener.getsockname()[1]
    access = Access(allowed_hosts(place.host, place.names, port), operate=place.token)
    app = agent_server(calls).streamable_http_app(
        streamable_http_path=PATH, max_request_body_size=MOST_BODY_BYTES, max_sessions=MOST_CONNECTIONS, host=""
    )  # without its own check of hosts, because `AccessMiddleware` checks host, origin and token
    checked = AccessMiddleware(app, access, lambda: clock.monotonic_ns() / 1e9)
    server = WebServer(checked, listener, MOST_CONNECTIONS, place.certificate, place.key, websockets=False)
    on_stop_signal(server.stop)
    try:
        await server.start()
        shown = f"[{place.host}]" if ":" in place.host else place.host
        ready(f"{'http' if place.certificate is None else 'https'}://{shown}:{port}{PATH}")
        await server.wait()
    finally:
        await server.aclose()
