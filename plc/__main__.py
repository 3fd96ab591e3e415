"""``python -m fieldtwin.plc CONFIG.json``: one PLC process. Its exit codes are those of the command line
(docs/explanation/design.md); diagnostics go to stderr.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.plc.runtime.config import PlcConfig
from fieldtwin.plc.runtime.process import plc_main


def main() -> int:
    """Read the configuration named on the command line and run it."""
    if len(sys.argv) != 2:
        print("usage: python -m fieldtwin.plc CONFIG.json", file=sys.stderr)
        return 2
    try:
        return plc_main(PlcConfig.load(Path(sys.argv[1])))
    except FieldtwinError as e:
        print(e, file=sys.stderr)
        return e.exit_code


if __name__ == "__main__":
    sys.exit(main())
