"""The troubleshooting page has every error class and every message of the code."""

from __future__ import annotations

import re
import sys

import pytest
from page_runner import ROOT

sys.path.insert(0, str(ROOT / "docs" / "book"))

import troubleshooting_page as page

from fieldtwin.gateway.core.errors import Bug, FieldtwinError

RAISED = re.compile(r"""raise (\w+)\(\s*f?"((?:[^"\\]|\\.)*)\"""")
"""A class and the first literal of its message; the page finds them by the syntax tree instead."""


def test_every_error_class_has_a_section_with_its_exit_code():
    text = page.troubleshooting_page()
    assert len(page.kinds()) > 25
    for name, kind in page.kinds().items():
        assert f"## {name}\n" in text
        assert f"| [{name}](#error-class-{name.lower()}) | {kind.exit_code} |" in text


@pytest.mark.parametrize("package", page.PACKAGES)
def test_every_message_of_the_code_is_on_the_page(package: str):
    texts = [m.text for m in page.messages()]
    seen = 0
    for path in sorted((ROOT / package).rglob("*.py")):
        if any(part.is_symlink() for part in (path, *path.parents)):
            continue
        for kind, literal in RAISED.findall(path.read_text("utf-8")):
            known = page.kinds().get(kind)
            fixed = re.split(r"\{[^}]*\}", literal)
            if known is None or issubclass(known, Bug) or max(map(len, fixed)) < 6:
                continue
            seen += 1
            parts = [part.replace("{{", "{") for part in fixed if "\\" not in part]
            assert any(all(part in text for part in parts) for text in texts), f"{path}: {literal}"
    assert seen > 3


def test_a_message_is_shown_as_it_is_printed_with_placeholders():
    assert any(m.kind == "UsageError" and m.text == "no explanation of '<text>'" for m in page.messages())
    shown = page.troubleshooting_page()
    assert "| `no explanation of '<text>'` |" in shown
    assert "`fieldtwin.explain.lookup`" in shown


def test_values_in_other_forms_of_text_get_placeholders():
    spelled = page._spelled(page.ast.parse('f"{a.b!r} at {c:02X}" + d', mode="eval").body)
    assert spelled == "'<b>' at <c><d>"


def test_an_error_class_that_the_program_gets_later_is_found():
    assert issubclass(page.kinds()["StoreFull"], FieldtwinError)
