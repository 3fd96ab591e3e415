"""The command line, one module for each command: a command parses its options and prints results; other packages do the work."""
