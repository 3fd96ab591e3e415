"""Text from a file or a device cannot control the terminal on which our errors are shown."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.escaping import escape_controls


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("as it is → 5 °C\n\tnext", "as it is → 5 °C\n\tnext"),
        ("\x1b[2Jgone", "\\x1b[2Jgone"),
        ("back\r\b", "back\\r\\x08"),
        ("\u202egnp.exe\x9b", "\\u202egnp.exe\\x9b"),
    ],
)
def test_invisible_characters_are_escaped(text: str, shown: str) -> None:
    assert escape_controls(text) == shown
    assert str(FileInvalid("a name", got=text)) == f"a name; got {shown}"


@given(text=st.text())
def test_any_text_becomes_visible(text: str) -> None:
    assert all(c.isprintable() or c in "\n\t" for c in escape_controls(text))
