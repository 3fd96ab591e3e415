"""Passwords in URLs: found, so that they can be refused, and left out of what people and logs are told.

A URL stands on command lines, in files that are shared, and in messages; a password belongs into the environment or a file of its
own. Pure text.
"""

from __future__ import annotations

import re

_USER = re.compile(r"(//[^/@:?#]*):([^@/?#]*)@")
_PARAMETER = re.compile(r"([?&](?:[a-z]*password|passwd|token)=)([^&#]+)", re.IGNORECASE)
HIDDEN = "***"


def has_password(url: str) -> bool:
    """Whether `url` names a password, behind its user or as a parameter."""
    return bool(_USER.search(url) or _PARAMETER.search(url))


def without_password(url: str) -> str:
    """`url` with ``***`` in place of passwords."""
    return _PARAMETER.sub(rf"\g<1>{HIDDEN}", _USER.sub(rf"\g<1>:{HIDDEN}@", url))
