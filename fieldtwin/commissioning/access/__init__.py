"""One device on a live connection: its address, and reading, writing and watching its values."""
