"""``python -m fieldtwin`` is the command."""

from fieldtwin.cli.main import main

if __name__ == "__main__":
    main()
