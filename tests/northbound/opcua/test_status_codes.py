"""The status code of each quality and reason: numbers of the standard, the class of the quality, and the table in the docs."""

from __future__ import annotations

from pathlib import Path

import pytest
from asyncua import ua

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.opcua.status_codes import BAD_CODES, status_code, table

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "opcua.md"
CLASSES = {0: "good", 1: "uncertain", 2: "bad"}


@pytest.mark.parametrize("reason", list(Reason))
@pytest.mark.parametrize("quality", list(Quality))
def test_the_class_of_a_status_code_is_that_of_the_quality(quality: Quality, reason: Reason) -> None:
    code = status_code(quality, reason)
    middle = quality in (Quality.SUBSTITUTED, Quality.SIMULATED)
    assert CLASSES[code.number >> 30] == ("uncertain" if middle else str(quality))
    assert getattr(ua.StatusCodes, code.name) == code.number


def test_every_reason_for_a_bad_value_has_a_code() -> None:
    assert set(BAD_CODES) == set(Reason) - {Reason.NONE}


def test_the_reference_shows_this_table() -> None:
    rows = [f"| {quality} | {reason} | `{code.name}` | 0x{code.number:08X} |" for quality, reason, code in table()]
    assert "\n".join(rows) in PAGE.read_text(encoding="utf-8"), "the table in docs/reference/opcua.md:\n" + "\n".join(
        rows
    )
