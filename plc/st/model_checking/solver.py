"""The solver Z3, which the extra `prove` installs."""

from __future__ import annotations

from importlib.util import find_spec

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.installation import install_hint


def require_solver() -> None:
    """Raise `UsageError` if the package z3-solver is not installed."""
    if find_spec("z3") is None:
        raise UsageError("a proof of Structured Text needs the package z3-solver", hint=install_hint("prove"))
