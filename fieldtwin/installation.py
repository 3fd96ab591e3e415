"""The commands that install fieldtwin, for messages and pages.

Nothing is on PyPI before the first release. For that release set `PUBLISHED` and run ``scripts/installation --write``, which
corrects the pages. ``tests/project/test_installation.py`` finds a line that differs.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fieldtwin.__about__ import __version__

PUBLISHED = False
CLONE = "./fieldtwin"
WHEEL = f"./fieldtwin-{__version__}-py3-none-any.whl"
PROGRAM = Path(__file__).resolve().parents[1]
"""The folder of the running package: the clone, if it was installed from a clone as editable."""
NOTE = (
    "`pip install fieldtwin` installs the newest release, and `pip install 'fieldtwin[mqtt]'` also what an extra needs."
    if PUBLISHED
    else f"fieldtwin {__version__} is not on PyPI yet. In commands such as `pip install '{CLONE}[mqtt]'`, `{CLONE}` is the folder"
    " of a clone, and the path of a wheel file can replace it."
)
"""The paragraph about releases in docs/how-to/install.md."""


def install_command(extra: str = "", source: str = CLONE) -> str:
    """Return the command that installs fieldtwin, with the packages of an extra if one is named.

    `source` is the clone or the wheel that is installed as long as no release exists.
    """
    what = "fieldtwin" if PUBLISHED else source
    return f"pip install '{what}[{extra}]'" if extra else f"pip install {what}"


def install_hint(extra: str) -> str:
    """Return the hint of a message about an extra that is missing.

    For a clone it is a command that works as it is, in any folder and without an activated environment.
    """
    if (PROGRAM / "pyproject.toml").is_file():
        return f"{sys.executable} -m pip install --editable '{PROGRAM}[{extra}]'"
    return install_command(extra) + ("" if PUBLISHED else f"; {CLONE} is a clone or a wheel file")
