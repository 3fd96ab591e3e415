"""The command line. Each module `*_command` holds one command; it parses and prints, and other packages do the work."""
