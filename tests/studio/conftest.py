"""One server with the observatory's prototype for all tests of a process, because it takes seconds to start."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from studio_rig import Studio, studio


@pytest.fixture(scope="session")
def observatory() -> Iterator[Studio]:
    """A running Studio that has started the observatory's prototype."""
    with studio("observatory") as running:
        yield running
