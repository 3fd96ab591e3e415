"""The names of scenario files: a case ID and a suffix.

The pytest plugin runs without the dependencies of fieldtwin, so this module imports only the standard library.
"""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".scenario.yaml"


def case_of(path: Path) -> str:
    """Return the case ID of a scenario: the name of its file without the suffix."""
    return path.name.removesuffix(SUFFIX)
