"""Tokens in files: a system file names the file, because it must not contain the token."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid, os_reason

SHORTEST_TOKEN, LONGEST_TOKEN = 16, 200
"""Limits of the length of a token in characters."""


def read_token(path: Path) -> str:
    """Return the token in the first line of a file. Raises `FileInvalid`; no message contains the token."""
    try:
        with path.open(encoding="utf-8") as file:
            token = file.readline(LONGEST_TOKEN + 2).strip()
    except OSError as e:
        raise FileInvalid(f"cannot read the token: {os_reason(e)}", path=str(path), hint=HINT) from e
    except UnicodeDecodeError as e:
        raise FileInvalid("the file of the token is not text", path=str(path), hint=HINT) from e
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isascii() or len(token.split()) != 1:
        raise FileInvalid("not a token", path=str(path), expected=EXPECTED, hint=HINT)
    return token


EXPECTED = f"one line of {SHORTEST_TOKEN} to {LONGEST_TOKEN} ASCII characters without spaces"
HINT = "`openssl rand -hex 16` prints a token"
