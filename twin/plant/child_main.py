"""The `main` function of a child process whose configuration is a JSON file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.wallclock import run

C = TypeVar("C")


def child_main(argv: list[str], form: type[C], serve: Callable[[C], Coroutine[Any, Any, int]]) -> int:
    """Run `serve` with the configuration in the file ``argv[0]``, and return its exit code.

    An error is printed to stderr as one line, and its exit code returned.
    """
    try:
        return run(serve(msgspec.json.decode(Path(argv[0]).read_bytes(), type=form)))
    except FieldtwinError as e:
        print(e, file=sys.stderr)
        return e.exit_code
