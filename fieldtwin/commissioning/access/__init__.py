"""One device on a live connection: the parsing of its address, and reading, writing and watching its values."""
