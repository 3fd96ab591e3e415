"""Resources that are started completely or not at all."""

from __future__ import annotations

import pytest
from support import run

from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.errors import Unreachable


class Parts(AsyncResource):
    """Record its actions. `fails` names the part that does not start, or ``stop``."""

    def __init__(self, fails: str = "") -> None:
        super().__init__()
        self.done: list[str] = []
        self._fails = fails

    async def _start(self) -> None:
        for name in "abc":
            self._note(f"begin {name}", name)
            self._stack.callback(self.done.append, f"end {name}")

    async def _stop(self) -> None:
        self._note("stop", "stop")

    def _note(self, what: str, name: str) -> None:
        if name == self._fails:
            raise Unreachable(f"{name} fails")
        self.done.append(what)


def test_it_stops_first_and_ends_in_the_reverse_order() -> None:
    parts = Parts()

    async def main() -> None:
        async with parts as same:
            assert same is parts
            parts.done.append("run")

    run(main())
    assert parts.done == ["begin a", "begin b", "begin c", "run", "stop", "end c", "end b", "end a"]


@pytest.mark.parametrize(
    ("fails", "done"),
    [
        ("a", []),
        ("c", ["begin a", "begin b", "end b", "end a"]),
        ("stop", ["begin a", "begin b", "begin c", "end c", "end b", "end a"]),
    ],
)
def test_started_parts_are_ended_whatever_failed(fails: str, done: list[str]) -> None:
    parts = Parts(fails)

    async def main() -> None:
        async with parts:
            pass

    with pytest.raises(Unreachable, match=f"{fails} fails"):
        run(main())
    assert parts.done == done
