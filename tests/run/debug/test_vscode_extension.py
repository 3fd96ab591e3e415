"""The extension for VS Code (packaging/vscode) declares what the debug adapter accepts."""

from __future__ import annotations

import json
import re
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
    (grammar,) = MANIFEST["contributes"]["grammars"]
    assert grammar["language"] == language["id"]
    for named in (MANIFEST["main"], language["configuration"], grammar["path"]):
        assert (FOLDER / named).is_file()
        assert Path(named).name in MANIFEST["files"]


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("'it$'s'", "string.quoted.st"),
        ("(* a comment", "comment.block.st"),
        ("T#1s500ms", "constant.numeric.st"),
        ("16#FF", "constant.numeric.st"),
        ("end_if", "keyword.control.st"),
        ("END_FUNCTION_BLOCK", "storage.type.st"),
        ("VAR_IN_OUT", "storage.type.st"),
        ("UDINT", "support.type.st"),
    ],
)
def test_the_grammar_of_the_extension_highlights_words(text: str, kind: str) -> None:
    patterns = json.loads((FOLDER / "st.tmLanguage.json").read_text())["patterns"]
    first = next(one for one in patterns if re.match(one.get("match", one.get("begin")), text))
    assert first["name"] == kind
    if "match" in first:
        assert re.fullmatch(first["match"], text)


def test_the_grammar_of_the_extension_leaves_names_alone() -> None:
    patterns = json.loads((FOLDER / "st.tmLanguage.json").read_text())["patterns"]
    assert not [one for one in patterns if "match" in one and re.match(one["match"], "if_open")]


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
