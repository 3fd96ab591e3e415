"""Describe where a task waits and for what, for the message of a deadlock.

It does not depend on what the tasks do.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

_NAMED = 4
"""The largest number of tasks that are named, if a task waits for several tasks."""
_STATE = re.compile(r"\[(?:locked|unlocked|set|unset)[^\]]*\]|\bmaxsize=.*(?=>)")
"""The part of the repr of a lock, an event, a condition or a queue that shows its state."""


def waits_at(task: asyncio.Task[Any], is_plumbing: Callable[[FrameType], bool]) -> str:
    """Return a text such as ``Reader.turn (reader.py:40) for Queue.get maxsize=8``: the innermost line of user code, and the
    call that it awaits.
    """
    chain = _chain(task.get_coro())
    if not chain:
        return repr(task.get_coro())
    last_of_ours = max((n for n, one in enumerate(chain) if not is_plumbing(one.cr_frame)), default=len(chain) - 1)
    place = chain[last_of_ours]
    shown = f"{place.__qualname__} ({Path(place.cr_frame.f_code.co_filename).name}:{place.cr_frame.f_lineno})"
    return f"{shown} for {_call(chain[-1]) if chain[-1] is not place else _awaited(task)}"


def _chain(outermost: Any) -> list[Any]:
    """Return the coroutines that await each other, the innermost last."""
    chain = []
    inner = outermost
    while getattr(inner, "cr_frame", None) is not None:
        chain.append(inner)
        inner = inner.cr_await
    return chain


def _call(coroutine: Any) -> str:
    """Return the standard-library call that waits, with the state of its object."""
    owner = coroutine.cr_frame.f_locals.get("self")
    state = _STATE.search(repr(owner)) if owner is not None else None
    return f"{coroutine.__qualname__} {state[0]}" if state is not None else str(coroutine.__qualname__)


def _awaited(task: asyncio.Task[Any]) -> str:
    waiter = getattr(task, "_fut_waiter", None)
    if isinstance(waiter, asyncio.Task):
        return f"task {waiter.get_name()}"
    pending = [one for one in getattr(waiter, "_children", ()) if isinstance(one, asyncio.Task) and not one.done()]
    if not pending:
        return "a future"
    named = ", ".join(one.get_name() for one in pending[:_NAMED])
    return f"tasks {named}" + (f" and {len(pending) - _NAMED} more" if len(pending) > _NAMED else "")
