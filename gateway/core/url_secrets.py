"""Find passwords in URLs, to refuse them or to hide them in messages and logs.

A URL appears on command lines, in files that are shared, and in messages; a password belongs in the environment or in a
separate file. This module only handles text.
"""

from __future__ import annotations

import re

_USER = re.compile(r"(//[^/@:?#]*):([^@/?#]*)@")
_PARAMETER = re.compile(r"([?&](?:[a-z]*password|passwd|token)=)([^&#]+)", re.IGNORECASE)
HIDDEN = "***"


def has_password(url: str) -> bool:
    """Return whether `url` contains a password, after its user name or as a parameter."""
    return bool(_USER.search(url) or _PARAMETER.search(url))


def without_password(url: str) -> str:
    """Return `url` with ``***`` in place of passwords."""
    return _PARAMETER.sub(rf"\g<1>{HIDDEN}", _USER.sub(rf"\g<1>:{HIDDEN}@", url))
