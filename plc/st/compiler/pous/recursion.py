"""Refuses POUs that call themselves (IEC 61131-3:2013, 6.6.1.5)."""

from __future__ import annotations

from fieldtwin.plc.st.compiler.scope import Environment

MAX_CALLS = 64
"""The longest chain of POUs that call each other."""


def refuse_recursion(env: Environment) -> None:
    """Raise `FileInvalid` for a POU that calls itself, directly or through others."""

    def walk(name: str, path: tuple[str, ...]) -> None:
        if len(path) > MAX_CALLS:
            pos = next(iter(env.calls[path[-2]].values()))
            env.fail(pos, "calls nested too deep", expected=f"at most {MAX_CALLS}")
        for callee, pos in env.calls.get(name, {}).items():
            if callee in path:
                env.fail(pos, f"{callee} calls itself: {' -> '.join((*path[path.index(callee) :], callee))}")
            if callee not in done:
                walk(callee, (*path, callee))
        done.add(name)

    done: set[str] = set()
    for name in list(env.calls):
        walk(name, (name,))
