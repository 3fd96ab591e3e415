"""Several systems and the acoustic channel between their modems."""
