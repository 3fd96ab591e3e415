"""The command line, one module for each command: it parses and prints, and other packages do the work."""
