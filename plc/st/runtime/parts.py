"""Access to a part of a variable by its place: an attribute of an object, or an element of a list."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Key = str | int
"""The name of an attribute, or the index of an element, from 0."""


def reached(owner: Any, steps: Sequence[Key]) -> Any:
    """Return the object that is reached from `owner` through the attributes and elements `steps`."""
    for step in steps:
        owner = value_of(owner, step)
    return owner


def value_of(owner: Any, key: Key) -> Any:
    """Return the value of an attribute or element of `owner`."""
    return owner[key] if isinstance(key, int) else getattr(owner, key)


def assign(owner: Any, key: Key, value: Any) -> None:
    """Assign a value to an attribute or element of `owner`."""
    if isinstance(key, int):
        owner[key] = value
    else:
        setattr(owner, key, value)
