"""The rows of the emulated node on `canopen`'s LocalNode: its deviations are listed, row by row, and there are no others."""

from __future__ import annotations

import logging
from importlib.metadata import version

import pytest
from canopen_localnode import can_be_asked, load_known, play_localnode
from canopen_rows import Row, load

ROWS = [row for row in load() if can_be_asked(row)]
VERSION, KNOWN = load_known()


def test_the_list_names_rows() -> None:
    assert set(KNOWN) <= {row.id for row in ROWS}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.id)
def test_localnode_passes_the_row_or_its_deviation_is_listed(row: Row, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL, "canopen")
    found = play_localnode(row)
    if version("canopen") == VERSION:
        assert found == KNOWN.get(row.id, "")
    elif row.id not in KNOWN:
        assert not found, "a row that an earlier version of the package passed"
