"""Keeps the parse tables of a grammar in the folder of Python's compiled modules (`__pycache__`).

lark needs 0.7 s of CPU time to compute the tables of Structured Text, and 0.05 s to read them. The rules are those of compiled
modules: Python's options that forbid or move compiled modules apply, and a folder that cannot be written is not an error. This
module reads pickles, from this folder only: a user who may write there can already replace the program's compiled modules.
"""

from __future__ import annotations

import hashlib
import io
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.util import cache_from_source
from pathlib import Path

import lark

_DIGEST_BYTES = hashlib.sha256().digest_size


def place_of(source: Path) -> Path:
    """Return the path of the tables of the grammar in the file `source`, for this version of Python."""
    return Path(cache_from_source(str(source))).with_suffix(".tables")


def parser_with_tables(place: Path, identity: str, build: Callable[[], lark.Lark]) -> lark.Lark:
    """Return the parser whose tables are in the file `place`; if it has none, build the parser and write the file.

    `identity` is the text of the grammar and its options. The file begins with a SHA-256 of the identity, the versions of lark
    and Python, and the tables: a file that is damaged or belongs to different ones is replaced.
    """
    prefix = f"{lark.__version__}\n{sys.version}\n{identity}\n".encode()
    with suppress(OSError):
        data = place.read_bytes()
        if data[:_DIGEST_BYTES] == hashlib.sha256(prefix + data[_DIGEST_BYTES:]).digest():
            return lark.Lark.load(io.BytesIO(data[_DIGEST_BYTES:]))
    parser = build()
    if not sys.dont_write_bytecode:
        tables = io.BytesIO()
        parser.save(tables)
        _write(place, hashlib.sha256(prefix + tables.getvalue()).digest() + tables.getvalue())
    return parser


def _write(place: Path, data: bytes) -> None:
    """Write a complete file or none: several processes may start at the same time."""
    part = place.with_name(f"{place.name}.{os.getpid()}")
    with suppress(OSError):
        try:
            place.parent.mkdir(exist_ok=True)
            part.write_bytes(data)
            part.replace(place)
        finally:
            part.unlink(missing_ok=True)
