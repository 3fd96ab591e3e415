"""The reference of the tools of an agent equals the tools, and their schemas are valid JSON schemas."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from jsonschema import Draft202012Validator

from fieldtwin.agents.tool import CALL_WITHIN_S, Tool
from fieldtwin.agents.tools.all_tools import TOOLS
from fieldtwin.gateway.core.errors import UsageError

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "agent-tools.md"


def row(tool: Tool) -> str:
    fields = msgspec.structs.fields(tool.form)
    arguments = ", ".join(f"`{f.name}`" if f.required else f"[`{f.name}`]" for f in fields)
    limit = "" if tool.within_s == CALL_WITHIN_S else f" ({tool.within_s:g} s)"
    return f"| `{tool.name}` | {arguments} | {tool.summary.removesuffix('.')}{limit} | {tool.changes} |"


def test_the_reference_lists_every_tool() -> None:
    page = PAGE.read_text(encoding="utf-8")
    wanted = "\n".join(row(tool) for tool in TOOLS)
    assert wanted in page, f"replace the table of {PAGE.name} by:\n{wanted}"


def test_names_are_unique_and_schemas_are_valid() -> None:
    assert len({tool.name for tool in TOOLS}) == len(TOOLS)
    for tool in TOOLS:
        schema = tool.schema()
        Draft202012Validator.check_schema(schema)
        assert schema["type"] == "object"
        assert schema["additionalProperties"] is False


def test_tools_that_change_something_are_those_of_prototypes_new_scenarios_and_proposals() -> None:
    assert {tool.name: tool.changes for tool in TOOLS if tool.changes} == {
        "start_prototype": "prototype",
        "stop_prototype": "prototype",
        "inject_fault": "prototype",
        "clear_faults": "prototype",
        "set_value": "prototype",
        "save_scenario": "project",
        "propose_write": "proposal",
        "withdraw_proposal": "proposal",
        "start_dump": "project",
    }


@pytest.mark.parametrize("given", [None, 5, [], {"unknown": 1}, {"instance": 5}, {"instance": "x", "tag": None}])
def test_arguments_that_do_not_fit_are_refused(given: object) -> None:
    tool = next(tool for tool in TOOLS if tool.name == "why")
    with pytest.raises(UsageError, match="expected instance, tag"):
        tool.arguments(given)
