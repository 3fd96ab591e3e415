"""Settings that a system takes from the sources of its programs while its file is loaded."""
