from __future__ import annotations

from collections.abc import Iterator

import pytest
from debug_editor import Open, ProcessEditor


@pytest.fixture
def opened() -> Iterator[Open]:
    made: list[ProcessEditor] = []

    def one(*arguments: str) -> ProcessEditor:
        made.append(ProcessEditor(*arguments))
        return made[-1]

    yield one
    for each in made:
        each.close()
