"""The extension for VS Code (packaging/vscode) declares what the debug adapter accepts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.run.debug.arguments import ATTACH, LAUNCH, Form, checked

FOLDER = Path(__file__).parents[3] / "packaging" / "vscode"
MANIFEST: dict[str, Any] = json.loads((FOLDER / "package.json").read_text())
DEBUGGER: dict[str, Any] = MANIFEST["contributes"]["debuggers"][0]
TYPES = {str: "string", int: "integer", list: "array", bool: "boolean"}


@pytest.mark.parametrize(("request_name", "form"), [("launch", LAUNCH), ("attach", ATTACH)])
def test_the_extension_declares_the_arguments_of_the_adapter(request_name: str, form: Form) -> None:
    declared = DEBUGGER["configurationAttributes"][request_name]["properties"]
    assert {name: one["type"] for name, one in declared.items()} == {name: TYPES[kind] for name, kind in form.items()}


def test_the_dialects_and_the_files_of_the_extension_exist() -> None:
    assert DEBUGGER["configurationAttributes"]["launch"]["properties"]["dialect"]["enum"] == list(DIALECTS)
    language = MANIFEST["contributes"]["languages"][0]
    assert MANIFEST["contributes"]["breakpoints"] == [{"language": language["id"]}]
    for named in (MANIFEST["main"], language["configuration"]):
        assert (FOLDER / named).is_file()


def test_the_configurations_of_the_extension_are_valid() -> None:
    bodies = [*DEBUGGER["initialConfigurations"], *(one["body"] for one in DEBUGGER["configurationSnippets"])]
    for body in bodies:
        form = {"launch": LAUNCH, "attach": ATTACH}[body["request"]]
        given = {name: value for name, value in body.items() if name not in ("name", "type", "request")}
        assert body["type"] == DEBUGGER["type"]
        assert checked(body["request"], given, form) == given


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"program": 5}, "`program` in the launch request; expected a string; got 5"),
        ({"seed": True}, "`seed` in the launch request; expected an integer; got True"),
        ({"libraries": [1]}, "`libraries` in the launch request; expected a list of strings"),
        ({"stopOnEntry": "yes"}, "`stopOnEntry` in the launch request; expected true or false; got 'yes'"),
    ],
)
def test_an_argument_of_the_wrong_type_is_refused(given: dict[str, Any], expected: str) -> None:
    with pytest.raises(UsageError, match=expected):
        checked("launch", {"type": "fieldtwin", **given}, LAUNCH)
