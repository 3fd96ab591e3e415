"""Clocks that a module has imported by name: ``from time import monotonic``, ``from datetime import datetime``.

The replacements that `fieldtwin.emulators.virtual.seal` puts into ``time`` do not reach these names. They are found in
the globals of loaded modules that are neither part of Python nor installed packages: the user's programs and models.
Each module is searched once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

Guards = Mapping[int, tuple[Any, Any]]
"""By the identity of a guarded object: the object and its replacement."""

_INSTALLED = ("site-packages", "dist-packages")
_newest: list[tuple[int, str]] = [(0, "")]
"""The number of modules at the last search, and the module that was loaded last."""
_seen: dict[str, int] = {}
"""Modules that were searched, with the identity of their globals, because a reloaded module must be searched again."""
_taken: dict[str, tuple[str, ...]] = {}
"""By module that imported a clock: the names under which the module has it."""


@contextmanager
def replaced(guards: Guards) -> Iterator[None]:
    """Replace every name that refers to a guarded object by its guard, until the end of the context."""
    _look_through(guards)
    put: list[tuple[dict[str, Any], str]] = []
    for module_name, names in _taken.items():
        scope: dict[str, Any] = getattr(sys.modules.get(module_name), "__dict__", {})
        for name in names:
            real, guard = guards.get(id(scope.get(name)), (None, None))
            if guard is not None and scope.get(name) is real:
                scope[name] = guard
                put.append((scope, name))
    try:
        yield
    finally:
        real_of = {id(guard): real for real, guard in guards.values()}
        for scope, name in put:
            real = real_of.get(id(scope.get(name)))
            if real is not None:  # otherwise the module has changed the name meanwhile
                scope[name] = real


def _look_through(guards: Guards) -> None:
    """Search new modules for clocks. It runs many times per second, so it does nothing if no module was loaded since then."""
    newest = (len(sys.modules), next(reversed(sys.modules)))
    if newest == _newest[0]:
        return
    _newest[0] = newest
    for name, module in list(sys.modules.items()):
        scope = getattr(module, "__dict__", None)
        if scope is None or _seen.get(name) == id(scope):
            continue
        _seen[name] = id(scope)
        _taken.pop(name, None)
        if _is_library(name, scope):
            continue
        names = tuple(
            key for key, value in list(scope.items()) if id(value) in guards and guards[id(value)][0] is value
        )
        if names:
            _taken[name] = names


def _is_library(name: str, scope: Mapping[str, Any]) -> bool:
    if name.partition(".")[0] in sys.stdlib_module_names and name != "__main__":
        return True
    file = scope.get("__file__") or ""
    return any(part in file for part in _INSTALLED)


def guarded_date(real: type, refuse: Callable[[str], None]) -> type:
    """Return a replacement for ``datetime.datetime`` or ``datetime.date`` that calls `refuse` before it reads the clock.

    `refuse` is called with the name of the method, and raises or permits the call. Objects that it creates have the
    real type.
    """

    class Kind(type):
        def __instancecheck__(cls, instance: object) -> bool:
            return isinstance(instance, real) if cls is guarded else super().__instancecheck__(instance)

        def __subclasscheck__(cls, subclass: type) -> bool:
            return issubclass(subclass, real) if cls is guarded else super().__subclasscheck__(subclass)

    def new(cls: type, *args: Any, **kwargs: Any) -> Any:
        return real(*args, **kwargs) if cls is guarded else real.__new__(cls, *args, **kwargs)

    def asked(name: str) -> Any:
        def ask(cls: type, *args: Any, **kwargs: Any) -> Any:
            refuse(f"{real.__name__}.{name}")
            return getattr(real, name)(*args, **kwargs)

        return classmethod(ask)

    body: dict[str, Any] = {"__new__": new, "__module__": real.__module__, "__qualname__": real.__qualname__}
    body |= {name: asked(name) for name in ("now", "utcnow", "today") if hasattr(real, name)}
    guarded: type = Kind(real.__name__, (real,), body)
    return guarded
