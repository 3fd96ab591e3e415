"""Run the command line of fieldtwin as ``python -m fieldtwin``."""

import sys

if sys.hexversion < 0x030B0000:  # a checkout runs without an installer that would check the Python version
    sys.exit("fieldtwin needs Python 3.11 or newer; this is " + sys.version.split()[0])

from fieldtwin.cli.main import main

if __name__ == "__main__":
    main()
