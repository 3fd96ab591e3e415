"""A project folder with the site `shed`, and an agent: a client of the package mcp with `fieldtwin mcp` as its subprocess."""

from __future__ import annotations

import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcp import StdioServerParameters
from mcp.client.client import Client
from mcp_types import TextContent, TextResourceContents
from procs import CHECKOUT
from shed_site import write_shed

SCENARIO = """\
scenario: The level is bad while the tank does not answer
system: shed.yaml
steps:
  - wait: {until: "quality(tank.level) == 'good'", within: 10s}
  - fault: {id: dead, name: silence, device: tank}
  - expect: {tag: tank.level, quality: bad, within: 5s}
  - clear: dead
  - expect: {tag: tank.level, quality: good, within: 15s}
"""


class Failed(Exception):
    """The answer of a tool was an error."""


@dataclass(frozen=True)
class Agent:
    """A connected client. `audit` is the audit log of the server."""

    client: Client
    audit: Path

    async def text(self, tool: str, **arguments: Any) -> str:
        """Return the text of an answer. Raises `Failed` with the text of an error."""
        result = await self.client.call_tool(tool, arguments)
        [content] = result.content
        assert isinstance(content, TextContent)
        if result.is_error:
            raise Failed(content.text)
        return content.text

    async def data(self, tool: str, **arguments: Any) -> Any:
        """Return an answer in JSON as data."""
        return json.loads(await self.text(tool, **arguments))

    async def resource(self, uri: str) -> str:
        """Return the text of a resource."""
        [content] = (await self.client.read_resource(uri)).contents
        assert isinstance(content, TextResourceContents)
        return content.text

    def entries(self) -> list[dict[str, Any]]:
        """Return the entries of the audit log."""
        return [json.loads(line) for line in self.audit.read_text(encoding="utf-8").splitlines()]


def write_project(folder: Path) -> Path:
    """Write the site into a new folder of `folder`, and return it."""
    project = folder / "project"
    project.mkdir()
    write_shed(project)
    return project


@asynccontextmanager
async def agent(root: Path, project: Path, *options: str) -> AsyncIterator[Agent]:
    """An agent for a project. Run directories and the audit log are in `root`; messages of the server are in mcp.err."""
    environment = {"FIELDTWIN_RUN": str(root), "PYTHONPATH": str(CHECKOUT)}
    command = ["-m", "fieldtwin", "mcp", str(project), *options]
    parameters = StdioServerParameters(command=sys.executable, args=command, env=environment, cwd=root)
    async with Client(parameters) as client:
        yield Agent(client, root / "agent-audit.jsonl")
